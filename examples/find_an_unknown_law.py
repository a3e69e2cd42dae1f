"""What acts on my robot is in no library. Where does it enter, and by what law?"""

import sys

import matplotlib.pyplot as plt

import rfdropo_bayes as rb

HIDDEN = 12.0  # [1/m]: cable left moves by so much times the product of the pulls of cables up and left
priors = {
    "young_modulus": {"distribution": "LogNormal", "median": 2e6, "sigma": 0.3},
    "rayleigh_stiffness": {"distribution": "LogNormal", "median": 0.05, "sigma": 0.5},
}
coarse = {"refine": 1, "time_step": 0.01}
noise = {"standard_deviation": 5e-4}
crosstalk = {"coefficient": "crosstalk", "feature": "product", "commands": ["up", "left"], "scale": 20.0}
law = {"port": "cable left", "terms": [crosstalk]}
robot = rb.Model("smooth_arm", priors=priors, laws=[law], simulator=coarse)
model = rb.Model("smooth_arm", priors=priors, noise=noise, simulator=coarse)

# In the place of the robot: the same arm, whose cable left is moved by cable up as well.
walk = {"duration": 3.0, "interval": 0.2, "step": 0.006, "low": 0.0, "high": 0.02, "sample_time": 0.05}
named = {**walk, "recordings": ["one", "two", "three", "four"]}
runs = rb.simulate(robot, named, parameters={"crosstalk": HIDDEN}, noise=noise, seed=1)

found = rb.audit(model, runs[:3], test=runs[3:], seed=0)
print(found.sentence)
figure, axes = plt.subplots(figsize=(8, 3.4), layout="constrained")
found.plot_unseen("x", ax=axes)
figure.savefig(sys.argv[1] if len(sys.argv) > 1 else "find_an_unknown_law.png")
(term,) = found.content["law"]["terms"]
print(f"{found.content['law']['formula']}: {term['mean']:.2f} +- {term['sd']:.2f} {term['unit']}, hidden {HIDDEN:g}")
assert found.verdict == "described"
assert (term["port"], term["feature"]) == ("cable left", "product")
assert abs(term["mean"] - HIDDEN) < 3.3 * term["sd"]  # fails for one right posterior in a thousand
