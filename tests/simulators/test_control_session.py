"""Sessions behind the simulator: periods with partial resets are whole rollouts, and state is plain arrays."""

from __future__ import annotations

import functools

import jax
import numpy as np
import pytest

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.mechanisms import mechanisms_named
from rfdropo_bayes.mechanisms.laws import Law, LawChoice, make_law
from rfdropo_bayes.mechanisms.ports import port_map
from rfdropo_bayes.robots import DriveTravel, Robot
from rfdropo_bayes.simulators.body_engine import Backend, Engine, Integrator
from rfdropo_bayes.simulators.control_session import Session
from rfdropo_bayes.simulators.protocol import Result
from rfdropo_bayes.simulators.trunk import Discretisation, TrunkSimulator, assemble

PERIOD, PERIODS, LANES = 0.05, 8, 5
MECHANISMS = ("command_delay", "actuator_lag", "backlash", "viscoelasticity", "sensor_lag", "marker_offset")
VALUES = {
    "command_delay": 0.023,
    "actuator_lag": 0.04,
    "backlash": 5e-4,
    "prony_fraction": 0.4,
    "prony_time": 0.3,
    "sensor_lag": 0.06,
}


@functools.cache
def simulator(
    engine: str,
    precision: str = "float64",
    mechanisms: tuple[str, ...] = (),
    state: str = "rest",
    integrator: Integrator = "euler",
):
    """The paper's trunk; its drives ramp every command over two periods, and here answer late, as far as they reach."""
    robot = Robot.load("trunk_sofa")
    names, kinds = robot.channel_names, ("lost", "clipped", "kept")
    drives = tuple(DriveTravel(cables=names[k:6:3], low=-0.004, high=0.018, beyond=kinds[k]) for k in range(3))
    timing = robot.command.model_copy(update={"dead_time_s": 0.013})
    robot = robot.model_copy(update={"command": timing, "initial_state": state, "drives": drives})
    discretisation = Discretisation(robot.time_step_s)
    assembly = assemble(robot, discretisation)
    backend = Backend(engine, precision)
    computed = Engine(assembly, robot.time_step_s, backend, state == "equilibrium", integrator=integrator)
    return TrunkSimulator(robot, computed, assembly, discretisation, mechanisms_named(mechanisms, robot))


def drawn(values: dict[str, float], seed: int = 0):
    """Parameters of every lane, and what it is commanded in every period [m]."""
    random = np.random.default_rng(seed)
    parameters = {
        "young_modulus": 4.5e6 * random.uniform(0.7, 1.3, LANES),
        "trunk_mass": random.uniform(0.2, 0.6, LANES),
    }
    parameters |= {name: value * random.uniform(0.5, 1.5, LANES) for name, value in values.items()}
    steps = 0.005 * random.integers(-1, 3, (LANES, PERIODS, 8))
    return parameters, np.cumsum(steps, axis=1)


def rollouts(model, parameters, commands):
    """Whole rollouts of the same commands."""
    grid = [
        model.commands(PERIOD * np.arange(PERIODS), taken, np.zeros(8), PERIOD * np.arange(PERIODS + 1))
        for taken in (model.taken("", np.zeros(8), sent) for sent in commands)
    ]
    stacked = jax.tree.map(lambda *parts: np.stack(parts), *grid)
    return jax.jit(jax.vmap(model.rollout))(parameters, stacked)


def run(model, parameters, commands, late=(1, 3)):
    """In a session, some lanes of which start anew later than the others."""
    session = Session(model, LANES, PERIOD)
    everyone = np.arange(LANES)
    session.reset(everyone, {"young_modulus": 3e6})
    for _ in range(2):
        session.act(np.full((LANES, 8), 0.01))
    others = np.setdiff1d(everyone, late)
    session.reset(others, {name: value[others] for name, value in parameters.items()})
    session.act(np.where(np.isin(everyone, late)[:, None], 0.02, commands[:, 0]))
    seen = [None] * LANES
    session.reset(np.array(late), {name: value[list(late)] for name, value in parameters.items()})
    for period in range(PERIODS):
        age = np.where(np.isin(everyone, late), period, period + 1) % PERIODS
        now = session.act(commands[everyone, age])
        for lane in everyone:
            if age[lane] == period or period < PERIODS - 1:
                seen[lane] = (age[lane] + 1, jax.tree.map(lambda part, lane=lane: part[lane], now))
        yield session, seen


@pytest.mark.parametrize("integrator", [pytest.param("euler", marks=pytest.mark.slow), "sdirk2"])
@pytest.mark.parametrize("precision", ["float64", pytest.param("float32", marks=pytest.mark.slow)])
@pytest.mark.parametrize("state", ["rest", pytest.param("equilibrium", marks=pytest.mark.slow)])
def test_a_session_is_a_rollout_bit_for_bit(precision, state, integrator):
    model = simulator("numba", precision, (), state, integrator)
    parameters, commands = drawn({})
    whole = rollouts(model, parameters, commands)
    compared = 0
    for _, seen in run(model, parameters, commands):
        for lane, (row, now) in enumerate(seen):
            np.testing.assert_array_equal(now.position, whole.position[lane, row])
            np.testing.assert_array_equal(now.tension, whole.tension[lane, row])
            np.testing.assert_array_equal(now.motor_angle, whole.motor_angle[lane, row])
            assert now.status == whole.status[lane] == 0
            compared += 1
    assert compared == LANES * PERIODS
    assert np.ptp(whole.position, axis=1).max() > 0.02


@pytest.mark.parametrize(("engine", "tolerance"), [("numba", 0.0), pytest.param("jax", 1e-9, marks=pytest.mark.slow)])
def test_the_largest_tension_of_a_period_is_that_of_the_rollouts_steps(engine, tolerance):
    model = simulator(engine)
    parameters, commands = drawn({})
    steps = round(PERIOD / model.time_step)
    every = model.time_step * np.arange(steps * PERIODS + 1)
    grid = [
        model.commands(PERIOD * np.arange(PERIODS), model.taken("", np.zeros(8), sent), np.zeros(8), every)
        for sent in commands
    ]
    stacked = jax.tree.map(lambda *parts: np.stack(parts), *grid)
    whole = np.asarray(jax.jit(jax.vmap(model.rollout))(parameters, stacked).tension)
    session = Session(model, LANES, PERIOD)
    begun = session.reset(np.arange(LANES), parameters)
    np.testing.assert_array_equal(begun.peak, begun.tension)
    higher = 0
    for period in range(PERIODS):
        now = session.act(commands[:, period])
        largest = whole[:, steps * period + 1 : steps * (period + 1) + 1].max(axis=1)
        np.testing.assert_allclose(now.peak, largest, rtol=tolerance, atol=1e-12)
        higher += np.sum(now.peak > now.tension)
    assert higher > 0


PUSHED = {"cube_x": 0.012, "cube_z": 0.15, "cube_mass": 0.05, "friction": 0.3}


@pytest.mark.parametrize(
    ("engine", "precision", "tolerance"),
    [
        ("numba", "float64", 0.0),
        pytest.param("numba", "float32", 0.0, marks=pytest.mark.slow),  # compiles for most of a minute
        pytest.param("jax", "float64", 1e-9, marks=pytest.mark.slow),
    ],
)
def test_a_cube_is_pushed_as_in_a_rollout(engine, precision, tolerance):
    """Pose, velocity and warm starts of every lane's contacts are its own."""
    model, compiled = simulator(engine, precision).pushing(), simulator("numba", precision).pushing()
    parameters, commands = drawn({name: PUSHED[name] for name in ("cube_mass", "friction")})
    down = np.zeros(8)
    down[[2, 6]] = 0.02  # the cables below
    commands = np.clip(0.2 * commands, 0.0, 0.03) + down * np.linspace(0.3, 2.0, PERIODS)[:, None]
    commands[..., 6] = np.minimum(commands[..., 6], 0.04)
    parameters |= {"cube_x": np.full(LANES, PUSHED["cube_x"]), "cube_z": np.full(LANES, PUSHED["cube_z"])}
    whole = rollouts(compiled, parameters, commands)
    way = np.linalg.norm(whole.object_pose[:, -1, :3] - whole.object_pose[:, 0, :3], axis=-1)
    assert way.min() > 1e-3, "nothing was pushed"
    for _, seen in run(model, parameters, commands):
        for lane, (row, now) in enumerate(seen):
            np.testing.assert_allclose(now.position, whole.position[lane, row], rtol=0.0, atol=tolerance)
            np.testing.assert_allclose(
                now.object_pose, whole.object_pose[lane, row], rtol=0.0, atol=10 * tolerance + 1e-15
            )
            assert now.status == whole.status[lane] == Result.OK


@pytest.mark.slow
def test_a_trunk_that_lies_still_stays_still_for_a_minute():
    """Pulled down onto plate or cube, and aside: held there by friction, it moves by less than 0.01 mm in 60 s."""
    model = simulator("numba").pushing()
    lanes = np.arange(8)
    pull = np.array([20.0, 30.0, 15.0, 20.0, 30.0, 15.0, 20.0, 30.0]) * 1e-3
    aside = np.array([0.0, 5.0, 0.0, 8.0, 0.0, 4.0, 0.0, 5.0]) * 1e-3
    values = {
        "young_modulus": np.array([4.5, 4.5, 2.0, 2.0, 7.0, 3.0, 4.5, 4.5]) * 1e6,
        "friction": np.array([0.3, 0.3, 0.3, 1.0, 0.3, 0.1, 0.3, 0.3]),
        "cube_x": np.where(lanes < 5, 0.3, 0.0),
    }
    commands = np.zeros((len(lanes), 8))
    commands[:, 2], commands[:, 3] = pull, aside
    session = model.session(len(lanes), 1.0)
    session.reset(lanes, values)
    for second in range(30):
        before = session.act(commands * min(1.0, (second + 1) / 4))
    for _ in range(60):
        after = session.act(commands)
    assert (after.status == Result.OK).all()
    assert before.position[:, :, 1].min(axis=1).max() < -0.08, "it lies on nothing"
    assert np.linalg.norm(after.position - before.position, axis=-1).max() < 1e-5
    assert np.linalg.norm(after.object_pose - before.object_pose, axis=-1).max() < 1e-5


@pytest.mark.parametrize(("engine", "tolerance"), [("numba", 1e-13), pytest.param("jax", 1e-9, marks=pytest.mark.slow)])
def test_mechanisms_carry_their_state(engine, tolerance):
    """To rounding, as XLA rounds the same expressions differently in different programs."""
    model = simulator(engine, mechanisms=MECHANISMS)
    parameters, commands = drawn(VALUES)
    base = rollouts(simulator("numba"), {name: parameters[name] for name in ("young_modulus", "trunk_mass")}, commands)
    whole = rollouts(simulator("numba", mechanisms=MECHANISMS), parameters, commands)
    assert np.abs(whole.position - base.position).max() > 1e-3, "they do nothing"
    for _, seen in run(model, parameters, commands):
        for lane, (row, now) in enumerate(seen):
            np.testing.assert_allclose(now.position, whole.position[lane, row], rtol=0.0, atol=tolerance)
            np.testing.assert_allclose(now.motor_angle, whole.motor_angle[lane, row], rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("engine", ["numba", pytest.param("jax", marks=pytest.mark.slow)])
def test_a_state_is_saved_restored_and_copied(engine, tmp_path):
    model = simulator(engine, mechanisms=MECHANISMS)
    parameters, commands = drawn(VALUES)
    session = Session(model, LANES, PERIOD)
    session.reset(np.arange(LANES), parameters)
    for period in range(3):
        session.act(commands[:, period])
    np.savez(tmp_path / "state.npz", **session.save())
    state = dict(np.load(tmp_path / "state.npz"))
    expected = [session.act(commands[:, period]) for period in range(3, 6)]
    other = Session(model, LANES, PERIOD)
    other.reset(np.arange(LANES), {name: value[::-1] for name, value in parameters.items()})
    other.act(commands[:, 7])
    other.restore({name: part[[2, 4]] for name, part in state.items()}, np.array([4, 0]))
    for period, seen in enumerate(expected, start=3):
        found = other.act(commands[[4, 1, 2, 3, 2], period])
        np.testing.assert_array_equal(found.position[[4, 0]], seen.position[[2, 4]])
        np.testing.assert_array_equal(found.motor_angle[[4, 0]], seen.motor_angle[[2, 4]])
    np.testing.assert_array_equal(other.parameters["backlash"][[4, 0]], parameters["backlash"][[2, 4]])
    np.testing.assert_allclose(other.time, PERIOD * np.array([6, 4, 4, 4, 6]))
    assert other.nbytes < 100_000 * LANES * (1 if engine == "numba" else 10)


def test_what_a_session_cannot_do_is_said():
    model = simulator("numba")
    with pytest.raises(InputError, match="whole number of time steps"):
        Session(model, 2, 0.025)
    session = Session(model, 2, PERIOD)
    with pytest.raises(InputError, match="lane 0 was not started"):
        session.act(np.zeros((2, 8)))
    session.reset(np.array([0]), {})
    with pytest.raises(InputError, match="lane 1 was not started"):
        session.act(np.zeros((2, 8)))
    session.reset(np.array([1]), {})
    with pytest.raises(InputError, match="8 of them not finite"):
        session.act(np.array([np.zeros(8), np.full(8, np.nan)]))
    with pytest.raises(InputError, match="of shape"):
        session.act(np.zeros(8))
    with pytest.raises(InputError, match="did you mean 'young_modulus'"):
        session.reset(np.array([0]), {"young_module": 1e6})
    with pytest.raises(InputError, match="outside its hard bounds"):
        session.reset(np.array([0]), {"young_modulus": -1.0})
    with pytest.raises(InputError, match="name each lane once"):
        session.reset(np.array([0, 0]), {})
    with pytest.raises(InputError, match="does not fit"):
        session.restore({"bodies": np.zeros((2, 3))})


def test_a_mechanism_for_whole_rollouts_only_is_refused():
    class Own:
        name, stage, cause, remedy, parameters = "own", "actuation", "a", "b", ()

        def actuate(self, values, command, initial, time_step):
            return command

    base = simulator("numba")
    model = TrunkSimulator(base.robot, base.engine, base.assembly, base.discretisation, (Own(),))
    with pytest.raises(InputError, match="written for whole rollouts only"):
        model.session(1, PERIOD)


def test_a_lane_that_is_lost_says_so_and_leaves_the_others_alone():
    model = simulator("numba")
    session, alone = Session(model, 2, PERIOD), Session(model, 1, PERIOD)
    session.reset(np.arange(2), {})
    alone.reset(np.arange(1), {})
    state = session.save()
    state["bodies"][1] = np.nan
    session.restore(state)
    for _ in range(3):
        seen, one = session.act(np.full((2, 8), 0.01)), alone.act(np.full((1, 8), 0.01))
        np.testing.assert_array_equal(seen.position[0], one.position[0])
        assert list(seen.status) == [Result.OK, Result.DIVERGED]
    assert session.reset(np.array([1]), {}).status == [Result.OK]
    np.testing.assert_array_equal(session.act(np.zeros((2, 8))).status, Result.OK)


def test_a_body_that_would_overlap_the_cube_has_no_initial_state():
    """Heavy trunks sag into the cube; one lane's cube is out of the way."""
    model = simulator("numba", state="equilibrium").pushing()
    values = {
        "trunk_mass": np.array([0.3, 0.42, 0.65, 0.65]),
        "cube_y": np.full(4, -0.082819),
        "cube_x": np.array([0.0, 0.0, 0.0, 0.3]),
    }
    session = model.session(4, PERIOD)
    found = session.reset(np.arange(4), values)
    assert found.status.tolist() == [Result.OK, Result.OK, Result.NOT_IN_EQUILIBRIUM, Result.OK]
    assert found.position.shape == (4, len(model.robot.marker_names), 3)


LAWS = (
    ("force x at the tip", [("command", ("left",), 5.0)]),
    ("stiffness", [("time", (), 0.3), ("magnitude", ("left",), 8.0)]),
    ("damping", [("rate", ("up",), 3.0)]),
    ("base tilt x", [("largest", ("up",), 30.0)]),
    ("camera y", [("command", ("left",), 0.1), ("time", (), 2e-3)]),
)


@functools.cache
def lawful(engine: str, precision: str = "float64", state: str = "rest"):
    """The smooth arm with laws on its body and on what its camera sees, each of what reaches the cables."""
    robot = Robot.load("smooth_arm").model_copy(update={"initial_state": state})
    assembly, discretisation = assemble(robot, Discretisation(0.01)), Discretisation(0.01)
    computed = Engine(assembly, 0.01, Backend(engine, precision), state == "equilibrium", integrator="sdirk2")
    bare = TrunkSimulator(robot, computed, assembly, discretisation, mechanisms_named(("actuator_lag",), robot))
    ports = port_map(bare, robot.marker_names)
    laws = []
    for port, terms in LAWS:
        tables = tuple(
            {"coefficient": f"{port} {kind}", "feature": kind, "commands": names, "scale": scale}
            for kind, names, scale in terms
        )
        laws.append(make_law(LawChoice(port, tables), ports, robot.channel_names, "m"))
    return TrunkSimulator(robot, computed, assembly, discretisation, (*bare.mechanisms, *laws))


def lawful_rollouts(model, commands):
    """Whole rollouts of the same commands, as a function of the parameters."""
    grid = [
        model.commands(PERIOD * np.arange(PERIODS), sent, np.zeros(4), PERIOD * np.arange(PERIODS + 1))
        for sent in commands
    ]
    stacked, run = jax.tree.map(lambda *parts: np.stack(parts), *grid), jax.jit(jax.vmap(model.rollout))
    return lambda parameters: run(parameters, stacked)


def lawful_draw(model, seed=3):
    random = np.random.default_rng(seed)
    parameters = {"young_modulus": 2e6 * random.uniform(0.7, 1.3, LANES), "actuator_lag": np.full(LANES, 0.03)}
    for law in (mechanism for mechanism in model.mechanisms if isinstance(mechanism, Law)):
        for term in law.terms:
            scale = term.spec.prior["scale"]
            parameters[term.spec.name] = scale * random.uniform(0.5, 1.5, LANES)
    return parameters, np.cumsum(0.003 * random.integers(0, 3, (LANES, PERIODS, 4)), axis=1)


@pytest.mark.parametrize(
    ("engine", "precision", "state", "tolerance"),
    [
        ("numba", "float64", "equilibrium", 1e-9),
        pytest.param("numba", "float32", "rest", 1e-5, marks=pytest.mark.slow),
        pytest.param("jax", "float64", "rest", 1e-9, marks=pytest.mark.slow),
    ],
)
def test_laws_on_the_body_and_on_what_is_seen_act_as_in_a_rollout(engine, precision, state, tolerance):
    """Lanes start at different times, each with sizes of its own."""
    model = lawful(engine, precision, state)
    parameters, commands = lawful_draw(model)
    rollout = lawful_rollouts(lawful("numba", precision, state), commands)
    whole = rollout(parameters)
    for port in ("force", "stiffness", "damping", "base tilt", "camera"):
        less = parameters | {name: np.zeros(LANES) for name in parameters if name.startswith(port)}
        moved = np.abs(rollout(less).position - whole.position).max()
        assert moved > 2e-4, f"the law of {port} does nothing"
    session = Session(model, LANES, PERIOD)
    early, late = np.array([0, 2, 4]), np.array([1, 3])
    everyone = np.arange(LANES)
    session.reset(everyone, {"young_modulus": 3e6})
    session.act(np.full((LANES, 4), 0.01))
    first = session.reset(early, {name: value[early] for name, value in parameters.items()})
    np.testing.assert_allclose(first.position, whole.position[early, 0], rtol=0.0, atol=tolerance)
    session.act(commands[:, 0])
    session.reset(late, {name: value[late] for name, value in parameters.items()})
    for period in range(PERIODS - 1):
        age = np.where(np.isin(everyone, late), period, period + 1)
        now = session.act(commands[everyone, age])
        np.testing.assert_allclose(now.position, whole.position[everyone, age + 1], rtol=0.0, atol=tolerance)
        np.testing.assert_array_equal(now.status, Result.OK)


def test_a_state_under_laws_is_restored_with_its_own_gravity_and_memory():
    model = lawful("numba", "float64", "equilibrium")
    parameters, commands = lawful_draw(model)
    session, other = Session(model, LANES, PERIOD), Session(model, LANES, PERIOD)
    session.reset(np.arange(LANES), parameters)
    for period in range(3):
        session.act(commands[:, period])
    kept = session.save()
    expected = [session.act(commands[:, period]).position for period in range(3, 6)]
    other.reset(np.arange(LANES), {name: value[::-1] for name, value in parameters.items()})
    other.act(commands[:, 7])
    other.restore({name: part[[2, 4]] for name, part in kept.items()}, np.array([4, 0]))
    for period, position in enumerate(expected, start=3):
        found = other.act(commands[[4, 1, 2, 3, 2], period]).position
        np.testing.assert_array_equal(found[[4, 0]], position[[2, 4]])


def test_laws_that_need_a_whole_rollout_are_refused():
    robot = Robot.load("smooth_arm")
    model = lawful("numba")
    ports = port_map(model, robot.marker_names)
    follows = {"coefficient": "c", "feature": "position", "motion": ["tip x"], "scale": 1.0}
    late = {"coefficient": "c", "feature": "command", "commands": ["left"], "scale": 1.0}
    for port, table, why in (
        ("stiffness", follows, "follows the motion"),
        ("observation", late, "times at which markers are seen"),
        ("command delay", late, "written for whole rollouts only"),
    ):
        if ports.named(port) is None:
            port = next(each.name for each in ports.ports if each.kind == port)
        law = make_law(LawChoice(port, (table,)), ports, robot.channel_names, "m")
        with pytest.raises(InputError, match=why):
            TrunkSimulator(robot, model.engine, model.assembly, model.discretisation, (law,)).session(1, PERIOD)

    trunk = simulator("numba")
    ports = port_map(trunk, trunk.robot.marker_names)
    terms = ({"coefficient": "c", "feature": "time", "scale": 1.0},)
    law = make_law(LawChoice("stiffness", terms), ports, trunk.robot.channel_names, "m")
    pushing = TrunkSimulator(trunk.robot, trunk.engine, trunk.assembly, trunk.discretisation, (law,)).pushing()
    with pytest.raises(InputError, match="without a cube only"):
        pushing.session(1, PERIOD)
