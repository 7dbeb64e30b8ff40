# ---
# jupyter:
#   jupytext:
#     formats: py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Name a material
#
# A finger touches a block of another temperature; what its skin then reads says what the block is made
# of. The grasps are the simulated examples that come with the package; `read_grasps("mine.csv")` reads
# yours.

# %%
import matplotlib.pyplot as plt
import pandas as pd

from thermogrip.classify import Stream, classify_grasps, evaluate, make_classifier
from thermogrip.datasets import load_example_grasps

sets = load_example_grasps()
grasps = sets["exp1A_obj43_grip23"]
grasps

# %%
figure, axis = plt.subplots(figsize=(8, 3.5), layout="constrained")
materials = sorted(set(grasps["material"].values.tolist()))
for number, material in enumerate(materials):
    for trace in grasps["t_surface"].values[grasps["material"].values == material]:
        axis.plot(grasps["time"], trace, color=f"C{number}", linewidth=0.8)
    axis.plot([], [], color=f"C{number}", label=material)
axis.set(xlabel="time since contact [s]", ylabel="skin [degC]", xlim=(-2, 10))
axis.legend(ncols=len(materials))
plt.show()

# %% [markdown]
# ## Which classifier?
#
# Trained and tested on the split that comes with the grasps. An accuracy stands beside its n and its 95 %
# interval; the log loss says whether the stated probabilities can be believed.

# %%
comparison = evaluate(["posterior", "bayes", "pca-lda"], grasps)
comparison

# %%
shown = ["classifier", "accuracy", "low", "high", "n", "log_loss"]
pd.DataFrame(comparison.scores())[shown].round(2)

# %% [markdown]
# ## Train one and ask it

# %%
train = grasps.isel(grasp=grasps["split"].values == "train")
test = grasps.isel(grasp=grasps["split"].values == "test")
finger = make_classifier("posterior").fit(train)
truth = test["material"].values.tolist()
for material, row in list(zip(truth, classify_grasps(finger, test)))[:6]:
    named = f"p {row['p_' + row['material']]:.2f}, none of them {row['p_unknown']:.2f}"
    print(f"{material:10} -> {row['material']:10} {named}")

# %% [markdown]
# ## While it touches
#
# The probabilities as they grow, sample by sample.

# %%
one = test.isel(grasp=[0])
touch = Stream(finger, t_object=float(one["t_object"].values[0]), t_ambient=float(one["t_ambient"].values[0]))
times, grown = [], []
for time, reading in zip(one["time"].values, one["t_surface"].values[0]):
    if time >= -1.0:
        p = touch.update(float(time), float(reading))
        times.append(time)
        grown.append(p)
figure, axis = plt.subplots(figsize=(8, 3), layout="constrained")
for number, material in enumerate(finger.classes_):
    axis.plot(times, [p[material] for p in grown], color=f"C{number}", label=material)
axis.set(xlabel="time since contact [s]", ylabel="probability", title=f"it is {one['material'].values[0]}")
axis.legend(ncols=len(finger.classes_))
plt.show()

# %% [markdown]
# Next: [use your own grasps](../howto/own-grasps.md), [touch twice, stop early](../howto/two-touches.md),
# or [name materials in a robot's program](../howto/robot.md).
