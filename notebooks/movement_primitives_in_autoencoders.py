# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Movement primitives in autoencoders
#
# A body has fifty joint angles, yet a punch or a step is a simple thing: the joints move together.
# Chapter 5 of the thesis learns *both halves* of that sentence at once. An **autoencoder** squeezes
# every frame of a movement into five numbers, and a **dynamic movement primitive** moves these five
# numbers in time. The model is called AE-DMP (`ae-dmp` in the zoo).
#
# This notebook explains the six experiments of the chapter:
#
# | experiment | question |
# |---|---|
# | E5.1 | Is it better to learn autoencoder and primitive together than one after the other? |
# | E5.2 | What does the second term of the loss do to the latent path? |
# | E5.3 | Can a sparse model make a movement that nobody showed to it? |
# | E5.4 | Can it guess joints that were not measured? |
# | E5.5 | Can it go on after ten frames? |
# | E5.6 | Can the movement be sent to another goal? |
#
# Every section says what is asked, shows the thing itself with a **small model trained here** in
# some ten seconds, and then the **stored result** of the full experiment with the thesis' numbers
# beside ours. Small models are worse than the full ones; only the stored tables count.
#
# With `MOVEZOO_DATA` naming a folder with motion capture the movements are real: a punch of the
# thesis' own data, walks and jogs of CMU subject 35. Without it a simulated robot arm takes their
# place, so that the notebook runs everywhere.

# %%
import os
import warnings
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import torch
from IPython.display import Markdown

import zoo
from zoo.errors import PosteriorCollapseWarning
from zoo.evaluation.figures.bands import forecast_bands, reliability
from zoo.evaluation.figures.postures import posture_strip, posture_strips
from zoo.studies import stored

real = bool(os.environ.get("MOVEZOO_DATA"))
plt.rcParams.update({"axes.spines.top": False, "axes.spines.right": False})

# %% [markdown]
# ## The movement
#
# One movement to begin with. Real: a punch, 70 frames of 50 joint angles. Simulated: a robot arm
# that hurries to and fro between six places on a table.

# %%
if real:
    movement = zoo.load_data("thesis-movements").where(movement="punching")
    size = {}
else:
    reaches = zoo.load_data("robot-arm/reaching")
    there = [reaches.arrays[i] for i in (0, 2, 4, 7, 9, 12)]
    legs = [part + there[0][0] - part[0] for part in there]
    to_and_fro = np.concatenate([half for leg in legs for half in (leg, leg[::-1])][:-1])
    movement = zoo.Sequences.from_arrays(
        [to_and_fro[::10]], rate=25.0, channels=reaches.channels, units="rad", name="to and fro"
    )
    size = {"latent_dim": 3, "hidden": (24, 12)}

figure, axes = plt.subplots(figsize=(11, 2.2), layout="constrained")
posture_strip(axes, movement.values[0], movement.channels)
axes.set_title("the movement, every sixth frame", loc="left")
axes.set_xlabel("frame")
plt.show()

# %% [markdown]
# Left limbs are orange and right ones blue (of the arm: links by turns).
#
# ## The model
#
# A **dynamic movement primitive** is a damped spring that is pulled to a goal $g$ and pushed by a
# force $f$ on the way. With $\beta = \alpha/4$ it is critically damped, so that it never overshoots
# by itself:
#
# $$\tau\,\ddot y = \alpha\,\bigl(\beta\,(g - y) - \dot y\bigr) + f,\qquad
# f(t) = \frac{\sum_i \Psi_i(t)\, w_i}{\sum_i \Psi_i(t)} \tag{53, 54}$$
#
# The weights $w$ say how the movement goes, the goal $g$ where it ends. From a demonstration one
# reads the force that would have been needed, $f^{\text{target}}$ (59), and regresses it on the
# kernels $\Psi$.
#
# An **autoencoder** finds a few numbers $y_t = \operatorname{enc}(x_t)$ for a frame from which a
# decoder restores it (17). Here the primitive stands *between* encoder and decoder: what is decoded
# is not the encoded path $y$, but the primitive's roll-out $\tilde y$ of it. Minimised is
#
# $$\sum_i \Bigl\{ \bigl\|x_i - \operatorname{dec}(\tilde y_i)\bigr\|^2
# + \lambda\, \bigl\|f_i - f_i^{\text{target}}\bigr\|^2 \Bigr\} \tag{72}$$
#
# The first term wants the movement back. The second wants a latent path that a primitive *can*
# follow. In the zoo (72) is minus the log joint of a probabilistic program with
# $x_i \sim \mathcal N(\operatorname{dec}(\tilde y_i), \sigma^2)$, so that $\sigma$ is learned.
#
# ## E5.1 Together or one after the other?
#
# **Asked (§5.3.2, Table 2):** autoencoder and primitive trained jointly (`ae-dmp`), against the
# same two parts trained one after the other (`ae-then-dmp`), a primitive for every joint (`dmp`),
# and primitives of principal components (`pca-dmp`).
#
# **The thesis found** joint training ahead, "in particular for highly dynamic movements": 2.3
# against 21 · 10⁻⁴ rad² for kicking. For balancing, slow as it is, all but `pca-dmp` are alike (2.7
# to 2.9).

# %%
models = {
    "trained together, ae-dmp": ("ae-dmp", {"epochs": 1000, **size}),
    "one after the other, ae-then-dmp": ("ae-then-dmp", {"epochs": 1000, **size}),
    "a primitive a joint, dmp": ("dmp", {}),
    "primitives of components, pca-dmp": ("pca-dmp", {"latent_dim": size.get("latent_dim", 5)}),
}
runs = {
    label: zoo.fit(zoo.create(name, movement, **settings), movement)
    for label, (name, settings) in models.items()
}
lines = ["| model | mean squared error / 10⁻⁴ rad² |", "|---|---|"]
for label, run in runs.items():
    error = (run.reconstruct(movement).mean - movement.values).double().square().mean()
    lines.append(f"| {label} | {1e4 * error:.2f} |")
Markdown("\n".join(lines))

# %% [markdown]
# The reason can be seen. Below, for each model, the path that the encoder gives (grey) and the
# roll-out of the primitive (colour) in the two latent numbers that vary most. Trained apart, the
# autoencoder knows nothing of time: its path has corners that no primitive can follow. Trained
# together, the primitive *teaches the encoder to be smooth*.

# %%
figure, panels = plt.subplots(2, 2, figsize=(11, 4.6), sharex=True, layout="constrained")
for column, (label, run) in zip(panels.T, list(runs.items())[:2], strict=True):
    encoded = run.encode(movement)[0][0]
    rolled = run.represent(movement, draws=1).mean[0]
    wide = encoded.var(0).argsort(descending=True)[:2].tolist()
    for axes, unit in zip(column, wide, strict=True):
        axes.plot(encoded[:, unit], color="0.6", lw=4, label="encoded frames, $y$")
        axes.plot(rolled[:, unit], color="C3", lw=1.4, label="primitive, $\\tilde{y}$")
        axes.set_ylabel(f"latent unit {unit + 1}")
    column[0].set_title(label)
    column[1].set_xlabel("frame")
figure.legend(
    *panels[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=2, frameon=False
)
plt.show()

# %% [markdown]
# The full experiment, five movements with a model each:

# %%
stored("E5.1")

# %% [markdown]
# ## E5.2 What does the second term do?
#
# **Asked (Fig. 34–36):** the same training with λ switched off. Then nothing but the decoder's
# error ties the encoder to the primitive. Measured is the *misfit* between encoded path and
# roll-out, in units of the path's spread, and how *jerky* the encoded path is (third over first
# differences).
#
# **The thesis found** that the primitive follows the encoded path only with the term (Fig. 34),
# that paths of the integrated model are smooth and those of the other jerky (Fig. 35), and shows
# the accuracy joint by joint, $\sqrt{R^2}$ (Fig. 36). It gives no numbers.

# %%
stored("E5.2")

# %% [markdown]
# ## E5.3 A movement that nobody showed
#
# **Asked (§5.2.2, §5.3.3, Fig. 37 and 38):** one model of 21 walking and 9 jogging sequences, with
# a penalty that keeps latent numbers at zero unless they are needed,
#
# $$\mathcal L(y) = \eta \sum_i \|y_i\|_1 \tag{73}$$
#
# In the zoo that is a Laplace prior on $y$ (`sparse-ae-dmp`). **The thesis found** three kinds of
# units: active in both movements, active in jogging alone, idle. It switched one of them *on* in a
# walk: arms and posture became those of jogging at the pace of the walk, a "slow jog" that nobody
# had recorded.
#
# Here: a small model of both kinds (simulated: reaches to goals on the right, and to far ones on
# the left). Some units shall stay idle, hence the zoo would warn that their posterior equals the
# prior: that is what a sparse model is for, and the warning is silenced.

# %%
if real:
    from zoo.studies.chapter5.walking import both

    mixed, kinds = both(), ("walking", "jogging")
    kind, sparsity = np.array(mixed.groups["movement"]), {"latent_dim": 10}
else:
    left, right = ("goal_02", "goal_14", "goal_18", "goal_29"), ("goal_03", "goal_05", "goal_28")
    goals, kinds = np.array(reaches.groups["goal"]), ("right", "far left")
    chosen = np.flatnonzero(np.isin(goals, left + right)).tolist()
    mixed, kind = reaches[chosen], np.where(np.isin(goals[chosen], left), *kinds[::-1])
    sparsity = {"latent_dim": 5, "hidden": (24, 12), "prior_scale": 0.1, "weight_scale": 1.0}

with warnings.catch_warnings():
    warnings.simplefilter("ignore", PosteriorCollapseWarning)
    sparse = zoo.fit(zoo.create("sparse-ae-dmp", mixed, epochs=800, **sparsity), mixed)
latent = sparse.represent(mixed, draws=1).mean
calm, other = (latent[torch.tensor(kind == k)] for k in kinds)
active = torch.stack([part.square().mean((0, 1)).sqrt() for part in (calm, other)])

figure, axes = plt.subplots(figsize=(8, 2.6), layout="constrained")
where = np.arange(latent.shape[-1])
for offset, row, name, colour in zip((-0.2, 0.2), active, kinds, ("C0", "C1"), strict=True):
    axes.bar(where + offset, row / active.max(), width=0.4, color=colour, label=name)
axes.set_xticks(where, [str(i + 1) for i in where])
axes.set(xlabel="latent unit", ylabel="activity / largest", title="which units are used by what")
axes.legend(frameon=False)
plt.show()

# %% [markdown]
# Now one unit, the one whose level differs most between the two, is raised to its level in the
# second kind of movement. Everything else is left alone, and the result is decoded.

# %%
raised = other.mean((0, 1)) - calm.mean((0, 1))
unit = int(raised.abs().argmax())
switched = calm[:1].clone()
switched[..., unit] += raised[unit]


rows = {
    kinds[0]: calm[:1],
    f"{kinds[0]}, unit {unit + 1} switched on": switched,
    kinds[1]: other[:1],
}
figure, panels = plt.subplots(3, 1, figsize=(11, 5 if real else 4), layout="constrained")
made = {name: sparse.decode(path).mean[0] for name, path in rows.items()}
posture_strips(panels, made, mixed.channels)
panels[-1].set_xlabel("frame")
plt.show()

# %% [markdown]
# Arms and legs go some of the way from the first row to the last, and one movement still fills the
# same time. There is no truth for such a movement, so that only *how far* and *how fast* can be
# measured. The full experiment sets the unit to a constant, as the thesis does:

# %%
stored("E5.3")

# %% [markdown]
# ## E5.4 Missing joints
#
# **Asked (§5.3.4, Table 3):** four joints of the right leg, or of the left arm, were not measured.
# A denoising autoencoder can guess them frame by frame: fill the holes with anything, pass the
# frame through the network, keep what the network says of the holes and restore what was measured,
# and repeat. With $x_J$ measured and $x_{\bar J}$ missing:
#
# $$x^{(k+1)}_{\bar J} = \operatorname{dec}\bigl(\operatorname{enc}(x_J \cup x^{(k)}_{\bar J})
# \bigr)_{\bar J}$$
#
# **The thesis found** that the chain has converged after $k = 4$ passes, with errors of
# 0.33 to 5 · 10⁻³ rad² a joint.
#
# Here: a small model of 21 walking sequences (simulated: of reaches), its inputs corrupted
# throughout the training. The leg is hidden in walks of **other trials**, which the model never
# saw.

# %%
if real:
    from zoo.studies.chapter5.walking import walking

    train, unseen = walking()
    hidden = ["rfemur_rx", "rfemur_ry", "rfemur_rz", "rtibia_rx"]
else:
    train, unseen = reaches.split(by="trial", parts=(0.4, 0.6), seed=0)
    hidden = ["joint_2"]
    size = {"latent_dim": 4, "hidden": (24, 12)}
model = zoo.fit(zoo.create("ae-dmp", train, epochs=800, corrupted=1.0, **size), train)

holes = torch.ones_like(unseen.mask)
holes[..., [unseen.channels.index(c) for c in hidden]] = False
guess, chain = torch.where(holes, unseen.values, train.values.mean((0, 1))), []
for _ in range(9):
    chain.append(guess)
    code, _ = model.encode(replace(unseen, values=guess))
    guess = torch.where(holes, unseen.values, model.decode(code).mean)

errors = [1e3 * float((x - unseen.values)[~holes].double().square().mean()) for x in chain]
figure, (left, right) = plt.subplots(
    1, 2, figsize=(11, 3.6), width_ratios=(1, 2.2), layout="constrained"
)
left.plot(errors, "o-")
left.axvline(4, color="0.7", ls=":", label="k = 4, as in the thesis")
left.set(
    xlabel="passes k", ylabel="MSE / 10⁻³ rad²", ylim=(0, None), title="error of the hidden joints"
)
left.legend(frameon=False)
frame = int((chain[0] - unseen.values)[0].square().sum(-1).argmax())
steps = torch.stack([x[0, frame] for x in (*chain[:5], unseen.values)])
posture_strip(right, steps, unseen.channels, every=1)
right.set_xticklabels(["k = 0 (mean)", "1", "2", "3", "4", "truth"])
right.set_title(f"frame {frame} of an unseen movement, pass by pass")
plt.show()

# %% [markdown]
# A pass costs nothing and one or two are enough; what is left is what the small network does not
# know of held-out movements. The stored experiment therefore keeps *trained on* (what the
# thesis reports) and *held out* apart, and asks other models the same, by conditioning. Its last
# column is the share of hidden angles inside the 90 % band, as the models give it: not calibrated.

# %%
stored("E5.4")

# %% [markdown]
# ## E5.5 A missing section
#
# **Asked (§5.3.5, Fig. 40):** ten frames are seen, sixty are missing. Now the primitive is needed:
# each frame seen is encoded, and weights, start and goal of the primitive are *conditioned* on
# them. The thesis fills in one line; here the answer is a distribution. The latent paths of the
# training movements are the centres of a mixture of Gaussians over paths, which is conditioned
# exactly on the frames seen, and joint futures are drawn from it.
#
# **The thesis found** an error of 8.1 · 10⁻⁴ ± 3.4 · 10⁻³ rad². It does not say whether the walk
# that was asked for was among those trained on.

# %%
calib, test = unseen.split(by="trial", parts=(0.5, 0.5), seed=0)
seen = 10
horizon = unseen.values.shape[1] - seen
forecast = model.forecast(test.first(seen), horizon=horizon)
legs = ["rfemur_rx", "rtibia_rx"] if real else ["joint_1", "joint_2"]
forecast_bands(forecast, test.values, seen=seen, channels=legs)

# %% [markdown]
# Real: hip and knee pitch of the right leg. These bands are **as the model gives them, not
# calibrated**. Whether they hold what they promise is a question of its own. Half of the held-out
# trials recalibrate the bands, the other half tell how often the truth fell inside:

# %%
future = test.frames(seen, seen + horizon)
raw = model.forecast(test.first(seen), horizon=horizon)
model.calibrate(calib, tasks=["forecast"])
mended = model.forecast(test.first(seen), horizon=horizon)
reliability(
    {
        "as the model gives it": (raw, future.values, future.mask, future.groups),
        "recalibrated": (mended, future.values, future.mask, future.groups),
    }
)

# %% [markdown]
# Few trials calibrate here, so that the recalibrated line is itself uncertain. The full experiment,
# with other models beside it:

# %%
stored("E5.5")

# %% [markdown]
# ## E5.6 Another goal
#
# **Asked (§5.3.6, Fig. 41):** the movement stays what it is, only the attractor $g$ is moved. A
# primitive of plain joint angles would have each joint go its own way; here the goal is encoded,
# and the decoder keeps the joints together. The goals are shares of the way from the first posture
# to the last: 100 % is the demonstration.

# %%
run = runs["trained together, ae-dmp"]
first, last = movement.values[0, 0], movement.values[0, -1]
shares = (0.8, 1.0, 1.2)
figure, axes = plt.subplots(figsize=(8, 3.2), layout="constrained")
joint = int((last - first).abs().argmax())
frames = np.arange(movement.values.shape[1])
for k, share in enumerate(shares):
    goal = first + share * (last - first)
    made = run.generate(movement, goal=goal.numpy())
    low, high = (band[0, :, joint] for band in made.interval(0.9))
    axes.fill_between(frames, low, high, color=f"C{k}", alpha=0.2, lw=0)
    axes.plot(frames, made.mean[0, :, joint], color=f"C{k}", label=f"goal at {share:.0%}")
    axes.plot(frames[-1] + 1, goal[joint], "x", color=f"C{k}")
axes.plot(frames, movement.values[0, :, joint], "k:", label="demonstration")
axes.set(
    xlabel="frame", ylabel=f"{movement.channels[joint]} / rad", title="crosses: the goals asked for"
)
axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1, 0.5))
plt.show()

# %% [markdown]
# The coloured bands are the 90 % bands of the one learned $\sigma$. They say how well the decoder
# knows the demonstration, **not** how sure the model is of a movement that nobody made, and they
# cannot be calibrated: there is no truth. Every movement starts where the demonstration does, and
# its end moves towards the goal, as far as the decoder can make such a posture: it has seen one
# single movement.

# %%
stored("E5.6")

# %% [markdown]
# ## What remains
#
# AE-DMP knows one latent path for a movement and one spread for all joints. It does not say how
# sure it is of the path, and it needs a model for nearly every kind of movement. Both is mended by
# the probabilistic successor: see *Movement primitives in variational autoencoders*.
#
# `zoo experiment` lists all experiments, `zoo experiment E5.1` repeats one and writes table and
# figure into `results/`; `zoo card ae-dmp` has the mathematics, all settings and measured results.
