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
# # Identify a plant
#
# From two logs to a plant with intervals, checked on a third log that the fit has not seen. The logs are
# the simulated examples that come with the package; `identify("my_log.csv")` takes a file of yours, and a
# DataFrame as well.

# %%
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from thermogrip.datasets import load_example_logs
from thermogrip.sysid import free_run, identify, plant_dynamics

logs = load_example_logs()
logs["prbs_heating_cooling"]

# %% [markdown]
# ## Compare models
#
# The thermal network `gripper` beside a black box. Each is fitted to a part of the logs and scored by
# free run on the rest: it sees the inputs alone.

# %%
found = identify(
    [logs["prbs_heating_cooling"], logs["pump_on_off"]], network="gripper", models=("arx", "network")
)
found

# %% [markdown]
# ## The parameters
#
# With the interval that the logs support. What they do not identify is listed as such.

# %%
plant = found.plant
plant

# %% [markdown]
# ## A log that it has not seen

# %%
test = logs["multisine"]
run = free_run(plant, test)
score = run.scores["t_surface"]
print(f"free run of t_surface: RMSE {score.rmse:.3f} degC over {score.n} samples")

# %%
simulated = plant.simulate(test)
time = test["time"]
rows = {"sharex": True, "height_ratios": (3, 1), "layout": "constrained"}
figure, (above, below) = plt.subplots(2, 1, figsize=(8, 5), **rows)
above.plot(time, test["t_surface"], color="0.6", label="measured")
above.plot(time, simulated["t_surface"], "--", color="C1", label="predicted from the inputs alone")
above.set_ylabel("skin [degC]")
above.legend()
below.plot(time, test["t_surface"].values - simulated["t_surface"].values, color="0.4")
below.set(xlabel="time [s]", ylabel="residual [K]", ylim=(-0.5, 0.5))
plt.show()

# %% [markdown]
# ## What it does about an operating point

# %%
near = plant_dynamics(plant, inputs={"drive": 0.3}, disturbances={"t_ambient": 22.0})
print("time constants [s]:", np.round(near.time_constants[:4], 1))
pd.DataFrame(near.rows())

# %%
print("wrote", plant.save("plant.json"))

# %% [markdown]
# Next: [tune a controller](tune.md) for it. Of logs of your own: [use your own
# logs](../howto/own-logs.md).
