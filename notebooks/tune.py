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
# # Tune a controller
#
# From a plant to an MPC that holds on plants which are not quite the model. You say what you want; the
# weights are found on draws of the plant's uncertainty.

# %%
import pandas as pd
from matplotlib_inline.backend_inline import set_matplotlib_formats

from thermogrip.datasets import load_example_logs
from thermogrip.mpc import Spec, review, simulate_closed_loop, tune
from thermogrip.report import plot
from thermogrip.sysid import identify

set_matplotlib_formats("png")  # figures are shown under their cells
logs = load_example_logs()
fitted = [logs[name] for name in ("prbs_heating_cooling", "pump_on_off")]
plant = identify(fitted, network="gripper", models=("network",), draws=5).plant

# %% [markdown]
# ## Say what is wanted
#
# One step, few trials: enough to see how it goes. Without the last three numbers `tune` searches longer
# and on more draws.

# %%
spec = Spec(
    steps=[(28.0, 38.0)],
    settle_within_s=150.0,
    overshoot_degC=0.3,
    evaluations=2,
    search_draws=1,
    check_draws=1,
)
found = tune(plant, spec)
print(found.verdict)
shown = ["controller", "settle_mean_s", "settle_worst_s", "overshoot_worst", "bias_worst", "bound_s"]
pd.DataFrame(found.rows)[shown].round(3)

# %% [markdown]
# `baseline` is the default design; the PI got as many trials on the same draws. Where the
# drive is the limit, the verdict says so: then no weight improves the loop.

# %%
controller = found.controller
controller

# %% [markdown]
# ## A closed loop on a plant that is not the model

# %%
loop = simulate_closed_loop(controller, plant.draw(2), [(38.0, 300.0), (30.0, 300.0)], start=28.0)
figure = plot(loop)  # 28 to 38 to 30 degC, on a draw of the plant
figure.set_size_inches(8, 5)
figure

# %% [markdown]
# ## Check the design

# %%
for check in review(controller, wanted=(28.0, 40.0), draws=1):
    print(f"{check.verdict:5} {check.name}")

# %%
print("wrote", controller.save("controller.json"))

# %% [markdown]
# In a loop of your own: `controller.reset(reading)` once, then `controller.step(reading, target)` a
# sample. On hardware: `thermogrip run controller.json --port ...`. More: [tune a
# controller](../howto/tune.md).
