"""I have a minute with the robot. Which commands should I record next?"""

import sys

import matplotlib.pyplot as plt
import numpy as np

import rfdropo_bayes as rb

TRUTH = {"young_modulus": 1.6e6, "rayleigh_stiffness": 0.03}
priors = {
    "young_modulus": {"distribution": "LogNormal", "median": 2e6, "sigma": 0.5},
    "rayleigh_stiffness": {"distribution": "LogNormal", "median": 0.05, "sigma": 0.7},
}
noise = {"standard_deviation": 1e-3}
model = rb.Model("smooth_arm", priors=priors, noise=noise, simulator={"refine": 1, "time_step": 0.01})

# What there is: a recording that hardly moves.
walk = {"duration": 1.5, "interval": 0.5, "step": 0.002, "low": 0.0, "high": 0.004, "sample_time": 0.05}
first = rb.simulate(model, {**walk, "recordings": ["first"]}, parameters=TRUTH, noise=noise, seed=0)

proposal = rb.design(model, first, seed=0)
print(proposal.sentence)
channels = [name for name in proposal.commands if name != "time_s"]
time = first[0].time
sent = np.stack([np.interp(time, proposal.commands["time_s"], proposal.commands[name]) for name in channels], axis=1)
blank = rb.Trajectory.from_arrays(
    time=time,
    position=np.repeat(first[0].position[:1], len(time), axis=0),
    command=sent,
    markers=first[0].marker_names,
    channels=first[0].cable_names,
    name="designed",
)
designed = rb.simulate(model, [blank], parameters=TRUTH, noise=noise, seed=1)
again = rb.simulate(model, {**walk, "recordings": ["again"]}, parameters=TRUTH, noise=noise, seed=2)

figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
axes[0].step(time, 1e3 * sent, where="post", label=first[0].cable_names)
axes[0].set(xlabel="time [s]", ylabel="pull [mm]", title="proposed", ylim=(-0.1, 3.2))  # room for the legend
axes[0].legend(ncols=4, fontsize="small", loc="upper center")
spread = {}
for words, second in (("a second recording like the first", again), ("the proposed recording", designed)):
    fit = rb.calibrate(model, [*first, *second], rb.Laplace(starts=1), seed=0, show=False)
    draws = fit.idata.posterior["rayleigh_stiffness"].values.ravel()
    axes[1].hist(1e3 * draws, bins=30, density=True, alpha=0.5, label=words)
    spread[words] = float(np.std(np.log(draws)))
axes[1].axvline(1e3 * TRUTH["rayleigh_stiffness"], color="k", label="truth")
axes[1].set(xlabel="stiffness damping [ms]", title="after a second recording")
axes[1].legend()
figure.savefig(sys.argv[1] if len(sys.argv) > 1 else "design_the_next_recording.png")
print(", ".join(f"{words}: damping to {100 * value:.1f} %" for words, value in spread.items()))
assert spread["the proposed recording"] < 0.85 * spread["a second recording like the first"]
