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
# # A sparse Gaussian process with its bands
#
# Chapter 3 of the thesis reads the force of a finger from the colour of its nail, with a Gaussian
# process on ten thousand images. An exact one would need the inverse of a 10,000 × 10,000 matrix;
# a **sparse** one summarises the data by a few hundred inducing inputs. Here we look at what that
# costs, on a problem small enough to see.

# %%
import matplotlib.pyplot as plt
import numpy as np

import zoo

rng = np.random.default_rng(0)
pressure = np.sort(rng.uniform(0, 10, 300))
truth = lambda x: 4 * np.tanh((x - 2) / 2) + 0.8 * np.sin(2 * x)  # noqa: E731
force = truth(pressure) + rng.normal(scale=0.4, size=300)
gap = (pressure > 5.0) & (pressure < 7.8)
data = zoo.Pairs.from_arrays(
    pressure[~gap, None], force[~gap], features=["pressure"], channels=["f_z"], units="N"
)

# %% [markdown]
# ## Exact and sparse, side by side
#
# `gp` is exact. `fitc` (Snelson and Ghahramani) and `vfe` (Titsias) see the data through twelve
# inducing inputs. There is a gap in the data: an honest band widens there.

# %%
grid = np.linspace(-1, 11, 400)[:, None]
runs = {
    name: zoo.fit(zoo.create(name, data, **settings), data)
    for name, settings in {"gp": {}, "fitc": {"inducing": 12}, "vfe": {"inducing": 12}}.items()
}

figure, panels = plt.subplots(1, 3, figsize=(11, 3.6), sharey=True, layout="constrained")
for axes, (name, run) in zip(panels, runs.items(), strict=True):
    prediction = run.regress(grid)
    low, high = (band[:, 0] for band in prediction.interval(0.9))
    axes.fill_between(grid[:, 0], low, high, color="C0", alpha=0.25, label="90 % band")
    axes.plot(grid[:, 0], prediction.mean[:, 0], color="C0", label="mean")
    axes.plot(grid[:, 0], truth(grid[:, 0]), "k--", lw=1, label="truth")
    axes.plot(pressure[~gap], force[~gap], ".", color="0.5", ms=3)
    axes.set(title=name, xlabel="pressure / a.u.")
panels[0].set_ylabel("force / N")
panels[0].legend(frameon=False, fontsize=8)
plt.show()

# %% [markdown]
# ## Noise and ignorance apart
#
# A prediction splits its spread into **aleatoric** (the sensor's noise, which no data removes) and
# **epistemic** (what the model does not know). Only the second grows in the gap and at the ends.

# %%
prediction = runs["gp"].regress(grid)
plt.figure(figsize=(7, 3), layout="constrained")
plt.plot(grid[:, 0], prediction.aleatoric[:, 0], label="aleatoric")
plt.plot(grid[:, 0], prediction.epistemic[:, 0], label="epistemic")
plt.plot(grid[:, 0], prediction.std[:, 0], "k:", label="together")
plt.axvspan(5.0, 7.8, color="0.92")
plt.xlabel("pressure / a.u.")
plt.ylabel("standard deviation / N")
plt.legend(frameon=False)
plt.show()

# %% [markdown]
# ## Do the bands hold?
#
# New data from the same source, never seen: the coverage of each band, with its standard error.

# %%
fresh = rng.uniform(0, 10, 400)
test = zoo.Pairs.from_arrays(
    fresh[:, None],
    truth(fresh) + rng.normal(scale=0.4, size=400),
    features=["pressure"],
    channels=["f_z"],
    units="N",
)
zoo.Table.join([zoo.evaluate(run, test) for run in runs.values()])

# %% [markdown]
# FITC and VFE disagree where inducing inputs are too few: FITC calls what it cannot explain small
# noise at the inducing inputs, VFE calls it large noise everywhere. The zoo prints both noise
# levels and warns where they part.
