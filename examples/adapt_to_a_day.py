"""Today the cables were tightened anew. Must I calibrate again?"""

import sys

import matplotlib.pyplot as plt
import numpy as np

import rfdropo_bayes as rb

priors = {
    "young_modulus": {"distribution": "LogNormal", "median": 2e6, "sigma": 0.3},
    "rayleigh_stiffness": {"distribution": "LogNormal", "median": 0.05, "sigma": 0.5},
    "initial_displacement": {},
}
model = rb.Model(
    "smooth_arm",
    priors=priors,
    simulator={"refine": 1, "time_step": 0.01},
    noise="white",
    groups={"monday": "monday_*", "today": "today_*"},
    per_group={"initial_displacement": 2e-3},
)
walk = {"duration": 2.0, "interval": 0.1, "step": 0.01, "low": 0.0, "high": 0.02, "sample_time": 0.05}
noise = {"standard_deviation": 5e-4}
monday = rb.simulate(model, {**walk, "recordings": ["monday_1"]}, noise=noise, seed=1)
zeros = [name for name in model.parameters.index if name.startswith("initial_displacement")]
tightened = dict(zip(zeros, (2e-3, -1e-3, 1.5e-3, -2e-3), strict=True))
today = rb.simulate(model, {**walk, "recordings": ["today_1", "today_2"]}, parameters=tightened, noise=noise, seed=2)

fit = rb.calibrate(model, monday, rb.Laplace(starts=1), seed=0, show=False)
adapted = rb.adapt(fit, today[0], seed=0, show=False)

figure, axes = plt.subplots(figsize=(8, 3.2), layout="constrained")
errors = {}
for words, each in (("from its first row", fit), ("after 2 s of another recording", adapted)):
    drawn = rb.predict(each, today[1], seed=0).drawn.predicted
    tip = drawn.mean(axis=0)[:, -1]
    axes.plot(today[1].time, 1e3 * tip[:, 0], label=words)
    errors[words] = 1e3 * float(np.sqrt(np.mean(np.sum((tip - today[1].position[:, -1]) ** 2, axis=1))))
axes.plot(today[1].time, 1e3 * today[1].position[:, -1, 0], "k.", markersize=3, label="measured")
axes.set(xlabel="time [s]", ylabel="tip, x [mm]")
axes.legend()
figure.savefig(sys.argv[1] if len(sys.argv) > 1 else "adapt_to_a_day.png")
print(", ".join(f"{words}: {error:.2f} mm" for words, error in errors.items()))
first, after = errors.values()
assert after < 0.6 * first
