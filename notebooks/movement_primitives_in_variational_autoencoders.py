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
# # Movement primitives in variational autoencoders
#
# Chapter 5 of the thesis moves a body by a movement primitive in the latent space of an
# autoencoder: one model for a movement, one line without a spread. Chapter 6 makes the model
# **probabilistic**: a variational autoencoder whose latent state moves in time like a damped
# spring, pushed by a learned force and disturbed by noise. One model then holds many movements,
# says how sure it is, switches between movements on the way, and is sent to new goals. It is called
# VAE-DMP (`vae-dmp` in the zoo).
#
# This notebook explains the experiments of the chapter:
#
# | experiment | question |
# |---|---|
# | E6.1 | How well does one model reproduce five movements, and how sure is it? |
# | E6.2 | Do like movements lie together in the latent space? |
# | E6.3 | Is the latent space smooth, so that what lies between is a posture, too? |
# | E6.4 | Can it switch from jogging to walking on the way? |
# | E6.5 | Can it be sent to goals it was never shown? |
#
# and, beyond the thesis, movements that repeat, with leaderboards on real walks.
#
# As in the notebook on autoencoders, every section says what is asked, shows the thing itself with
# a **small model trained here** in some twenty seconds, and then the **stored result** of the full
# experiment with the thesis' numbers beside ours. Small models are worse than the full ones; only
# the stored tables count.
#
# With `MOVEZOO_DATA` naming a folder with motion capture, people move: the five movements of the
# thesis, walks and jogs of CMU subject 35. Without it a simulated robot arm takes their place, so
# that the notebook runs everywhere.

# %%
import os
import warnings

import matplotlib.pyplot as plt
import numpy as np
import torch
from IPython.display import Markdown

import zoo
from zoo.datasets.robot_arm import end_effector
from zoo.errors import PosteriorCollapseWarning
from zoo.evaluation.figures.bands import reliability
from zoo.evaluation.figures.postures import posture_map, posture_strips
from zoo.faces.screening import screen_run
from zoo.guides.template import match
from zoo.nn.metric import sensitivity
from zoo.studies import stored

real = bool(os.environ.get("MOVEZOO_DATA"))
plt.rcParams.update({"axes.spines.top": False, "axes.spines.right": False})

# %% [markdown]
# ## The model
#
# The latent state is a position $z_t$ and a velocity $\dot z_t$. In every frame it makes one step
# of a movement primitive: pulled to the goal $z^{\text{goal}}$, pushed by the force $f_t$,
# disturbed by the noise $\varepsilon$,
#
# $$\tau\,\ddot z_{t+1} = \alpha\bigl(\beta\,(z^{\text{goal}} - z_t) - \dot z_t\bigr) + f_t +
# \varepsilon_{t+1},\qquad \dot z_{t+1} = \dot z_t + \ddot z_{t+1}\,dt,\qquad
# z_{t+1} = z_t + \dot z_{t+1}\,dt \tag{74}$$
#
# which is linear in the state: $s_{t+1} = A s_t + b_t$ with $s = (z, \dot z)$, (75)–(77). The frame
# that one sees is decoded from the position, with a standard deviation that does not change in
# time:
#
# $$x_t \sim \mathcal N\bigl(\mu(z_t),\ \operatorname{diag} \sigma^2\bigr) \tag{82, 83}$$
#
# What is not known of a movement is *recognised* by networks: the first state and the goal from
# their own frames (78), the noise of each step from the next frame and the state (79), and the
# weights $w$ of the force from all frames at once,
#
# $$w(x_{1:n}) = g_2\bigl(g_1(x_1), \dots, g_1(x_n)\bigr) \tag{88}$$
#
# All is trained together on the evidence lower bound. The noise could carry the whole movement and
# leave the force nothing to learn; so the bound is tempered at first, $c$ growing from 0.01 to 1:
#
# $$\mathcal L = \mathbb E_q\bigl[c \log p(x_{1:n} \mid z_{1:n}) - \log q(\varepsilon) +
# c \log p(\varepsilon)\bigr] \tag{87}$$
#
# Training takes overlapping windows of ten frames. In the zoo the states of a whole window follow
# from force and noise by one matrix product, without a loop over time.
#
# ## E6.1 Five movements in one model
#
# **Asked (§6.3.1.1, Fig. 45):** walking, balance, kicking, tai chi and punching in one model of 2,
# 3, 5 or 7 latent dimensions, against a model for each. **The thesis found** that the shared models
# of 5 and 7 dimensions beat the AE-DMP of each movement, and that single models are the most
# accurate.
#
# Here: a small model with **two** latent dimensions, so that its whole latent space can be drawn
# (simulated: five straight reaches of the robot arm). Of each movement the joint is shown that
# moves most.

# %%
five = zoo.load_data("thesis-movements" if real else "robot-arm")
names = [str(m).replace("_", " ") for m in five.groups["movement" if real else "goal"]]
plane = zoo.fit(zoo.create("vae-dmp", five, latent_dim=2, max_steps=900, learning_rate=1e-2), five)
paths = plane.represent(five, draws=50).mean
made = plane.generate(five)

low, high = made.interval(0.9)
frames = np.arange(five.values.shape[1])
figure, panels = plt.subplots(2, 3, figsize=(12, 6), layout="constrained")
latent, *others = panels.flat
for k, (axes, name) in enumerate(zip(others, names, strict=True)):
    latent.plot(*paths[k].T, color=f"C{k}", label=name)
    latent.plot(*paths[k, 0], "o", color=f"C{k}")
    joint = int(five.values[k].std(0).argmax())
    band = (low[k, :, joint], high[k, :, joint])
    axes.fill_between(frames, *band, color=f"C{k}", alpha=0.2, lw=0, label="90 % band")
    axes.plot(made.mean[k, :, joint], color=f"C{k}", label="generated")
    axes.plot(five.values[k, :, joint], "k:", label="data")
    axes.set(xlabel="frame", ylabel=f"{five.channels[joint]} / rad")
    axes.set_title(name, color=f"C{k}")
latent.set(xlabel="$z_1$", ylabel="$z_2$", title="latent paths (dot: first frame)")
others[0].margins(y=0.25)
others[0].legend(frameon=False, fontsize=8, ncols=3, loc="upper center")
plt.show()

# %% [markdown]
# A generated movement starts from the first frame and runs freely: goal and force are those that
# the networks recognised, the noise is drawn from its prior. Two dimensions and a short training
# flatten what is quick. The band holds the constant spread of (83) and what the noise adds on the
# way; it is **as the model gives it, not calibrated**. The predicted standard deviation is one of
# the thesis' measures: the less a model knows, the larger it should be.

# %%
error = (plane.reconstruct(five).mean - five.values).double().square().mean()
sd = plane.reconstruct(five).std.mean()
Markdown(
    f"This small model in 2-D: mean squared error {1e4 * error:.1f} · 10⁻⁴ rad², that is "
    f"{error**0.5:.3f} rad; predicted standard deviation {sd:.3f} rad on average."
)

# %%
stored("E6.1")

# %% [markdown]
# ## E6.2 Do like movements lie together?
#
# **Asked (§6.3.1.1, Fig. 47, 48):** with four more walks, of other people, do walks form a cluster?
# And is the latent space better ordered than that of a plain variational autoencoder of single
# frames, which knows nothing of time? **The thesis found** that the five walks lie together, apart
# from the rest, and that paths of a plain VAE have gaps where those of VAE-DMP are even.
#
# In the plot above a movement is already one connected line, and a repeated one closes to a loop:
# the primitive cannot jump. The full experiment measures how far walks are from each other,
# relative to the other movements, and how rough paths are.

# %%
stored("E6.2")

# %% [markdown]
# ## E6.3 Is the latent space smooth?
#
# **Asked (§6.3.1.2, Fig. 49 and 50):** movements are thin lines in the latent space. What is
# between them? If the decoder made jumps there, switching and new goals would be a gamble. Measured
# is how far the body moves for a small step in latent space, the norm of the decoder's Jacobian
#
# $$\Bigl\|\frac{\partial x}{\partial z}\Bigr\|$$
#
# on a grid. **The thesis found** values between 4.7 and 7.4, a ratio of 1.57.

# %%
corner, opposite = paths.amin((0, 1)), paths.amax((0, 1))


def grid(points: int) -> torch.Tensor:
    """Points all over the rectangle that the paths span: row, column, 2."""
    ends = zip(corner.tolist(), opposite.tolist(), strict=True)
    sides = [torch.linspace(a, b, points) for a, b in ends]
    return torch.stack(torch.meshgrid(*sides, indexing="xy"), -1)


radians = plane.scaler.channel_scale.float()
norm = sensitivity(lambda z: plane.model.decode(z).location * radians, grid(120))
coarse = grid(5)
postures = plane.decode(coarse).mean

figure, (left, right) = plt.subplots(1, 2, figsize=(12, 5.4), layout="constrained")
extent = [float(v) for pair in zip(corner, opposite, strict=True) for v in pair]
image = left.imshow(norm, origin="lower", extent=extent, aspect="auto", cmap="cividis")
figure.colorbar(image, ax=left, label="‖dx/dz‖ / rad for a unit of z")
left.set_title(f"largest ÷ least: {norm.max() / norm.min():.1f}")
posture_map(right, postures, five.channels, coarse[0, :, 0].tolist(), coarse[:, 0, 1].tolist())
right.set_title("what is decoded there")
for axes in (left, right):
    for path, k in zip(paths, range(len(names)), strict=True):
        axes.plot(*path.T, color="white" if axes is left else f"C{k}", lw=2, alpha=0.5)
    axes.set(xlabel="$z_1$", ylabel="$z_2$")
plt.show()

# %% [markdown]
# Facets are those of a rectifier network. Between the movements (white and coloured lines) there
# are bodies, not nonsense; at the rim, far from all data, not always. The experiment adds a prior
# that evens the norm out (setting `flatness`):

# %%
stored("E6.3")

# %% [markdown]
# ## E6.4 Switching on the way
#
# **Asked (§6.2.4, §6.3.1.3, Fig. 51):** a person jogs and shall walk from frame 20 on. The model
# knows force and goal of both. Between frame *start* and *start + duration* the one is blended into
# the other, with $\eta$ from 1 to 0 and from 0 to 1:
#
# $$w_t^\star = \frac{\sum_i \eta_t^i\, w^i}{\sum_i \eta_t^i},\qquad
# z_{g,t}^\star = \frac{\sum_i \eta_t^i\, z_g^i}{\sum_i \eta_t^i} \tag{89}$$
#
# The state itself is never touched: it is *driven* from one movement to the other, so that nothing
# jumps. **The thesis shows** that the movement adapts within some frames and then follows the walk.
#
# Here: a small model in five dimensions of half of the trials of walking and jogging, and two
# movements of **other trials** (simulated: a quarter of all reaches, two others switched).

# %%
if real:
    from zoo.studies.chapter5.walking import both

    mixed, parts = both(), (0.5, 0.25, 0.25)
else:
    mixed, parts = zoo.load_data("robot-arm/reaching"), (0.25, 0.5, 0.25)
train, calib, test = mixed.split(by="trial", parts=parts, seed=0)
if real:
    one, other = (list(test.groups["movement"]).index(m) for m in ("jogging", "walking"))
else:
    one, other = 0, int((test.values[:, -1] - test.values[0, -1]).square().sum(-1).argmax())
here, there = test[[one]], test[[other]]
kinds = ("jogging", "walking") if real else ("one reach", "another reach")

model = zoo.fit(
    zoo.create("vae-dmp", train, latent_dim=5, max_steps=1200, learning_rate=1e-2), train
)
switches = {
    (start, steps): model.generate(here, onto=there, start=start, steps=steps)
    for start, steps in ((20, 18), (20, 4), (40, 18))
}
alone = {name: model.generate(m) for name, m in zip(kinds, (here, there), strict=True)}

joint = int((here.values - there.values)[0].square().mean(0).argmax())
seconds = np.arange(here.values.shape[1]) / here.rate
figure, panels = plt.subplots(1, 3, figsize=(12, 3.2), sharey=True, layout="constrained")
for axes, ((start, steps), switch) in zip(panels, switches.items(), strict=True):
    for (name, made), colour in zip(alone.items(), ("C0", "C2"), strict=True):
        axes.plot(seconds, made.mean[0, :, joint], color=colour, label=name)
    low, high = (band[0, :, joint] for band in switch.interval(0.9))
    axes.fill_between(seconds, low, high, color="C1", alpha=0.25, lw=0)
    axes.plot(seconds, switch.mean[0, :, joint], color="C1", label="switched, 90 % band")
    axes.axvspan(
        seconds[start], seconds[start + steps], color="0.93", zorder=0, label="blended, (89)"
    )
    axes.set(xlabel="time / s", title=f"from frame {start} in {steps} frames")
panels[0].set_ylabel(f"{mixed.channels[joint]} / rad")
figure.legend(
    *panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=4, frameon=False
)
plt.show()

# %%
figure, panels = plt.subplots(3, 1, figsize=(11, 5), layout="constrained")
rows = {kinds[0]: alone[kinds[0]], "switched, from frame 20 to 38": switches[20, 18]}
rows[kinds[1]] = alone[kinds[1]]
posture_strips(panels, {k: p.mean[0] for k, p in rows.items()}, mixed.channels)
panels[-1].set_xlabel("frame")
plt.show()

# %% [markdown]
# The bands are those of the generated movements, **not calibrated**: nobody made this movement, so
# that there is no truth to calibrate on. The full experiment:

# %%
stored("E6.4")

# %% [markdown]
# ## Movements that repeat: the rhythmic transition
#
# A walk has no goal to end at. It has a *period*, and a recording may begin anywhere in it. The
# thesis gives the rhythmic primitive for single signals (§2.2.1): the phase $s$ runs round a circle
# at a constant speed, and so do the kernels of the force,
#
# $$f_t = \frac{\sum_i \psi_i(s_t)\,w_i}{\sum_i \psi_i(s_t)},\qquad
# \psi_i(s) = \exp\bigl(h\,(\cos(s - c_i) - 1)\bigr),\qquad
# s_t = \varphi + \frac{2\pi}{P}\,e^{\lambda}\,t \tag{57, 58}$$
#
# The entry `vae-dmp-rhythmic` puts it into VAE-DMP. Phase $\varphi$ and tempo $\lambda$ of a
# movement are two more latent variables, recognised by a template of one period; its frames are
# folded onto the circle before the weights are read off them (88), so that it does not matter where
# a recording begins. A forecast weighs every phase and many tempos by what was seen.
#
# Here: twelve walks of subject 35 to learn from, four to judge (simulated: an arm that stirs,
# twenty times to learn from). Less than a second is observed, and two are forecast.

# %%
if real:
    walks = zoo.load_data("cmu-mocap/35-walk", frames=None, rate=30.0).frames(0, 86)
    walks = walks.select(channels=[c for c in walks.channels if not c.startswith("root")])
else:
    rng = np.random.default_rng(0)
    turns = rng.uniform(0, 2 * np.pi, 24)[:, None] + 2 * np.pi * np.outer(
        rng.normal(0.9, 0.03, 24), np.arange(86) / 30.0
    )
    ways = [0.4 * np.sin(turns[..., None] + np.arange(6)) + 0.1 * np.sin(2 * turns)[..., None]]
    walks = zoo.Sequences.from_arrays(
        ways[0] + rng.normal(0, 0.01, (24, 86, 6)),
        rate=30.0,
        channels=[f"joint_{i}" for i in range(1, 7)],
        units="rad",
        groups={"trial": range(24)},
        name="a stirring arm",
        provenance="simulated",
    )
known, unseen = walks[:-4], walks[-4:]
rhythmic = zoo.fit(zoo.create("vae-dmp-rhythmic", known, stride=3, epochs=80), known)

hip = "rfemur_rx" if real else "joint_2"
column = walks.channels.index(hip)
timing = rhythmic.assembly.guide.template, float(rhythmic.model.period)
scaled = (known.values - known.values.mean((0, 1))).float()
φ, λ = match(scaled, None, *timing).T
seconds = np.arange(86) / walks.rate
figure, (raw, folded) = plt.subplots(1, 2, figsize=(11, 3), sharey=True, layout="constrained")
for k, movement in enumerate(known.values[:12]):
    raw.plot(seconds, movement[:, column], color="C0", alpha=0.4, lw=1)
    s = (φ[k] + 2 * np.pi / timing[1] * λ[k].exp() * torch.arange(86)) % (2 * np.pi)
    folded.plot(s, movement[:, column], ".", color="C0", alpha=0.3, ms=3)
raw.set(xlabel="time / s", ylabel=f"{hip} / rad", title="twelve recordings begin anywhere")
folded.set(xlabel="phase found / rad", title="folded onto the circle")
plt.show()

# %%
short, ahead = 25, 61
forecast = rhythmic.forecast(unseen.frames(0, short), horizon=ahead)
low, high = forecast.interval(0.9)
figure, panels = plt.subplots(1, 3, figsize=(12, 3), sharey=True, layout="constrained")
for k, axes in enumerate(panels):
    axes.plot(seconds, unseen.values[k, :, column], "k:", label="what came")
    axes.plot(seconds[:short], unseen.values[k, :short, column], "k", label="observed")
    axes.plot(seconds[short:], forecast.mean[k, :, column], color="C1", label="forecast")
    band = (low[k, :, column], high[k, :, column])
    axes.fill_between(seconds[short:], *band, color="C1", alpha=0.25, lw=0, label="90 % band")
    axes.set(xlabel="time / s", title=f"trial {unseen.groups['trial'][k]}, never seen")
panels[0].set_ylabel(f"{hip} / rad")
figure.legend(
    *panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=4, frameon=False
)
plt.show()

# %% [markdown]
# The three begin in different phases of a step, and each forecast goes on from where its own
# stands. Bands are **not calibrated** here. How that compares with others is measured on all
# sixteen walks: the *leaderboards*. Of four parts of the walks one is judged, one calibrates the
# bands, and models are trained on the other two. Nothing of the future is used, not even its mean;
# the literature's protocol, which takes each walk less its own mean over all frames, has a board of
# its own (`walk-setup-2-published`). The rivals to beat are a nearest neighbour and a linear
# autoregression. First a long forecast, 100 frames observed and 200 to come at 120 Hz:

# %%
stored("leaderboard_walk-setup-2")

# %% [markdown]
# And a leg that was not recorded:

# %%
stored("leaderboard_walk-missing-leg")

# %% [markdown]
# ## The movement player
#
# A movement should be seen moving. `screen_run` puts side by side what was recorded, how the model
# reproduces it, how it goes on after ten frames, and how it is switched; faint bodies are joint
# draws of what the model holds possible. The same page comes from the command line by `zoo play RUN
# --onto 3`, as a file that needs no network.
#
# Whether the bands of the forecast hold can be tested, because there is a truth: they are
# recalibrated on trials that are in neither training nor test.

# %%
seen = 10
before = model.forecast(test.first(seen), horizon=test.values.shape[1] - seen)
model.calibrate(calib, tasks=["forecast"])
after = model.forecast(test.first(seen), horizon=test.values.shape[1] - seen)
future = test.frames(seen, test.values.shape[1])
truth = (future.values, future.mask, future.groups)
reliability({"as trained": (before, *truth), "recalibrated": (after, *truth)})

# %% [markdown]
# On the diagonal a band holds what it promises. A handful of trials calibrates here, and another
# handful judges: the bars, two standard errors, say how little that settles. See the notebook on
# forecasts for more of it.

# %%
screen_run(model, test, item=one, seen=seen, onto=other, start=20, steps=18)

# %% [markdown]
# Press *Play*, or drag the time line. Before the mark *forecast begins* the third body is not there
# yet. Take off *side by side* to lay all bodies over each other.
#
# ## E6.5 Another goal
#
# **Asked (§6.2.5, §6.3.2, Fig. 53):** a robot arm was shown straight lines from one point to five
# others. Now only the last posture of a sixth line is given. A primitive of single joints reaches
# it, but each joint goes its own way, and the tool leaves the line. To keep the shape of a movement
# when its goal moves, the force is multiplied by the distance to go,
#
# $$f_t \leftarrow f_t\,(z^{\text{goal}} - z_0)$$
#
# in latent space for VAE-DMP, joint by joint for DMP. **The thesis shows** that VAE-DMP stays near
# the straight line and DMP does not.
#
# These data are simulated in any case. Settings are those of the full experiment, with a fifth of
# its training: one force common to all movements (`common_forcing`), so that the weights of a
# movement carry nothing of their own. The zoo would warn of that; it is meant, and the warning is
# silenced.

# %%
lines, optimal = zoo.load_data("robot-arm"), zoo.load_data("robot-arm/held-out")
settings = {
    "latent_dim": 2,
    "hidden": 100,
    "features": 5,
    "window": 76,
    "activation": "softplus",
    "goal_scaling": True,
    "common_forcing": 1e-3,
    "noise_scale": 1e-3,
    "fixed_noise": True,
}
with warnings.catch_warnings():
    warnings.simplefilter("ignore", PosteriorCollapseWarning)
    reaching = zoo.fit(zoo.create("vae-dmp", lines, epochs=1200, **settings), lines)
plain = zoo.fit(zoo.create("dmp", lines[:1]), lines[:1])

figure, axes = plt.subplots(figsize=(6.5, 5), layout="constrained")
for k, path in enumerate(end_effector(lines.values.double())):
    axes.plot(*path[:, :2].T, color="0.85", label=None if k else "shown")
table = ["| goal | primitive of joints, cm | VAE-DMP, cm |", "|---|---|---|"]
for k, goal in enumerate(optimal.groups["goal"]):
    best = end_effector(optimal.values[k].double())
    axes.plot(*best[:, :2].T, color="0.5", lw=5, alpha=0.4, label=None if k else "best")
    axes.annotate(goal, best[-1, :2], xytext=(4, 4), textcoords="offset points")
    errors = []
    for run, colour, name in ((plain, "C1", "primitive of joints"), (reaching, "C0", "VAE-DMP")):
        made = run.generate(lines[:1], goal=optimal.values[k, -1].double().numpy())
        tip = end_effector(made.mean[0].double())
        axes.plot(*tip[:, :2].T, color=colour, label=None if k else name)
        errors.append(100 * float((tip - best).norm(dim=1).mean()))
    table.append(f"| {goal} | {errors[0]:.1f} | {errors[1]:.1f} |")
axes.set(xlabel="x / m", ylabel="y / m", aspect="equal", title="the tool, seen from above")
axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1, 0.5))
plt.show()

# %% [markdown]
# Mean distance of the tool from where it should be at the same time:

# %%
Markdown("\n".join(table))

# %% [markdown]
# p_6 lies between the goals shown, p_7 beyond them, where a decoder that was trained for so short a
# time does not know the arm. Trained in full, it does:

# %%
stored("E6.5")

# %% [markdown]
# ## Where to go on
#
# `zoo experiment` lists all experiments, and `zoo experiment E6.1` repeats one and writes table and
# figure into `results/`. `zoo card vae-dmp` has the mathematics, all settings and measured results.
# How the forecasts of this model compare to others on walks never seen, with calibrated bands, is
# the subject of *Forecasts with calibrated bands on motion capture*.
