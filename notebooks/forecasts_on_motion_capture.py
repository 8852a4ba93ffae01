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
# # Forecasts with calibrated bands on motion capture
#
# A walk is seen for a moment; how does it go on, and how sure can we be? This notebook trains
# VAE-DMP on real walks (CMU subject 35) when `MOVEZOO_DATA` names a folder with them, and on the
# simulated robot arm otherwise, so that it runs everywhere. The walks are cut into windows of 70
# frames at 60 Hz, so that a forecast may start at any moment of a step. The notebook then asks the
# one question that a band must answer: *does 90 % of the truth fall into the 90 % band, on
# movements never seen?*

# %%
import os

import matplotlib.pyplot as plt
import numpy as np
import torch

import zoo
from zoo.evaluation.figures.bands import forecast_bands, reliability

real = bool(os.environ.get("MOVEZOO_DATA"))
if real:
    walks = zoo.load_data("cmu-mocap/35-walk", frames=None, rate=60.0)
    data = walks.windows(70, stride=20)
else:
    data = zoo.load_data("robot-arm/reaching")
train, val, calib, test = data.split(by="trial", parts=(0.5, 0.1, 0.2, 0.2), seed=0)
seen, horizon = 10, 60

plt.figure(figsize=(9, 3), layout="constrained")
joint = int(torch.argmax(data.values.var((0, 1))))
seconds = np.arange(data.values.shape[1]) / data.rate
for movement in data.values[:12]:
    plt.plot(seconds, np.rad2deg(movement[:, joint].numpy()), color="C0", alpha=0.5, lw=1)
plt.axvspan(0, seen / data.rate, color="0.9", label="seen by the forecast")
plt.xlabel("time / s")
plt.ylabel("angle / °")
plt.title(f"{data.channels[joint]} in {min(12, len(data))} windows of {data.name}")
plt.legend(frameon=False)
plt.show()

# %% [markdown]
# ## Train, then forecast
#
# The forecast is a distribution. Its mean is a guess; its bands are a promise. The latent state of
# the frames seen is filtered, the force and the goal of the primitive are conditioned on it, and
# joint futures are drawn and decoded. What conditions them is a prior over whole latent
# paths, learned from the training movements after the networks (see `zoo card vae-dmp`).

# %%
run = zoo.fit(zoo.create("vae-dmp", train, latent_dim=5, max_steps=4000), train, val=val)
prediction = run.forecast(test.first(seen), horizon=horizon)
forecast_bands(prediction, test.values, seen=seen)

# %% [markdown]
# Solid black: what the model saw. Blue: mean, 50 % and 90 % band of the forecast. Dashed: truth.
#
# ## Is the promise kept?
#
# A model learns its own standard deviation from few movements, and tends to be too sure. We
# correct it on **calibration movements** that neither training nor test has seen.

# %%
before = run.forecast(test.first(seen), horizon=horizon)
run.calibrate(calib, tasks=["forecast"])
after = run.forecast(test.first(seen), horizon=horizon)
future = test.frames(seen, seen + horizon)
reliability(
    {
        "as trained": (before, future.values, future.mask, future.groups),
        "recalibrated": (after, future.values, future.mask, future.groups),
    }
)

# %% [markdown]
# On the diagonal the bands hold what they promise **on average over all joints and lead times**: a
# fast joint may still leave its band more often than a slow one. The bars are two standard errors
# over trials, of which there are few. Now against baselines: the
# mean of the training movements, the last value, an autoregression, the nearest neighbour.

# %%
tables = []
for name in ("mean", "last-value", "ar", "nearest-neighbour"):
    rival = zoo.fit(zoo.create(name, train), train).calibrate(calib, tasks=["forecast"])
    tables.append(zoo.evaluate(rival, test, tasks=["forecast"]))
tables.append(zoo.evaluate(run, test, tasks=["forecast"]))
zoo.Table.join(tables)

# %% [markdown]
# Read error and coverage together: a small error with a band that misses is worse than a larger
# one that tells you so. CRPS and the energy score weigh both.
