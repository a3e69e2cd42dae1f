"""My simulator is MuJoCo. What are its joint's parameters?"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt

import rfdropo_bayes as rb

ARM = """
<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="upper"><joint name="drive" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.1" size="0.01" mass="0.05"/>
      <body name="lower" pos="0 0 -0.1"><joint name="elbow" axis="0 1 0" stiffness="0.1" damping="0.002"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.1" size="0.008" mass="0.03"/><site name="tip" pos="0 0 -0.1"/>
      </body>
    </body>
  </worldbody>
  <actuator><position name="motor" joint="drive" kp="4" kv="0.2"/></actuator>
</mujoco>"""
TRUTH = {"stiffness": 0.15, "damping": 0.004}

with TemporaryDirectory() as folder:
    path = Path(folder) / "arm.xml"
    path.write_text(ARM)
    arm = rb.MuJoCo(
        path,
        markers={"tip": "tip"},
        channels={"motor": "motor"},
        parameters={"stiffness": "joint/elbow/stiffness", "damping": "joint/elbow/damping"},
    )
    model = rb.Model(arm, priors={name: {} for name in TRUTH}, noise="white")
    walk = {"duration": 3.0, "interval": 0.3, "step": 0.3, "low": -0.6, "high": 0.6, "sample_time": 0.03}
    noise = {"standard_deviation": 5e-4}
    runs = rb.simulate(model, {**walk, "recordings": ["one", "two"]}, parameters=TRUTH, noise=noise, seed=2)
    fit = rb.calibrate(model, runs, rb.Laplace(starts=1), seed=0, show=False)

figure, axes = plt.subplots(1, 2, figsize=(10, 3.2), layout="constrained")
fit.plot_fit(marker="tip", axis="x", ax=axes[0])
fit.plot_pair(["stiffness", "damping"], ax=axes[1])
figure.savefig(sys.argv[1] if len(sys.argv) > 1 else "mujoco_arm.png")
for name, value in TRUTH.items():
    row = fit.summary.loc[name]
    print(f"{name}: {row['mean']:.4g} +- {row['sd']:.2g} {row['unit']}, truth {value:g}")
    assert abs(row["mean"] - value) < 3.3 * row["sd"]  # fails for one right posterior in a thousand
