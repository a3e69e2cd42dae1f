"""Laws at ports as mechanisms: ``w(t) = sum of coefficient times feature`` at a port, for effects that no named
mechanism has. All coefficients are zero at null.

    [[model.laws]]
    port = "cable left"
    terms = [{ coefficient = "crosstalk", feature = "product", commands = ["up", "left"], scale = 20.0 }]
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.mechanisms.default_priors import normal
from rfdropo_bayes.mechanisms.features import GAUGES, KINDS, OWN_NAME, Feature, feature_named, gauges_of
from rfdropo_bayes.mechanisms.ports import Port, PortMap, sensed
from rfdropo_bayes.simulators.commands import sample
from rfdropo_bayes.simulators.mechanisms import Meanwhile, Mechanism, Values
from rfdropo_bayes.simulators.parameters import ParameterSpec
from rfdropo_bayes.simulators.port_signals import BodySignals, read_late
from rfdropo_bayes.tables import nearest

WHERE = "[[model.laws]]"
FAR = 1e3  # hard bounds of a coefficient, in prior scales from null
SHAPES = 10.0  # hard bounds of an inferred shape: times a shape, and its inverse
WIDE = 0.5  # deviation of a shape's prior, as a share of the shape: audits try shapes that are 2 to 10 times apart


class Term(NamedTuple):
    """One coefficient of a law, and the feature that it belongs to."""

    feature: Feature  # feature with its initial shape
    spec: ParameterSpec  # specification of the coefficient
    shape: ParameterSpec | None = None  # parameter that replaces the feature's shape; None for a fixed shape

    def shaped(self, values: Values) -> Feature:
        """The feature with the shape of these values."""
        return self.feature if self.shape is None else self.feature.in_shape(values[self.shape.name])


class LawChoice(NamedTuple):
    """A law as a file has it: a port and tables of terms, which is yet to be made for a robot."""

    port: str
    terms: tuple[Mapping[str, Any], ...]


def unit_of(port_unit: str, feature: Feature, command_unit: str) -> str:
    """Unit of the coefficient of a feature at a port, such as "1/m" or "m/s"."""
    powers: dict[str, int] = {} if port_unit == "-" else {port_unit: 1}
    for name, power in feature.unit(command_unit):
        powers[name] = powers.get(name, 0) - power
    powers.pop("-", None)  # commands without a unit
    above = [_raised(name, power) for name, power in powers.items() if power > 0]
    below = [_raised(name, -power) for name, power in powers.items() if power < 0]
    if not above and not below:
        return "-"
    return "/".join([" ".join(above) or "1", *below])


def _raised(name: str, power: int) -> str:
    return name if power == 1 else " ".join(f"{part}{power}" for part in name.split())


class Law:
    """Base of the laws of every stage.

    Args:
        port: port at which the law acts.
        terms: terms of the sum.
        ports: all ports of the robot.
        formula: formula that names the law.
    """

    stage: str

    def __init__(self, port: Port, terms: Sequence[Term], ports: PortMap, formula: str = "") -> None:
        self.port, self.terms, self._ports = port, tuple(terms), ports
        self.name = f"law at {port.name}: {formula}" if formula else f"law at {port.name}"
        self.parameters = tuple(spec for term in terms for spec in (term.spec, term.shape) if spec is not None)
        self.cause = f"an effect at {port.words}, with a law that no mechanism of the library has"
        self.remedy = f"look at {port.look}"

    def signal(self, values: Values, levels: Float[Array, "row channel"], time_step: float) -> Float[Array, " row"]:
        """w(t), given the commands that reach the port; row 0 is before the first step."""
        return _summed(self.terms, values, levels, time_step)


def _summed(terms: Sequence[Term], values: Values, levels: Float[Array, "row channel"], time_step: float) -> Array:
    parts = (values[term.spec.name] * term.shaped(values).over(levels, time_step) for term in terms)
    return sum(parts, jnp.zeros(len(levels)))


class CableLaw(Law):
    """Adds a signal to the command of one cable, or to each cable's command (then a function of that command)."""

    stage = "actuation"
    inside_drive = False

    @property
    def _cables(self) -> list[tuple[int, list[Term]]]:
        """Number and terms of each cable."""
        numbers = [member.number for member in self._ports.members(self.port)]
        return [(k, [term._replace(feature=term.feature.of(k)) for term in self.terms]) for k in numbers]

    def settle(self, values: Values, constant: Float[Array, " channel"]) -> Float[Array, " channel"]:
        reached = constant
        for k, terms in self._cables:
            parts = (values[term.spec.name] * term.feature.at_rest(constant) for term in terms)
            reached = reached.at[k].add(sum(parts, jnp.zeros(())))
        return reached

    def begin(self, values: Values, first: Float[Array, " channel"], interval: float) -> tuple[Any, ...]:
        return tuple(tuple(term.feature.begin(first) for term in terms) for _, terms in self._cables)

    def advance(
        self, values: Values, memory: tuple[Any, ...], given: Float[Array, " channel"], now: float
    ) -> tuple[tuple[Any, ...], Float[Array, " channel"]]:
        """Add the signal of a step."""
        after, reached = [], given
        for (k, terms), kept in zip(self._cables, memory, strict=True):
            own, w = _advanced(terms, values, kept, given, now)
            after.append(own)
            reached = reached.at[k].add(w)
        return tuple(after), reached

    def actuate(
        self, values: Values, command: Float[Array, "step channel"], initial: Float[Array, " channel"], time_step: float
    ) -> Float[Array, "step channel"]:
        levels = jnp.concatenate([jnp.asarray(initial, command.dtype)[None], command])
        for k, terms in self._cables:
            command = command.at[:, k].add(_summed(terms, values, levels, time_step)[1:])
        return command


def _advanced(
    terms: Sequence[Term], values: Values, memory: tuple[Any, ...], given: Array, interval: Any
) -> tuple[tuple[Any, ...], Array]:
    """Memories and signal at the end of a step."""
    after, w = [], jnp.zeros(())
    for term, kept in zip(terms, memory, strict=True):
        kept, value = term.shaped(values).advance(kept, given, interval)
        after.append(kept)
        w = w + values[term.spec.name] * value
    return tuple(after), w


class DelayLaw(Law):
    """Commands reach the cables later by its signal [s]; in whole rollouts only."""

    stage = "actuation"
    inside_drive = True

    def actuate(
        self, values: Values, command: Float[Array, "step channel"], initial: Float[Array, " channel"], time_step: float
    ) -> Float[Array, "step channel"]:
        levels = jnp.concatenate([jnp.asarray(initial, command.dtype)[None], command])
        return read_late(levels, self.signal(values, levels, time_step) / time_step)[1:]


class SignalLaw(Law):
    """A law whose signal a session takes step by step, see `SignallingMechanism`."""

    @property
    def whole_only(self) -> str:
        return ""

    def signal_before(self, values: Values, first: Float[Array, " channel"]) -> tuple[Any, Float[Array, ""]]:
        parts = (values[term.spec.name] * term.shaped(values).at_rest(first) for term in self.terms)
        return tuple(term.feature.begin(first) for term in self.terms), sum(parts, jnp.zeros(()))

    def signal_after(
        self, values: Values, memory: Any, given: Float[Array, " channel"], time_step: float
    ) -> tuple[Any, Float[Array, ""]]:
        return _advanced(self.terms, values, memory, given, time_step)


class BodyLaw(SignalLaw):
    """Acts on a rod; one that follows the motion in whole rollouts only."""

    stage = "body"
    bodies = ("rod",)

    @property
    def follows_motion(self) -> bool:
        return any(term.feature.of_motion for term in self.terms)

    @property
    def whole_only(self) -> str:
        return "it follows the motion of a whole rollout" if self.follows_motion else ""

    def carried(self, w: Float[Array, " row"]) -> BodySignals:
        return self._ports.push(self.port, w)

    def push(
        self, values: Values, command: Float[Array, "row channel"], path: Float[Array, "row 3"] | None, time_step: float
    ) -> BodySignals:
        w = _summed([t for t in self.terms if not t.feature.of_motion], values, command, time_step)
        if path is not None:
            w = w + _summed([t for t in self.terms if t.feature.of_motion], values, gauges_of(path), time_step)
        return self.carried(w)


class SensingLaw(SignalLaw):
    """Acts on the measured markers, by time and commands; on when they are seen in whole rollouts only."""

    stage = "sensing"

    @property
    def whole_only(self) -> str:
        return "it changes the times at which markers are seen" if self.port.kind == "observation" else ""

    def carried(
        self, w: Float[Array, " time"], position: Float[Array, "time marker 3"], time: Float[Array, " time"]
    ) -> Float[Array, "time marker 3"]:
        return sensed(self.port, w, position, time)

    def sense_with_commands(
        self, values: Values, position: Float[Array, "time marker 3"], time: Float[Array, " time"], meanwhile: Meanwhile
    ) -> Float[Array, "time marker 3"]:
        w = sample(self.signal(values, meanwhile.levels, meanwhile.time_step), meanwhile.commands)
        return self.carried(w, position, time)


class ClockedSensingLaw(Law):
    """Acts on the measured markers by time alone; sessions can therefore use it."""

    stage = "sensing"

    def sense_over_time(
        self, values: Values, position: Float[Array, "time marker 3"], time: Float[Array, " time"]
    ) -> Float[Array, "time marker 3"]:
        return sensed(self.port, self._at(values, time), position, time)

    def begin(self, values: Values, first: Float[Array, "marker 3"], interval: float) -> tuple[()]:
        """Nothing to remember."""
        return ()

    def advance(
        self, values: Values, memory: tuple[()], given: Float[Array, "marker 3"], now: Float[Array, ""]
    ) -> tuple[tuple[()], Float[Array, "marker 3"]]:
        time = jnp.asarray(now, float)[None]
        return memory, sensed(self.port, self._at(values, time), given[None], time)[0]

    def _at(self, values: Values, time: Float[Array, " time"]) -> Float[Array, " time"]:
        own = {"constant": jnp.ones_like(time), "time": time}
        return sum((values[t.spec.name] * own[t.feature.kind] for t in self.terms), jnp.zeros_like(time))


def law_at(port: Port, terms: Sequence[Term], ports: PortMap, formula: str = "") -> Mechanism:
    """The law with the given terms at a port, of the class for the port's stage."""
    if port.kind in ("cable", "cables"):
        return CableLaw(port, terms, ports, formula)
    if port.kind == "delay":
        return DelayLaw(port, terms, ports, formula)
    if port.stage == "body":
        return BodyLaw(port, terms, ports, formula)
    of_time = all(not KINDS[term.feature.kind].channels for term in terms)
    return (ClockedSensingLaw if of_time and port.kind != "observation" else SensingLaw)(port, terms, ports, formula)


def _feature(table: Mapping[str, Any], port: Port, names: Sequence[str], where: str) -> Feature:
    kind, shape, motion = table["feature"], table.get("shape"), table.get("motion", ())
    if not motion:
        return feature_named(kind, table.get("commands", ()), shape, names, where)
    if port.stage != "body" or table.get("commands"):
        raise InputError(
            f"a term cannot follow the motion {'and commands' if port.stage == 'body' else 'here'}",
            where=where,
            remedy="laws of the motion act on the body (forces, stiffness, damping, base tilt), and commands = [...] "
            "goes into a term of its own",
        )
    return feature_named(kind, motion, shape, GAUGES, where, of_motion=True)


def shape_spec(name: str, feature: Feature, command_unit: str) -> ParameterSpec:
    """The shape of a feature as a parameter, whose prior is wide about the feature's own shape."""
    assert feature.shape is not None
    own, words = feature.shape, "half the width of a play" if feature.kind == "play" else "time constant of a feature"
    prior = normal(float(f"{WIDE * own:.3g}"), own)
    return ParameterSpec(name, feature.shape_unit(command_unit), own / SHAPES, own * SHAPES, own, prior, words)


def _shape_of(table: Mapping[str, Any], feature: Feature, command_unit: str, where: str) -> ParameterSpec | None:
    name = table.get("shape_parameter")
    if name is None:
        return None
    if feature.shape is None:
        raise InputError(
            f"the feature {feature.kind!r} has no shape that could be inferred", where=where,
            remedy="leave shape_parameter out",
        )  # fmt: skip
    return shape_spec(str(name), feature, command_unit)


def make_law(choice: LawChoice, ports: PortMap, channels: Sequence[str], command_unit: str) -> Mechanism:
    """A law as a file has it.

    Raises:
        InputError: an unknown port, feature or command, a coefficient named twice, or a port that the body cannot
            carry.
    """
    port = ports.named(choice.port)
    if port is None:
        why = "; ".join(f"{names}: {reason}" for names, reason in ports.left_out.items())
        remedy = nearest(choice.port, [each.name for each in ports.ports])
        raise InputError(f"no port {choice.port!r}", where=WHERE, remedy=f"{remedy}. {why}" if why else remedy)
    where = f"{WHERE} port = {choice.port!r}"
    names = (*channels, OWN_NAME) if port.kind == "cables" else tuple(channels)
    terms = []
    for table in choice.terms:
        feature = _feature(table, port, names, where)
        scale = float(table["scale"])
        unit = unit_of(port.unit, feature, command_unit)
        words = f"of the law at {port.words}: it changes {feature.words(channels)}"
        name = str(table["coefficient"])
        spec = ParameterSpec(name, unit, -FAR * scale, FAR * scale, 0.0, normal(scale), words)
        terms.append(Term(feature, spec, _shape_of(table, feature, command_unit, where)))
    names_given = [spec.name for term in terms for spec in (term.spec, term.shape) if spec is not None]
    if len(set(names_given)) < len(names_given):
        raise InputError("two terms share a parameter", where=where, remedy="name each after its effect")
    formula = " + ".join(f"{term.spec.name} {term.feature.formula(channels)}" for term in terms)
    return law_at(port, terms, ports, formula)
