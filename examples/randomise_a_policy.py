"""Which parameters will a policy see that is trained under my posterior?"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import rfdropo_bayes as rb

VIRTUAL = Path(__file__).resolve().parents[1] / "experiments" / "virtual"
priors = {
    "young_modulus": {"distribution": "Uniform", "low": 2e6, "high": 7e6},
    "trunk_mass": {"distribution": "Uniform", "low": 0.005, "high": 1.0},
}
fast = {"precision": "float32"}
model = rb.Model("virtual_trunk", priors=priors, mechanisms=["actuator_lag"], noise="ar1", simulator=fast)
fit = rb.calibrate(model, rb.read("reach_1.nc", folder=VIRTUAL), rb.Laplace(starts=1), seed=0, show=False)

venv = rb.make_vec("TrunkReach-v0", model, fit=fit, n=64)
venv.seed(0)
venv.reset()
seen = {name: np.array([info["parameters"][name] for info in venv.reset_infos]) for name in priors}
draws = fit.idata.posterior

figure, axes = plt.subplots(figsize=(5, 3.6), layout="constrained")
axes.plot(draws["trunk_mass"].values.ravel(), 1e-6 * draws["young_modulus"].values.ravel(), ".", color="0.7")
axes.plot(seen["trunk_mass"], 1e-6 * seen["young_modulus"], "o", label="64 episodes")
axes.set_xlabel("mass of the trunk [kg]")
axes.set_ylabel("Young's modulus [MPa]")
axes.legend()
figure.savefig(sys.argv[1] if len(sys.argv) > 1 else "randomise_a_policy.png")

# Whole draws: stiffness and mass stay together as the recording has them.
together = float(np.corrcoef(np.log(seen["trunk_mass"]), np.log(seen["young_modulus"]))[0, 1])
print(f"correlation of log mass and log modulus over the episodes: {together:.3f}")
assert together > 0.9
