"""Stiffness and mass are not determined apart. What ends that?"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import rfdropo_bayes as rb

EXPERIMENTS = Path(__file__).resolve().parents[1] / "experiments"
runs = rb.read(["demo/demo_1.nc", "demo/demo_2.nc"], folder=EXPERIMENTS)
priors = {
    "young_modulus": {"distribution": "LogNormal", "median": 2e6, "sigma": 0.5},
    "trunk_mass": {"distribution": "LogNormal", "median": 0.09, "sigma": 0.5},
    "rayleigh_stiffness": {"distribution": "LogNormal", "median": 0.05, "sigma": 0.7},
}
coarse = {"refine": 1, "time_step": 0.02, "precision": "float32"}
model = rb.Model("smooth_arm", priors=priors, simulator=coarse)
weighed = runs[0].settings["parameters"]["trunk_mass"]  # as a scale would show it, to 1 %
known = {"distribution": "LogNormal", "median": weighed, "sigma": 0.01}
heavy = rb.Model("smooth_arm", priors=priors | {"trunk_mass": known}, simulator=coarse)

figure, axes = plt.subplots(figsize=(5, 3.6), layout="constrained")
spread = {}
for words, each in (("recordings alone", model), ("and the arm weighed", heavy)):
    fit = rb.calibrate(each, runs, rb.Laplace(starts=1), seed=0, show=False)
    draws = {name: fit.idata.posterior[name].values.ravel() for name in ("trunk_mass", "young_modulus")}
    axes.plot(draws["trunk_mass"], 1e-6 * draws["young_modulus"], ".", markersize=3, alpha=0.4, label=words)
    spread[words] = float(np.std(np.log(draws["young_modulus"])))
axes.set_xlabel("mass of the trunk [kg]")
axes.set_ylabel("Young's modulus [MPa]")
axes.legend()
figure.savefig(sys.argv[1] if len(sys.argv) > 1 else "weigh_a_part.png")
print(", ".join(f"{words}: +-{100 * value:.1f} %" for words, value in spread.items()))
assert spread["and the arm weighed"] < 0.1 * spread["recordings alone"]
