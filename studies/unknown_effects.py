"""Effects that no mechanism of the library has, hidden in recordings of an arm or a mesh: where, and by what law, does
the audit say that they act? Each is written here as a law, in code that the audit never sees.

Three repeats of one random command and three recordings of others are fitted, four more are untouched. Data come from a
finer mesh and time step than the audit's own. Sizes are rho, see `hidden_effects`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rfdropo_bayes.bayes.recordings import gather_recordings
from rfdropo_bayes.data import Trajectory
from rfdropo_bayes.files import output_folder
from rfdropo_bayes.model.assembly import build_simulator
from rfdropo_bayes.model.experiment import AuditTable, SimulatorTable
from rfdropo_bayes.model.experiment_file import describe
from rfdropo_bayes.model.model_spec import spec_of
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.commands import Commands, observed_at, sample
from rfdropo_bayes.simulators.port_signals import BodySignals, PortSignals
from rfdropo_bayes.verbs.audit import Workshop, build_problem
from studies.hidden_effects import Setting, absorbing, blank_recordings, experiment_tables, noisy

REPEATS, OTHERS, UNTOUCHED = 3, 3, 4
MOTIONS = 4  # rollouts after which a law of the motion has the motion that it makes
AMPLITUDES = np.geomspace(0.02, 5.0, 12)  # of an effect, in its usual size, among which rho is looked for


class Scene(NamedTuple):
    """What an effect may depend on: commands at all steps [m], the tip's path [m] as it was in the rollout before, and
    the time of the steps [s]."""

    levels: Float[Any, "row channel"]
    tip: Float[Any, "row 3"]
    time: Float[Any, " row"]


class Effect(NamedTuple):
    """An effect that the library lacks.

    Attributes:
        ports: names of the ports where it may rightly be found, with cables and markers by number; see `ports_of`.
        leading: kinds of feature that say its law rightly.
        acts: size and scene to signals by name: "command", "delay", "force", "stiffness", "damping".
        sees: size, positions (row, marker, 3) and time of observations, and commands then, to positions; None where
            cameras are right.
        moves: whether it depends on the motion.
    """

    ports: tuple[str, ...]
    leading: tuple[str, ...]
    acts: Callable[[float, Scene], dict[str, Any]] | None = None
    sees: Callable[[float, Any, Any, Any], Any] | None = None
    moves: bool = False

    def ports_of(self, robot: Robot) -> tuple[str, ...]:
        """Names of the ports on a robot."""
        return tuple(port.format(cables=robot.channel_names, markers=robot.marker_names) for port in self.ports)


def _channel(scene: Scene, k: int, w: Any) -> Any:
    return jnp.zeros_like(scene.levels).at[:, k].set(w)


def _at_tip(force: Any) -> Any:
    return jnp.zeros((len(force), 3, 3)).at[:, 2].set(force)


def _bouc_wen(u: Any, time: Any) -> Any:
    """Hysteresis z' = (a - |sign(u') z + z| / 2 ...) u' of Bouc and Wen with n = 1, saturated at 1 m^-1 times 3 mm."""

    def one(z: Any, move: Any) -> tuple[Any, Any]:
        z = jnp.clip(z + (move - 0.5 * jnp.abs(move) * z - 0.5 * move * jnp.abs(z)) / 1.5e-3 * 1.0, -1.0, 1.0)
        return z, z

    moves = jnp.diff(u, prepend=u[:1])
    return jax.lax.scan(one, jnp.zeros(()), moves)[1]


def _clock(size: float, position: Any, time: Any, command: Any) -> Any:
    """Seen at t what happened at t (1 - .02 size)."""
    at = time * (1.0 - 0.02 * size)
    flat = position.reshape(len(time), -1)
    return jnp.stack([jnp.interp(at, time, flat[:, k]) for k in range(flat.shape[1])], axis=1).reshape(position.shape)


def _slide(size: float, position: Any, time: Any, command: Any) -> Any:
    """The third marker slides towards the tip by 4 mm in the whole recording."""
    chord = position[:, 3] - position[:, 1]
    chord = chord / jnp.linalg.norm(chord, axis=1, keepdims=True)
    return position.at[:, 2].add(4e-3 * size * (time / time[-1])[:, None] * chord)


def _twisted_mount(size: float, position: Any, time: Any, command: Any) -> Any:
    """The cameras' mount turns about z as the second cable pulls."""
    turn = 5.0 * size * command[:, 1]
    return position + turn[:, None, None] * jnp.cross(jnp.array([0.0, 0.0, 1.0]), position)


def _magnet(size: float, scene: Scene) -> dict[str, Any]:
    """A pull of the tip towards a point, which falls with the distance."""
    way = jnp.array([0.06, 0.04, 0.19]) - scene.tip
    square = jnp.sum(way**2, axis=1, keepdims=True)
    return {"force": _at_tip(0.1 * size * way / jnp.sqrt(square) * 0.03**2 / (0.03**2 + square))}


def _rate_limited(u: Any, time: Any, speed: Any) -> Any:
    """A command that a drive follows at most so fast [m/s]."""
    most = speed * (time[1] - time[0])

    def one(reached: Any, wanted: Any) -> tuple[Any, Any]:
        reached = reached + jnp.clip(wanted - reached, -most, most)
        return reached, reached

    return jax.lax.scan(one, u[0], u)[1]


def _lens(size: float, position: Any, time: Any, command: Any) -> Any:
    """Barrel distortion about the axis of a camera that looks along z: lengths shrink with the square of the radius."""
    square = jnp.sum(position[..., :2] ** 2, axis=-1, keepdims=True)
    return position.at[..., :2].multiply(1.0 - 5.0 * size * square)


def _filtered_marker(size: float, position: Any, time: Any, command: Any) -> Any:
    """A tracker smooths marker m2 alone, by a first-order filter of 40 ms times the size."""
    kept = jnp.exp(-(time[1] - time[0]) / (0.04 * size))

    def one(slow: Any, seen: Any) -> tuple[Any, Any]:
        slow = seen + kept * (slow - seen)
        return slow, slow

    return position.at[:, 1].set(jax.lax.scan(one, position[0, 1], position[:, 1])[1])


EFFECTS: dict[str, Effect] = {
    "crosstalk": Effect(
        ("cable {cables[1]}",),
        ("product",),
        lambda a, s: {"command": _channel(s, 1, 15.0 * a * s.levels[:, 0] * s.levels[:, 1])},
    ),
    "bouc_wen": Effect(
        ("cable {cables[0]}",),
        ("play", "direction"),
        lambda a, s: {"command": _channel(s, 0, -8e-4 * a * _bouc_wen(s.levels[:, 0], s.time))},
    ),
    "slipping_cable": Effect(
        ("cable {cables[3]}",),
        ("travelled",),
        lambda a, s: {
            "command": _channel(
                s, 3, -0.05 * a * jnp.cumsum(jnp.abs(jnp.diff(s.levels[:, 3], prepend=s.levels[:1, 3])))
            )
        },
    ),
    "one_lagging_cable": Effect(
        ("cable {cables[2]}",),
        ("rate",),
        lambda a, s: {"command": _channel(s, 2, -0.04 * a * jnp.asarray(jnp.gradient(s.levels[:, 2], s.time)))},
    ),
    "slow_queue": Effect(("command delay",), ("time",), lambda a, s: {"delay": 0.02 * a * s.time}),
    "magnet": Effect(
        ("force x at the tip", "force y at the tip"),
        ("position", "command", "product", "magnitude"),
        _magnet,
        moves=True,
    ),
    "rising_wind": Effect(
        ("force x at the tip", "force x at the middle"),
        ("time",),
        lambda a, s: {"force": _at_tip(jnp.outer(0.01 * a * s.time, jnp.array([1.0, 0.0, 0.0])))},
    ),
    "softening_by_use": Effect(
        ("stiffness",),
        ("largest", "travelled", "time"),
        lambda a, s: {"stiffness": -10.0 * a * jax.lax.cummax(jnp.linalg.norm(s.tip[:, :2] - s.tip[:1, :2], axis=1))},
        moves=True,
    ),
    "sliding_marker": Effect(("marker {markers[2]} along the body", "marker {markers[2]} z"), ("time",), sees=_slide),
    "slow_clock": Effect(("observation delay",), ("time",), sees=_clock),
    "twisted_mount": Effect(("camera turn z",), ("command",), sees=_twisted_mount),
}
"""Of drives, body, surroundings, sensing and clocks."""

FOREIGN: dict[str, Effect] = {
    "rate_limited_drive": Effect(
        ("cable {cables[1]}",),
        ("lag", "rate", "low_pass"),
        lambda a, s: {"command": _channel(s, 1, _rate_limited(s.levels[:, 1], s.time, 0.04 / a) - s.levels[:, 1])},
    ),
    "giving_pulley": Effect(
        ("cable {cables[0]}",),
        ("excess", "magnitude", "product", "command"),
        lambda a, s: {"command": _channel(s, 0, -0.3 * a * jnp.maximum(s.levels[:, 0] - 3e-3, 0.0))},
    ),
    "warming_cable": Effect(
        ("cable {cables[3]}",),
        ("time",),
        lambda a, s: {"command": _channel(s, 3, 1e-3 * a * -jnp.expm1(-s.time / 2.0))},
    ),
    "cable_that_jumps": Effect(
        ("cable {cables[2]}",), ("time",), lambda a, s: {"command": _channel(s, 2, 1e-3 * a * (s.time > 2.0))}
    ),
    "fan": Effect(
        ("force x at the tip", "force x at the middle"),
        (),
        lambda a, s: {"force": _at_tip(jnp.outer(0.02 * a * jnp.sin(4.4 * s.time), jnp.array([1.0, 0.0, 0.0])))},
    ),
    "stiffening_body": Effect(
        ("stiffness",),
        ("position", "magnitude", "largest"),
        lambda a, s: {"stiffness": 25.0 * a * jnp.linalg.norm(s.tip[:, :2] - s.tip[:1, :2], axis=1)},
        moves=True,
    ),
    "lens": Effect(("camera scale", "camera x", "camera y"), ("product", "magnitude", "command"), sees=_lens),
    "filtered_marker": Effect(
        ("marker {markers[1]} x", "marker {markers[1]} y", "marker {markers[1]} z"),
        ("rate", "lag"),
        sees=_filtered_marker,
    ),
    "crosstalk_and_slide": Effect(
        ("cable {cables[1]}", "marker {markers[2]} along the body", "marker {markers[2]} z"),
        ("product", "time"),
        lambda a, s: {"command": _channel(s, 1, 15.0 * a * s.levels[:, 0] * s.levels[:, 1])},
        _slide,
    ),
    "clock_and_weak_cable": Effect(
        ("observation delay",), ("time",), lambda a, s: {"command": _channel(s, 0, -0.1 * a * s.levels[:, 0])}, _clock
    ),
}
"""Effects that were written after the features, for which no feature was made; the last two are two effects each."""


class Concealed(NamedTuple):
    """What is in a data set: the effect, its size in usual sizes and as rho, the experiment, and the untouched
    recordings without noise [m]."""

    effect: str
    size: float
    rho: float
    experiment: Path
    clean: Float[np.ndarray, "trajectory time marker 3"]


@dataclass(frozen=True)
class EffectSimulator:
    """A simulator with an effect in it.

    Attributes:
        simulator: without it.
        effect: None for nothing.
        values: of its parameters.
    """

    simulator: Any
    effect: Effect | None
    values: dict[str, float]

    def positions(self, commands: Commands, size: float) -> Float[np.ndarray, "recording time marker 3"]:
        """What every recording shows with an effect of a size."""
        return np.asarray(self._shown(commands, jnp.asarray(size)))

    @cached_property
    def _shown(self) -> Any:
        given = {name: jnp.asarray(v) for name, v in self.values.items()}
        effect, step = self.effect, self.simulator.time_step

        def one(own: Commands, size: Any) -> Any:
            levels = jnp.concatenate([jnp.asarray(own.initial)[None], own.step])
            time = step * jnp.arange(len(levels))
            every = own._replace(
                sample_step=jnp.arange(len(levels)), sample_fraction=jnp.zeros(len(levels)), signals=None
            )
            tip = jnp.zeros((len(levels), 3))
            if effect is not None and effect.moves:
                tip = self.simulator.rollout(given, every).position[:, -1]
                for _ in range(MOTIONS - 1):
                    acted = every._replace(signals=_signals(effect, size, Scene(levels, tip, time)))
                    tip = self.simulator.rollout(given, acted).position[:, -1]
            if effect is not None and effect.acts is not None:
                own = own._replace(signals=_signals(effect, size, Scene(levels, tip, time)))
            position = self.simulator.rollout(given, own).position
            if effect is not None and effect.sees is not None:
                seen = observed_at(own, step)
                position = effect.sees(size, position, seen - seen[0], sample(levels, own))
            return position

        return jax.jit(jax.vmap(one, in_axes=(0, None)))


def _signals(effect: Effect, size: Any, scene: Scene) -> PortSignals:
    assert effect.acts is not None
    rows, given = len(scene.time), effect.acts(size, scene)
    none = BodySignals(jnp.zeros((rows, 3, 3)), *(jnp.zeros(rows),) * 2, jnp.zeros((rows, 3)))
    body = none._replace(**{name: part for name, part in given.items() if name in BodySignals._fields})
    acts = any(name in given for name in BodySignals._fields)
    return PortSignals(
        given.get("command", jnp.zeros_like(scene.levels)), given.get("delay", jnp.zeros(rows)), body if acts else None
    )


def conceal(
    name: str, rho: float, seed: int, out: Path, *, setting: Setting | None = None, workshop: Workshop | None = None
) -> Concealed | None:
    """Write a data set with an effect of size ``rho`` in it; with none where the name is empty.

    Returns:
        what is hidden; None where no size of the effect reaches rho.
    """
    setting, rng, out = setting or Setting(), np.random.default_rng([seed, 42]), output_folder(out)
    effect = (EFFECTS | FOREIGN)[name] if name else None
    tables = experiment_tables(setting, fit=["fit_*.nc"])
    names = [f"fit_{k + 1}" for k in range(REPEATS + OTHERS)] + [f"test_{k + 1}" for k in range(UNTOUCHED)]
    blank = blank_recordings(setting, rng, names, [*([0] * REPEATS), *range(1, 1 + OTHERS + UNTOUCHED)])
    fitted, untouched = blank[: REPEATS + OTHERS], blank[REPEATS + OTHERS :]
    spec = spec_of(tables, out)
    problem = build_problem(spec, AuditTable(), fitted, untouched, seed, workshop=workshop)
    coordinates = problem.coordinates
    truth = coordinates.null.copy()
    base = slice(0, coordinates.base)
    truth[base] += setting.spread * coordinates.prior_sd[base] * rng.standard_normal(coordinates.base)
    values = dict(zip(coordinates.names[base], coordinates.values(truth[None])[0, base].tolist(), strict=True))
    size, found = 0.0, 0.0
    if effect is not None:
        own = EffectSimulator(build_simulator(spec), effect, values)
        sized = _sized(own, problem, truth, rho, fitted)
        if sized is None:
            return None
        size, found = sized
    made = build_simulator(replace(spec, simulator=SimulatorTable.model_validate(dict(setting.made))))
    commands = gather_recordings(made, blank).commands
    position = EffectSimulator(made, effect, values).positions(commands, size)
    for index, (recording, clean) in enumerate(zip(blank, position, strict=True)):
        noisy(recording, clean, jax.random.fold_in(jax.random.key(seed), index), setting).save(
            out / f"{recording.name}.nc"
        )
    written = tables.model_dump(exclude_none=True, exclude_defaults=True) | {"seed": seed}
    (out / "audit.toml").write_text(describe(written), encoding="utf-8")
    return Concealed(name, size, found, out / "audit.toml", position[REPEATS + OTHERS :])


def _sized(
    own: EffectSimulator, problem: Any, truth: np.ndarray, rho: float, fitted: Sequence[Trajectory]
) -> tuple[float, float] | None:
    """Size at which a refit of the base model cannot absorb ``rho`` noise deviations, and the rho that was reached."""
    base = absorbing(problem, truth, fitted)
    still = own.positions(base.commands, 0.0)

    def reached(size: float) -> float:
        return base.rho(own.positions(base.commands, size) - still)

    found = [reached(size) for size in AMPLITUDES]
    above = [k for k, value in enumerate(found) if value >= rho]
    if not above or above[0] == 0 or not np.isfinite(found[above[0]]):
        return None
    k = above[0]
    share = np.log(rho / found[k - 1]) / np.log(found[k] / found[k - 1])
    size = float(np.exp(np.log(AMPLITUDES[k - 1]) + share * np.log(AMPLITUDES[k] / AMPLITUDES[k - 1])))
    return size, reached(size)
