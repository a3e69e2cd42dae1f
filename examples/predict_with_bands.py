"""What will the arm do under commands that were never run, and how sure is that?"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import rfdropo_bayes as rb

EXPERIMENTS = Path(__file__).resolve().parents[1] / "experiments"
runs = rb.read(["demo/demo_1.nc", "demo/demo_2.nc"], folder=EXPERIMENTS)
(unseen,) = rb.read("demo/demo_3.nc", folder=EXPERIMENTS)
priors = {
    "young_modulus": {"distribution": "LogNormal", "median": 2e6, "sigma": 0.5},
    "poisson_ratio": {"distribution": "Uniform", "low": 0.4, "high": 0.499},
    "trunk_mass": {"distribution": "LogNormal", "median": 0.09, "sigma": 0.5},
    "rayleigh_stiffness": {"distribution": "LogNormal", "median": 0.05, "sigma": 0.7},
}
model = rb.Model("smooth_arm", priors=priors, simulator={"refine": 1, "time_step": 0.02, "precision": "float32"})
fit = rb.calibrate(model, runs, rb.Laplace(starts=1), seed=0, show=False)

# Of the recording only the commands and the first row are looked at.
ahead = rb.predict(fit, unseen, seed=0)
figure, axes = plt.subplots(figsize=(8, 3.2), layout="constrained")
ahead.plot(axis="y", ax=axes)
axes.plot(unseen.time, 1e3 * unseen.position[:, -1, 1], "k.", markersize=2, label="measured afterwards")
axes.legend()
figure.savefig(sys.argv[1] if len(sys.argv) > 1 else "predict_with_bands.png")

low, high = (np.quantile(ahead.drawn.predicted, level, axis=0) for level in (0.05, 0.95))
held = float(np.mean((low <= unseen.position) & (unseen.position <= high)))
print(f"the 90 % bands hold {100 * held:.0f} % of what was then measured")
assert 0.8 < held < 1.0
