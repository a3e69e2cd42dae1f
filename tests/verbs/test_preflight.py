"""What is said before a fit: the ridge of a spring, what ends it, commands that excite nothing, the cost of a fit."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import rfdropo_bayes as rb
from rfdropo_bayes.cli.main import app
from rfdropo_bayes.verbs.preflight import (
    ROLLOUTS,
    _Coordinates,
    _covariance,
    _directions,
    _Noise,
    innovations,
    preflight,
)

REPOSITORY = Path(__file__).resolve().parents[2]
STEP = 0.02
TIME = STEP * np.arange(151)


def spring(parameters, command):
    """A mass on a spring whose end is moved: its motion knows stiffness over mass, and its damping ratio; the force in
    the spring knows the stiffness."""
    omega = np.sqrt(parameters["stiffness"] / parameters["mass"])[:, None]
    ratio = parameters["ratio"][:, None]
    x, v, found = command[:, :1, 0], np.zeros_like(command[:, :1, 0]), []
    for row in range(command.shape[1]):
        if row:
            for _ in range(10):
                v = v + 0.1 * STEP * (omega**2 * (command[:, row : row + 1, 0] - x) - 2.0 * ratio * omega * v)
                x = x + 0.1 * STEP * v
        found.append(x)
    place = np.stack(found, axis=1)
    pull = parameters["stiffness"][:, None, None] * (command - place)
    return {"position": np.concatenate([place, 0.0 * place, 0.1 + 0.0 * place], axis=-1)[:, :, None], "tension": pull}


def wide(median, sigma=0.5):
    prior = {"distribution": "LogNormal", "median": median, "sigma": sigma}
    return {"low": 1e-3 * median, "high": 1e3 * median, "nominal": median, "prior": prior}


def model(*, tension=False, cables=("end",), sigma=0.5, **more):
    mass = {**wide(0.5, sigma), "unit": "kg"}
    parameters = {"stiffness": {**wide(20.0), "unit": "N/m"}, "mass": mass, "ratio": wide(0.2)}
    box = rb.BlackBox(
        spring,
        parameters=parameters,
        markers=["tip"],
        channels=["end"],
        cables=cables,
        time_step=STEP,
        batched=True,
        name="spring",
    )
    return rb.Model(box, noise={"standard_deviation": 5e-4}, tension=tension, **more)


def recording(size=0.03):
    command = np.repeat(np.random.default_rng(0).uniform(-size, size, 15), 10)[:, None]
    place = np.stack([np.linspace(0.0, 0.01, len(TIME)), 0.0 * TIME, 0.1 + 0.0 * TIME], axis=-1)[:, None]
    given = {"markers": ["tip"], "channels": ["end"], "name": "run", "initial_command": "zero"}
    tension = np.ones((len(TIME), 1))
    return rb.Trajectory.from_arrays(
        time=TIME, position=place, command=command, command_time=TIME[:-1], tension=tension, **given
    )


def test_the_scale_of_stiffness_and_mass_is_the_ridge_and_a_force_or_a_balance_ends_it():
    found = rb.check(model(), [recording()])
    (direction,) = found.directions
    assert direction.sentence.startswith("the common scale of stiffness and mass")
    together = direction.together
    assert set(together) == {"stiffness", "mass"}
    assert together["stiffness"] == pytest.approx(together["mass"], rel=0.02)  # k / m stays as it is
    assert direction.kept == pytest.approx(1.0, abs=0.01)
    ends = list(direction.ended_by)
    assert any("tensions" in what for what in ends)
    assert any("mass weighed" in what for what in ends)
    assert not any("ratio" in what for what in ends)
    # only the ratio is known: the mass keeps s_k / sqrt(s_k^2 + s_m^2) of its prior spread
    shares = found.parameters["kept"]
    assert shares["mass"] == pytest.approx(np.sqrt(0.5), rel=0.05)  # the sd of 2000 draws is known to 1.6 %
    assert shares["ratio"] < 0.1


def test_a_ridge_is_named_whole_where_one_of_its_parameters_is_known_far_better():
    """In prior standard deviations the stiffness takes a tenth of the step that the mass takes."""
    (direction,) = rb.check(model(sigma=0.05), [recording()]).directions
    assert direction.sentence.startswith("the common scale of stiffness and mass")


def test_a_draw_that_snaps_hides_no_ridge():
    """One draw of eight whose slopes are those of a jump, along a direction that the others do not show at all."""
    information = np.zeros((8, 2, 2))
    information[:, 0, 0] = 1e4
    information[3] = [[1e8, 1e8], [1e8, 1e8]]
    kept = np.sqrt(np.diag(_covariance(information)))
    assert kept[0] < 0.3
    assert kept[1] == pytest.approx(np.sqrt(7.5 / 8.0), rel=1e-3)  # half of its variance is left at the draw that snaps


def test_what_is_measured_leaves_no_ridge():
    assert rb.check(model(tension=True), [recording()]).directions == []
    weighed = model(weighed=[{"parameters": ["mass"], "value": 0.5, "sd": 0.005}])
    assert rb.check(weighed, [recording()]).directions == []


def test_rows_over_lasting_noise_are_those_of_the_whole_covariance_and_lost_ones_say_nothing():
    """Against the dense covariance of the rows that were measured; and twenty minutes at 100 Hz take no longer than
    their rows."""
    rng = np.random.default_rng(0)
    time = np.cumsum(rng.uniform(0.01, 0.05, 60))
    noise, series = _Noise(1e-3, 2e-3, 0.2, ""), rng.normal(size=(60, 2, 3, 2, 3))
    valid = np.ones((60, 2), dtype=bool)
    valid[10:25, 0], valid[0, 1] = False, False
    white = innovations(series, time, valid, noise)
    covariance = noise.lasting**2 * np.exp(-np.abs(np.subtract.outer(time, time)) / noise.time)
    covariance += noise.white**2 * np.eye(60)
    for marker in range(2):
        seen = valid[:, marker]
        own = series[seen, 1, 2, marker, 0]
        expected = own @ np.linalg.solve(covariance[np.ix_(seen, seen)], own)
        assert np.sum(white[:, 1, 2, marker, 0] ** 2) == pytest.approx(expected)
    assert np.all(white[~valid[:, 0], :, :, 0] == 0.0)
    rows = 120_000
    assert innovations(np.ones((rows, 1, 3)), 0.01 * np.arange(rows), np.ones((rows, 1), dtype=bool), noise)[-1].all()


def test_commands_that_do_not_move_excite_nothing():
    found = rb.check(model(), [recording(size=0.0)])
    assert len(found.directions) == 3
    assert (found.parameters["alone"] > 0.99).all()
    assert found.channels == {"run": ["end"]}
    assert "run: end never moved" in str(found)


def test_a_direction_of_many_parameters_names_the_largest_parts():
    names = [f"gain_{k}" for k in range(9)]
    vector = np.linspace(1.0, 0.6, 9)
    information = 1e4 * (np.eye(9) - np.outer(vector, vector) / (vector @ vector))
    coordinates = _Coordinates(tuple(names), np.zeros(9, dtype=bool), np.zeros(9), np.ones(9), np.zeros(9, dtype=bool))
    (direction,) = _directions(coordinates, information[None], {})
    assert list(direction.together) == names
    assert direction.sentence.startswith(f"{' and '.join(names[:6])} up together, and 3 smaller parts (keeps 100 %")


def test_parameters_that_need_a_measurement_of_their_own_share_a_sentence():
    flags = np.zeros(3, dtype=bool)
    coordinates = _Coordinates(("stiffness", "offset", "zero"), flags, np.zeros(3), np.ones(3), flags)
    own = {f"{name} measured by itself (to 1 %)": 1e4 * np.diag(row)[None] for name, row in zip(
        coordinates.names, np.eye(3), strict=True)}  # fmt: skip
    found = _directions(coordinates, np.diag([1e4, 0.0, 0.0])[None], own)
    assert [direction.needs_own_measurement for direction in found] == [True, True]
    told = replace(preflight(model(), [recording()]), directions=found)
    assert "undetermined  offset, zero (each keeps at least 100 % of its prior spread; nothing but" in str(told)


def test_the_cost_is_that_of_the_budget():
    found = preflight(model(), [recording()])
    assert found.minutes == pytest.approx(ROLLOUTS * found.rollout_seconds / 60.0)
    assert f"smc: {ROLLOUTS} rollouts" in str(found)
    json.dumps(found.as_dict())
    assert "common scale" in found._repr_html_()


@pytest.mark.slow
def test_an_arm_of_mujoco_with_stiff_drives_leaves_a_common_scale(tmp_path):
    pytest.importorskip("mujoco")
    path = tmp_path / "arm.xml"
    path.write_text("""
<mujoco><option timestep="0.005" gravity="0 0 0" integrator="implicitfast"/><worldbody><body name="hand">
  <joint name="base" axis="0 1 0" armature="1"/><geom size="0.01" mass="1e-3"/>
  <body name="rod" pos="0 0 -0.02"><joint name="bend" axis="0 1 0" stiffness="0.05" damping="0.002"/>
    <geom type="capsule" size="0.01" fromto="0 0 0 0 0 -0.2" mass="0.05"/><site name="tip" pos="0 0 -0.2"/>
  </body></body></worldbody>
  <actuator><position name="drive" joint="base" kp="5000" kv="140"/></actuator></mujoco>""")
    given = {"mass": "body/rod/mass", "stiffness": "joint/bend/stiffness", "damping": "joint/bend/damping"}
    box = rb.MuJoCo(path, parameters=given)
    assert box.command_unit == "rad"
    walk = {"duration": 2.0, "interval": 0.2, "step": 0.2, "low": -0.5, "high": 0.5, "sample_time": 0.02}
    arm = rb.Model(box, noise={"standard_deviation": 5e-4})
    runs = rb.simulate(arm, {**walk, "recordings": ["a"]})
    found = rb.check(arm, runs)
    (direction,) = found.directions
    assert set(direction.together) == {"mass", "stiffness", "damping"}
    np.testing.assert_allclose(list(direction.together.values()), direction.together["mass"], rtol=0.1)
    assert next(iter(direction.ended_by)).startswith(("mass weighed", "stiffness", "damping"))
    assert found.seconds < 60.0


@pytest.mark.slow
def test_check_says_it_of_the_demo(tmp_path):
    out = tmp_path / "check"
    told = CliRunner().invoke(app, ["check", str(REPOSITORY / "experiments" / "demo.toml"), "--out", str(out)])
    assert told.exit_code == 0, told.output
    assert "the common scale of young_modulus and trunk_mass" in told.output
    content = json.loads((out / "check.json").read_text())
    direction = next(d for d in content["preflight"]["directions"] if "young_modulus" in d["together"])
    assert any("tensions" in what for what in direction["ended_by"])
    assert any("trunk_mass weighed" in what for what in direction["ended_by"])
