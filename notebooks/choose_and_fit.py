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
# # Choose a model by name and fit it
#
# A robot arm reaches for points on a table. Twelve simulated operators steer it, each in their own
# manner: some hurry, some overshoot. We choose a model that can *forecast*, train it, and look at
# what it learned. Everything here takes a minute on two cores.

# %%
import matplotlib.pyplot as plt
import numpy as np

import zoo

# %% [markdown]
# ## The data
#
# A data set is a record: values with units, a rate, names of the channels, and **groups**. We split
# by trial, so that the movements we test on were never seen in training.

# %%
data = zoo.load_data("robot-arm/reaching")
train, val, calib, test = data.split(by="trial", parts=(0.6, 0.1, 0.15, 0.15), seed=0)

figure = plt.figure(figsize=(9, 3.2), layout="constrained")
seconds = np.arange(data.values.shape[1]) / data.rate
for axes, joint in zip(figure.subplots(1, 3, sharex=True), (0, 1, 2), strict=True):
    degrees = np.rad2deg(data.values[:30, :, joint].T.numpy())
    axes.plot(seconds, degrees, color="C0", alpha=0.35, lw=1)
    axes.set(title=data.channels[joint], xlabel="time / s", ylabel="angle / °")
figure.suptitle(f"30 of {len(data)} reaching movements, {data.provenance}")
plt.show()

# %% [markdown]
# ## The choice
#
# `zoo.list_models` takes a glob and a capability. A capability is never claimed by hand: it is
# there when the model has the method.

# %%
zoo.list_models(can="forecast")

# %% [markdown]
# Let us take VAE-DMP (chapter 6 of the thesis): a variational autoencoder whose latent state is
# moved by a *dynamic movement primitive*, a damped spring that is pulled to a goal and shaped by a
# learned force. `zoo.create` binds the entry to our data; unknown settings are refused by name.

# %%
model = zoo.create("vae-dmp", train, latent_dim=3, max_steps=3000)
run = zoo.fit(model, train, val=val)

figure = plt.figure(figsize=(9, 3), layout="constrained")
left, right = figure.subplots(1, 2)
epochs = [row["epoch"] for row in run.history]
left.plot(epochs, [-row["reconstruction"] for row in run.history])
left.set(title="reconstruction", xlabel="epoch", ylabel="nats a window (less is better)")
right.plot(epochs, [row["kl"] for row in run.history], color="C1")
right.set(title="Kullback-Leibler divergence", xlabel="epoch", ylabel="nats a window")
plt.show()

# %% [markdown]
# The two parts of the evidence lower bound, apart. While the bound is tempered (87) the noise has
# no easy way to carry the movement, so that the force of the primitive has to learn it.
#
# ## What it learned
#
# The latent path of each test movement, coloured by time: smooth, as the primitive demands.

# %%
latent = run.represent(test).mean
figure = plt.figure(figsize=(5.5, 4.5), layout="constrained")
axes = figure.subplots()
for path in latent[:8]:
    points = axes.scatter(path[:, 0], path[:, 1], c=seconds[: path.shape[0]], s=9, cmap="viridis")
figure.colorbar(points, label="time / s")
axes.set(title="latent paths of eight unseen movements", xlabel="$z_1$", ylabel="$z_2$")
plt.show()

# %% [markdown]
# ## How good is it?
#
# `zoo.evaluate` poses every task that the model can do on the test movements. Coverage says which
# share of the truth fell inside the bands; before calibration it may be far from what it promises.

# %%
run.calibrate(calib)
zoo.evaluate(run, test, tasks=["forecast", "reconstruct"])

# %% [markdown]
# The run keeps model, guide, scaling, calibration and history together. `run.save("arm.zoo")`
# writes safetensors and JSON, and `zoo.load` gives the same predictions bit for bit.
