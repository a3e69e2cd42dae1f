"""I have a CSV file of my arm. How stiff is it?"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import rfdropo_bayes as rb

TRUTH = {"young_modulus": 5e5, "rayleigh_stiffness": 0.08}
arm = rb.Robot.outline(
    name="finger",
    shape="cone",
    length=0.12,
    radius=0.012,
    tip_radius=0.008,
    cables=4,
    markers={"middle": 0.06, "tip": 0.12},
    gravity="+z",
    mass=0.04,
    young_modulus=8e5,
)
model = rb.Model(arm, priors={name: {} for name in TRUTH}, simulator={"time_step": 0.02})

# In the place of a measurement: a simulated one with 0.3 mm of noise, as a CSV file in millimetres.
walk = {"duration": 4.0, "interval": 0.25, "step": 0.003, "low": 0.0, "high": 0.012, "sample_time": 0.05}
run = rb.simulate(model, {**walk, "recordings": ["monday"]}, parameters=TRUTH, noise={"standard_deviation": 3e-4})[0]
pulls = 1e3 * run.command[np.searchsorted(run.command_time, run.time + 1e-9) - 1]
places = 1e3 * run.position.reshape(len(run.time), -1)
names = [f"{marker}_{axis}" for marker in ("middle", "tip") for axis in "xyz"]
table = pd.DataFrame(np.column_stack([run.time, pulls, places]), columns=["t", "c1", "c2", "c3", "c4", *names])

with TemporaryDirectory() as folder:
    table.to_csv(Path(folder) / "monday.csv", index=False)
    columns = {
        "time": "t",
        "commands": ["c1", "c2", "c3", "c4"],
        "command_unit": "mm",
        "positions": [names[:3], names[3:]],
        "position_unit": "mm",
        "markers": ["middle", "tip"],
        "cables": list(arm.channel_names),
    }
    read = rb.read("monday.csv", folder=folder, format="csv", columns=columns)

fit = rb.calibrate(model, read, rb.Laplace(starts=1), seed=0, show=False)
figure, axes = plt.subplots(1, 2, figsize=(10, 3.2), layout="constrained")
fit.plot_fit(ax=axes[0])
fit.plot_prior_posterior("young_modulus", ax=axes[1])
figure.savefig(sys.argv[1] if len(sys.argv) > 1 else "calibrate_a_csv.png")
row = fit.summary.loc["young_modulus"]
print(f"Young's modulus {row['mean']:.4g} +- {row['sd']:.2g} Pa, truth {TRUTH['young_modulus']:g} Pa")
assert abs(row["mean"] - TRUTH["young_modulus"]) < 3.3 * row["sd"]  # fails for one right posterior in a thousand
