"""A policy drives motors over CANopen. What does a session record, and did it get there?"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np

import rfdropo_bayes as rb

MOTORS = Path(__file__).resolve().parents[1] / "experiments" / "motors"
GOAL = np.array([0.01, -0.03, 0.13])  # as reach.toml has it [m]

if __name__ == "__main__":  # the simulated drives are a process of their own
    with TemporaryDirectory() as folder:
        session = Path(folder) / "session"
        outcome = rb.deploy(MOTORS / "reach.toml", "dry-run", session)
        assert outcome.finished, outcome.detail
        (run,) = rb.read("session.nc", folder=session)

    figure, axes = plt.subplots(2, 1, figsize=(8, 4.5), sharex=True, layout="constrained")
    axes[0].plot(run.time, 1e3 * run.position[:, -1], label=["x", "y", "z"])
    axes[0].set_prop_cycle(None)
    for value in GOAL:
        axes[0].axhline(1e3 * value, linestyle=":", color="0.5")
    axes[0].set_ylabel("tip and goal [mm]")
    axes[0].legend()
    axes[1].step(run.command_time, 1e3 * run.command, where="post", label=run.cable_names)
    axes[1].set(xlabel="time [s]", ylabel="pull that was sent [mm]")
    axes[1].legend(fontsize="small", loc="upper left", bbox_to_anchor=(1.0, 1.0))
    figure.savefig(sys.argv[1] if len(sys.argv) > 1 else "run_a_motor_session.png")
    end = 1e3 * float(np.linalg.norm(run.position[-10:, -1].mean(axis=0) - GOAL))
    print(f"{len(run.time)} rows; the tip ends {end:.1f} mm from the goal")
    assert end < 10.0
