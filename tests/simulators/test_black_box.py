"""A simulator of one's own: rollouts, derivatives, mechanisms around it, another process, and what goes wrong."""

from __future__ import annotations

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import lfilter

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.mechanisms import mechanisms_named
from rfdropo_bayes.mechanisms.laws import LawChoice, make_law
from rfdropo_bayes.mechanisms.ports import port_map
from rfdropo_bayes.simulators.black_box import BlackBox, BlackBoxSimulator
from rfdropo_bayes.simulators.protocol import Result, Simulator

STEP = 0.02
PARAMETERS = {"gain": {"low": 0.2, "high": 3.0}, "time_constant": {"low": 0.05, "high": 1.0, "unit": "s"}}
NAMES = {"markers": ["tip"], "channels": ["pull"], "time_step": STEP}
VALUES = {"gain": jnp.asarray(1.4), "time_constant": jnp.asarray(0.25)}


def lag(parameters, command):
    """The tip follows gain * command with a time constant; it starts where the first command puts it."""
    if parameters["gain"] > 2.9:
        raise ArithmeticError("too large a gain")
    share = 1.0 - np.exp(-STEP / parameters["time_constant"])
    place = np.empty(len(command))
    place[0] = parameters["gain"] * command[0, 0]
    for row in range(1, len(command)):
        place[row] = place[row - 1] + share * (parameters["gain"] * command[row, 0] - place[row - 1])
    return np.stack([place, np.zeros_like(place), np.full_like(place, 0.1)], axis=-1)[:, None]


def filtered(gain, time_constant, command):
    """The same by SciPy."""
    kept = np.exp(-STEP / time_constant)
    return gain * lfilter([1.0 - kept], [1.0, -kept], command[1:], zi=[kept * command[0]])[0]


PROGRAM = """
import json, math, sys
for line in sys.stdin:
    asked = json.loads(line)
    gain, constant = asked["parameters"]["gain"], asked["parameters"]["time_constant"]
    if gain > 2.9:
        print(json.dumps({"error": "too large a gain"}), flush=True)
        continue
    share, places = 1.0 - math.exp(-asked["time_step"] / constant), []
    for row in asked["command"]:
        x = gain * row[0] if not places else places[-1] + share * (gain * row[0] - places[-1])
        places.append(x)
    print(json.dumps({"position": [[[x, 0.0, 0.1]] for x in places]}), flush=True)
"""


def together(parameters, command):
    return np.stack([lag({n: c[k] for n, c in parameters.items()}, rows) for k, rows in enumerate(command)])


@pytest.fixture(scope="module", params=["single", "batched", "process"])
def simulator(request):
    function = {"single": lag, "batched": together, "process": [sys.executable, "-c", PROGRAM]}[request.param]
    return BlackBoxSimulator(BlackBox(function, parameters=PARAMETERS, batched=request.param == "batched", **NAMES))


@pytest.fixture(scope="module")
def sent(simulator):
    value = np.repeat(np.random.default_rng(0).uniform(-0.02, 0.03, 4), 10)[:, None]
    time = STEP * np.arange(41)
    return simulator.commands(time[:-1], value, value[0], time)


def test_rollouts_are_those_of_the_function(simulator, sent):
    assert isinstance(simulator, Simulator)
    values = {name: jnp.stack([value, 1.1 * value]) for name, value in VALUES.items()}
    seen = jax.jit(jax.vmap(lambda v: simulator.rollout(v, sent)))(values)
    level = np.concatenate([sent.initial, sent.step[:, 0]])
    for k, factor in enumerate((1.0, 1.1)):
        wanted = filtered(1.4 * factor, 0.25 * factor, level)
        np.testing.assert_allclose(seen.position[k, 1:, 0, 0], wanted, atol=1e-12)
    assert np.all(np.asarray(seen.status) == Result.OK)


def test_a_prefix_is_that_of_the_whole_and_a_failure_is_counted(simulator, sent):
    whole = simulator.rollout(VALUES, sent)
    part = simulator.rollout(VALUES, sent, jnp.asarray(15))
    np.testing.assert_allclose(part.position[:16], whole.position[:16], atol=1e-12)
    assert int(simulator.rollout({"gain": jnp.asarray(2.95)}, sent).status) == Result.DIVERGED


def test_what_jax_compiles_is_compiled_once_for_all_batches_of_whole_recordings(sent):
    sizes = []

    def one(parameters, command):
        share = 1.0 - jnp.exp(-STEP / parameters["time_constant"])

        def step(place, level):
            place = place + share * (parameters["gain"] * level - place)
            return place, place

        start = parameters["gain"] * command[0, 0]
        place = jnp.append(start, jax.lax.scan(step, start, command[1:, 0])[1])
        return jnp.stack([place, jnp.zeros_like(place), jnp.full_like(place, 0.1)], axis=-1)[:, None]

    compiled = jax.jit(jax.vmap(one))

    def counted(parameters, command):
        sizes.append(command.shape)
        return compiled(parameters, command)

    box = BlackBox(counted, parameters=PARAMETERS, batched=True, lanes=3, one_shape=True, **NAMES)
    simulator = BlackBoxSimulator(box)
    level = np.concatenate([sent.initial, sent.step[:, 0]])
    time = STEP * np.arange(41)
    simulator.commands(time[:-1], level[1:, None], level[:1], time)
    gains = jnp.linspace(1.0, 2.0, 5)
    seen = jax.jit(jax.vmap(lambda gain: simulator.rollout(VALUES | {"gain": gain}, sent)))(gains)
    for gain, place in zip(gains, seen.position, strict=True):
        np.testing.assert_allclose(place[1:, 0, 0], filtered(gain, 0.25, level), atol=1e-12)
    part = simulator.rollout(VALUES, sent, jnp.asarray(15))
    np.testing.assert_allclose(part.position[1:16, 0, 0], filtered(1.4, 0.25, level)[:15], atol=1e-12)
    assert sizes == 4 * [(3, 41, 1)]  # the first look at the function, two for five sets, one for the part
    assert compiled._cache_size() == 1
    with pytest.raises(InputError, match="one_shape needs batched"):
        BlackBox(lag, parameters=PARAMETERS, one_shape=True, **NAMES)


def test_mechanisms_act_before_and_after_it_and_not_inside(sent):
    box = BlackBox(lag, parameters=PARAMETERS, **NAMES)
    extended = BlackBoxSimulator(box, mechanisms_named(["command_gain", "camera_offset"], box))
    names = {spec.name for spec in extended.parameters}
    assert {"gain", "command_gain_error"} < names
    moved = extended.rollout(VALUES | {"command_gain_error": jnp.asarray(0.1)}, sent).position
    plain = BlackBoxSimulator(box).rollout(VALUES, sent).position
    np.testing.assert_allclose(moved[:, 0, 0], 1.1 * plain[:, 0, 0], atol=1e-12)
    with pytest.raises(InputError, match="payload does not run here"):
        BlackBoxSimulator(box, mechanisms_named(["payload"], box))


@pytest.mark.parametrize(("unit", "kind"), [("m", "cable"), ("rad", "actuator"), ("N m", "actuator")])
def test_a_port_is_spoken_of_as_a_cable_only_where_commands_are_metres_of_cable(unit, kind):
    box = BlackBox(lag, parameters=PARAMETERS, **(NAMES | {"channels": ["a", "b"], "command_unit": unit}))
    ports = port_map(BlackBoxSimulator(box), ["tip"])
    drives = [port for port in ports.ports if port.kind in ("cable", "cables")]
    assert [port.name for port in drives] == ["cable a", "cable b", "every cable"]  # as files have them
    assert [port.words for port in drives] == [f"{kind} a", f"{kind} b", f"every {kind}"]
    assert [ports.named(port.words) for port in drives] == [ports.named(port.name) for port in drives] == drives
    term = {"coefficient": "c", "feature": "constant", "scale": 1.0}
    law = make_law(LawChoice("cable b", (term,)), ports, ["a", "b"], unit)
    assert f"an effect at {kind} b" in law.cause
    assert f"of the law at {kind} b" in law.parameters[0].description


@pytest.mark.parametrize(
    ("function", "said"),
    [
        (lambda parameters, command: np.zeros((len(command), 2, 3)), r"returned positions \(3, 2, 3\)"),
        (lambda parameters, command: parameters["stiffness"], "raises KeyError"),
        ([sys.executable, "-c", "print('no JSON')"], "fails at its nominal parameters"),
    ],
)
def test_a_function_that_is_none_is_told_so_before_anything_long(function, said):
    simulator = BlackBoxSimulator(BlackBox(function, parameters=PARAMETERS, **NAMES))
    with pytest.raises(InputError, match=said):
        simulator.commands(np.array([0.0]), np.zeros((1, 1)), np.zeros(1), STEP * np.arange(5))


def test_a_function_of_many_sets_that_raises_is_told_why():
    def broken(parameters, command):
        return parameters["stiffness"]

    simulator = BlackBoxSimulator(BlackBox(broken, parameters=PARAMETERS, batched=True, **NAMES))
    with pytest.raises(InputError, match="raises KeyError: 'stiffness'"):
        simulator.commands(np.array([0.0]), np.zeros((1, 1)), np.zeros(1), STEP * np.arange(5))


def test_a_parameter_needs_bounds():
    with pytest.raises(InputError, match="'low' is missing"):
        BlackBox(lag, parameters={"gain": {"high": 1.0}}, **NAMES)
