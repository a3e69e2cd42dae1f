"""A MuJoCo arm calibrated beside mujoco.sysid and SciPy's least squares, on the same simulated recordings.

    python benchmarks/mujoco_sysid.py [--datasets 5]

Three joints with gravity, markers at elbow and tip with 0.3 mm of white noise, two seconds of torques; the damping of
each joint and the mass of the last link are unknown. One table: error, share of the 90 % intervals that hold the truth,
their width, and seconds. mujoco.sysid needs ``pip install "mujoco[sysid]"`` and is left out without it. The seconds of
each method are those of a whole fit, compilation included, after one fit that is not counted.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from mujoco import rollout
from scipy.optimize import least_squares

import rfdropo_bayes as rb

ARM = """
<mujoco model="arm">
  <option integrator="implicitfast" timestep="0.005"><flag contact="disable"/></option>
  <worldbody><body name="one" pos="0 0 1">
    <joint name="j1" axis="0 1 0" damping="0.2" armature="0.01"/>
    <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.3" mass="0.8"/>
    <body name="two" pos="0 0 -0.3"><joint name="j2" axis="0 1 0" damping="0.2" armature="0.01"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.25" mass="0.5"/><site name="elbow"/>
      <body name="three" pos="0 0 -0.25"><joint name="j3" axis="1 0 0" damping="0.2" armature="0.01"/>
        <inertial pos="0 0 -0.1" mass="0.3" diaginertia="0.001 0.001 0.0002"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.2"/><site name="tip" pos="0 0 -0.2"/>
      </body></body></body></worldbody>
  <actuator><motor name="m1" joint="j1"/><motor name="m2" joint="j2"/><motor name="m3" joint="j3"/></actuator>
  <sensor>
    <framepos name="elbow" objtype="site" objname="elbow"/><framepos name="tip" objtype="site" objname="tip"/>
  </sensor>
</mujoco>"""
PARAMETERS = {f"damping_{k}": f"joint/j{k}/damping" for k in (1, 2, 3)} | {"mass": "body/three/mass"}
TRUTH = np.array([0.31, 0.14, 0.22, 0.42])
START = np.array([0.2, 0.2, 0.2, 0.3])
LOW, HIGH = 0.01, 2.0
NOISE, SECONDS, STEP = 3e-4, 2.0, 0.005
LEVEL = 1.645  # of 90 %


class Fit(NamedTuple):
    """Estimates, half widths of the 90 % intervals, and seconds."""

    value: np.ndarray
    half: np.ndarray
    seconds: float


def changed(values: np.ndarray) -> mujoco.MjModel:
    """The arm with other values; the last link's inertia goes with its mass."""
    spec = mujoco.MjSpec.from_string(ARM)
    for joint, damping in zip(("j1", "j2", "j3"), values, strict=False):
        spec.joint(joint).damping[0] = damping
    link = spec.body("three")
    link.inertia = np.asarray(link.inertia) * values[3] / link.mass
    link.mass = values[3]
    return spec.compile()


def recorded(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Torques, clean and noisy positions of the markers (row, 6)."""
    rng = np.random.default_rng(seed)
    ctrl = np.repeat(rng.uniform(-0.8, 0.8, (round(SECONDS / 0.2), 3)), round(0.2 / STEP), axis=0)
    clean = moved(TRUTH, ctrl)
    return ctrl, clean, clean + NOISE * rng.standard_normal(clean.shape)


def moved(values: np.ndarray, ctrl: np.ndarray) -> np.ndarray:
    """Positions in front of every step."""
    model = changed(values)
    state = np.zeros(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    return rollout.rollout(model, mujoco.MjData(model), state, ctrl)[1][0]


def by_scipy(ctrl: np.ndarray, seen: np.ndarray) -> Fit:
    """Least squares, and intervals of its Jacobian."""
    begun = time.perf_counter()
    found = least_squares(lambda x: (moved(x, ctrl) - seen).ravel(), START, bounds=(LOW, HIGH), x_scale=START)
    covariance = np.linalg.inv(found.jac.T @ found.jac) * 2.0 * found.cost / (len(found.fun) - len(START))
    return Fit(found.x, LEVEL * np.sqrt(np.diag(covariance)), time.perf_counter() - begun)


def by_sysid(ctrl: np.ndarray, seen: np.ndarray) -> Fit:
    """mujoco.sysid with its own optimiser and intervals, as they are by default: every coordinate is scaled by its own
    size, so that the one that shows noise only (y of the elbow) makes up most of the residual variance."""
    from mujoco import sysid

    begun = time.perf_counter()
    spec = mujoco.MjSpec.from_string(ARM)
    model = spec.compile()
    data = mujoco.MjData(model)
    start = sysid.create_initial_state(model, data.qpos, data.qvel, data.act)
    times = STEP * np.arange(len(ctrl) + 1)
    controls = sysid.TimeSeries(times, np.concatenate([ctrl, ctrl[-1:]]))
    sensors = sysid.TimeSeries.from_names(times[1:], seen, model)

    def mass(own: mujoco.MjSpec, parameter: object) -> None:
        link = own.body("three")
        link.inertia = np.asarray(link.inertia) * parameter.value[0] / link.mass  # type: ignore[attr-defined]
        link.mass = parameter.value[0]  # type: ignore[attr-defined]

    def damping(joint: str) -> Callable:
        def modify(own: mujoco.MjSpec, parameter: object) -> None:
            own.joint(joint).damping[0] = parameter.value[0]  # type: ignore[attr-defined]

        return modify

    parameters = sysid.ParameterDict()
    changes = [damping("j1"), damping("j2"), damping("j3"), mass]
    for name, value, change in zip(PARAMETERS, START, changes, strict=True):
        parameters.add(sysid.Parameter(name, value, LOW, HIGH, modifier=change))
    sequence = sysid.ModelSequences("arm", spec, "run", start, controls, sensors)
    residual = sysid.build_residual_fn(models_sequences=[sequence])
    best, result = sysid.optimize(initial_params=parameters, residual_fn=residual, verbose=False)
    half = sysid.calculate_intervals(residual(result.x, best)[0], result.jac, alpha=0.1)[1]
    return Fit(best.as_vector(), np.ravel(half), time.perf_counter() - begun)


def by_us(ctrl: np.ndarray, seen: np.ndarray, path: Path) -> Fit:
    """`rb.calibrate` with Laplace's method; the size of the noise is inferred as well."""
    begun = time.perf_counter()
    prior = {"distribution": "LogUniform", "low": LOW, "high": HIGH}
    tables = {n: {"address": a, "low": LOW, "high": HIGH, "prior": prior} for n, a in PARAMETERS.items()}
    model = rb.Model(rb.MuJoCo(path, markers=["elbow", "tip"], parameters=tables), noise="white")
    clock = STEP * np.arange(len(seen))
    run = rb.Trajectory.from_arrays(
        time=clock,
        position=seen.reshape(len(seen), 2, 3),
        command=ctrl,
        markers=["elbow", "tip"],
        channels=["m1", "m2", "m3"],
        command_unit="N m",
        initial_command="first",
    )
    fit = rb.calibrate(model, [run], rb.Laplace(rollouts=1000, starts=2), show=False)
    rows = fit.summary.loc[list(PARAMETERS)]
    return Fit(
        rows["mean"].to_numpy(float), 0.5 * (rows["q95"] - rows["q05"]).to_numpy(float), time.perf_counter() - begun
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--datasets", type=int, default=5)
    count = parser.parse_args().datasets
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.xml"
        path.write_text(ARM)
        methods: dict[str, Callable[[np.ndarray, np.ndarray], Fit]] = {"SciPy least squares": by_scipy}
        try:
            from mujoco.sysid import optimize  # noqa: F401

            methods["mujoco.sysid"] = by_sysid
        except ImportError:
            print('mujoco.sysid is left out: pip install "mujoco[sysid]"')
        methods["rfdropo_bayes, laplace"] = lambda ctrl, seen: by_us(ctrl, seen, path)
        print("| method | error, rms [%] | held by 90 % intervals | their half width [%] | seconds |")
        print("|---|---|---|---|---|")
        for name, method in methods.items():
            fits = [method(*recorded(seed)[::2]) for seed in range(count + 1)][1:]
            error = np.array([fit.value / TRUTH - 1.0 for fit in fits])
            half = np.array([fit.half / TRUTH for fit in fits])
            held = np.mean(np.abs(error) <= half)
            print(
                f"| {name} | {100 * np.sqrt(np.mean(error**2)):.3f} | {held:.2f} of {error.size} "
                f"| {100 * half.mean():.3f} | {np.mean([fit.seconds for fit in fits]):.1f} |"
            )


if __name__ == "__main__":
    main()
