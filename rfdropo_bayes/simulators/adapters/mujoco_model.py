"""A MuJoCo model, MJCF or URDF, in the robot's place: ``MuJoCo("arm.xml", markers=..., channels=..., parameters=...)``.

A rollout takes the unchanged model, sets the parameters of its lane (`mujoco_elements`), lets MuJoCo recompute derived
constants (`mj_setConst`), and plays the commands as ``ctrl``, each in force over the step that ends with its row. All
lanes run at once in `mujoco.rollout`, on all processors.

Lanes of a MuJoCo model that continue from their state, each with its own parameters.
"""

from __future__ import annotations

import copy
import hashlib
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.rollouts import Motion
from rfdropo_bayes.robots.parameter import Parameter
from rfdropo_bayes.simulators.adapters.mujoco_elements import (
    TURNING,
    Edit,
    edit_of,
    element_names,
    field_of,
    motion_of,
    number_of,
    parameter_of,
    searched,
)
from rfdropo_bayes.simulators.adapters.mujoco_file import model_text
from rfdropo_bayes.simulators.adapters.mujoco_start import adapter_tables
from rfdropo_bayes.simulators.black_box import BlackBox
from rfdropo_bayes.simulators.body_lanes import LaneStart
from rfdropo_bayes.tables import nearest


class MuJoCoLanes:
    """Bodies of a session: see `simulators.body_lanes.BodyLanes`. The material of a lane is its parameters by name.

    Motion equals that in whole rollouts, to the tolerance of MuJoCo's solver if there are constraints, because each
    period restarts the solver.

    Args:
        rollouts: rollouts of the model.
        count: number of lanes.
    """

    def __init__(self, rollouts: MuJoCoRollouts, count: int) -> None:
        self.rollouts = rollouts
        self._models = [copy.copy(rollouts.model) for _ in range(count)]
        self._state = np.tile(rollouts.first[0], (count, 1))
        self._failed = np.ones(count, dtype=bool)
        self._values = np.full((count, len(rollouts.edits)), np.nan)

    def reset(self, rows: Int[np.ndarray, " row"], given: LaneStart) -> Motion:
        self._take_values(rows, np.stack([np.asarray(given.material[name], float) for name in self.rollouts.edits], 1))
        first = np.asarray(given.start, float)
        state, valid = self.rollouts.begun([self._models[row] for row in rows], self._ctrl(first[:, None])[:, 0])
        self._state[rows], self._failed[rows] = state, ~valid
        return self._moved(rows, np.zeros((len(rows), 0, first.shape[1])), first)

    def advance(self, displacement: Float[np.ndarray, "lane step channel"]) -> Motion:
        return self._moved(np.arange(len(self._models)), displacement, displacement[:, -1])

    def save(self) -> Float[np.ndarray, "lane values"]:
        return np.concatenate([self._state, self._failed[:, None], self._values], axis=1)

    def restore(self, rows: Int[np.ndarray, " row"], state: Float[np.ndarray, "row values"]) -> None:
        size = self._state.shape[1]
        self._state[rows], self._failed[rows] = state[:, :size], state[:, size] > 0.0
        self._take_values(rows, state[:, size + 1 :])

    def _take_values(self, rows: np.ndarray, values: Float[np.ndarray, "row parameter"]) -> None:
        """Let the models of lanes have these values, in the order of the model's parameters."""
        self._values[rows] = values
        columns = dict(zip(self.rollouts.edits, values.T, strict=True))
        for model, row in zip(self.rollouts.models(columns, len(rows)), rows, strict=True):
            self._models[row] = copy.copy(model)

    def _ctrl(self, commands: Float[np.ndarray, "row step channel"]) -> Float[np.ndarray, "row step ctrl"]:
        ctrl = np.tile(self.rollouts.first[1], (*commands.shape[:2], 1))
        ctrl[..., list(self.rollouts.channels.values())] = commands
        return ctrl

    def _moved(
        self, rows: np.ndarray, commands: Float[np.ndarray, "row step channel"], last: Float[np.ndarray, "row channel"]
    ) -> Motion:
        """Take a step for each command, and one more under ``last`` that shows the state before it."""
        steps, clock = commands.shape[1], self.rollouts.model.opt.timestep
        ctrl = self._ctrl(np.concatenate([commands, last[:, None]], axis=1))
        begun = self._state[rows, 0]
        states, seen = self.rollouts.rolled([self._models[row] for row in rows], self._state[rows], ctrl)
        if steps:
            self._state[rows] = states[:, -2]
        late = states[:, -1, 0] - begun - (steps + 1) * clock
        self._failed[rows] |= ~((np.abs(late) < 0.5 * clock) & np.isfinite(states[:, -1]).all(axis=1))
        position, tension = self.rollouts.shown(seen)  # the first row: tensions of a new command before any motion
        diverged: Bool[np.ndarray, " row"] = self._failed[rows].copy()
        sound = ~diverged[:, None]
        return Motion(
            np.where(sound[..., None], position[:, -1], 0.0),
            np.where(sound, tension[:, -1], 0.0),
            diverged,
            np.zeros(len(rows)),
            np.ones(len(rows), dtype=bool),
            peak=np.where(sound, tension.max(axis=1), 0.0),
        )


LANES = 64
REST, SETTLED = "rest", "settled"
PERIOD, LONGEST, STILL = 10, 4000, 1e-7
"""Settling: steps between looks at the kinetic energy, most such periods, and the speed below which a body is at rest
[m/s or rad/s]."""
SHAKES = 20  # periods that a body has to stay at rest over, as speed is small wherever it turns round as well
MARKED = ("site", "body", "geom")  # elements that may be markers, in the order in which a bare name is looked up


def MuJoCo(
    path: str | Path,
    *,
    markers: Mapping[str, str] | Sequence[str] | None = None,
    channels: Mapping[str, str | int] | Sequence[str] | None = None,
    parameters: Mapping[str, Any] | None = None,
    cables: Mapping[str, str | int] | None = None,
    start: str = REST,
    time_step: float | None = None,
    command_unit: str | None = None,
    name: str | None = None,
    lanes: int = LANES,
    threads: int | None = None,
) -> BlackBox:
    """A MuJoCo model in the place of a robot.

    Args:
        path: an MJCF or URDF file.
        markers: element of each marker: ``{marker: site}``, or ``"body/NAME"`` or ``"geom/NAME"`` for the origin of a
            body or the centre of a geom; a list if they have the same names; all sites by default.
        channels: the actuator of each command: ``{command: actuator}``, by name or number; all of them by default.
            Actuators without a command keep the value of the keyframe, or zero.
        parameters: parameters that may be inferred: ``{parameter: address}``, see `mujoco_elements`; an address may
            be a table with ``low``, ``high``, ``prior``, ``unit`` or ``nominal`` of your own. Other attributes
            are candidates of an audit, by kind.
        cables: actuators whose pull is measured as a tension [N]: ``{cable: actuator}``.
        start: "rest", the model's reference pose without speed; "settled", the equilibrium under the first command,
            found from there by letting it move and taking its kinetic energy away at each peak; or the name or
            number of a keyframe.
        time_step: time step [s]; by default from the file.
        command_unit: unit of the commands; by default from the actuators' targets, "-" if these differ.
        name: name in reports; the model's own by default.
        lanes: number of parameter sets simulated at once.
        threads: number of threads; one per processor by default.

    Raises:
        InputError: no such file, a file that MuJoCo cannot read, or unknown names and addresses, with the nearest
            matches.
    """
    spec = _read(Path(path))
    if time_step is not None:
        spec.option.timestep = time_step
    marked = _markers(spec, markers)
    rollouts = MuJoCoRollouts(spec, marked, cables or {}, channels, start, threads, Path(path))
    model = rollouts.model
    named: dict[str, Parameter] = {}
    for given, entry in (parameters or {}).items():
        table = {"address": entry} if isinstance(entry, str) else dict(entry)
        if "address" not in table:
            raise InputError("no address", where=f"parameter {given!r}", remedy='give address = "kind/name/attribute"')
        edit, attribute, unit = edit_of(model, table.pop("address"))
        own = given.replace(" ", "_")
        words = f"{given.replace('_', ' ')}: {attribute.words}"
        rollouts.edits[own], named[own] = edit, parameter_of(edit, attribute, unit, words, table)
    families: dict[str, str] = {}
    taken = [element for edit in rollouts.edits.values() for element in edit.elements]
    for own, family, edit, parameter in searched(model, taken, rollouts.bodies(marked)):
        if own not in named:
            rollouts.edits[own], named[own], families[own] = edit, parameter, family
    unit = command_unit or rollouts.command_unit
    return BlackBox(
        rollouts,
        parameters=named,
        markers=tuple(marked),
        channels=tuple(rollouts.channels),
        time_step=float(model.opt.timestep),
        command_unit=unit,
        cables=tuple(cables or {}),
        name=name or spec.modelname or Path(path).stem,
        batched=True,
        lanes=lanes,
        usual_command=rollouts.usual_command,
        families=families,
        limits=rollouts.limits,
    )


def _read(path: Path) -> Any:
    """The model of a file, which can still be changed."""
    try:
        import mujoco
    except ImportError:
        raise InputError(
            "needs the package mujoco", where=str(path), remedy='pip install "rfdropo_bayes[mujoco]"'
        ) from None
    if not path.is_file():
        raise InputError("no such file", where=str(path), remedy="give an MJCF or URDF file")
    try:
        return mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise InputError(f"MuJoCo cannot read it: {error}", where=str(path), remedy="correct the file") from None


def _markers(spec: Any, markers: Mapping[str, str] | Sequence[str] | None) -> dict[str, tuple[str, str]]:
    """Kind and name of the element that each marker is."""
    names = {kind: [str(each.name) for each in _elements(spec, kind) if each.name] for kind in MARKED}
    if markers is None:
        markers = names["site"]
    if not markers:
        remedy = f'markers = {{tip = "body/NAME"}}; bodies: {", ".join(names["body"])}'
        raise InputError(
            "the model has no named site: state the elements of the markers", where="markers", remedy=remedy
        )
    given = dict(markers) if isinstance(markers, Mapping) else {each: each for each in markers}
    markers_found = {}
    for marker, place in given.items():
        kind, _, rest = place.partition("/")
        if kind in MARKED and rest:
            kinds, name = [kind], rest
        else:
            kinds, name = list(MARKED), place
        kind = next((each for each in kinds if name in names[each]), "")
        if not kind:
            remedy = nearest(name, [each for k in kinds for each in names[k]])
            raise InputError(f"no {' or '.join(kinds)} {name!r}", where=f"marker {marker!r}", remedy=remedy)
        markers_found[marker] = kind, name
    return markers_found


def _elements(spec: Any, kind: str) -> Sequence[Any]:
    return {"site": spec.sites, "body": spec.bodies, "geom": spec.geoms}[kind]


def first_tables(path: Path, markers: Mapping[str, Any], channels: Sequence[str]) -> tuple[dict[str, Any], list[str]]:
    """See `adapters.first_tables`; and `adapter_tables`."""
    model = _read(path).compile()
    _check_actuators(model, path)
    return adapter_tables(model, markers, channels)


def _check_actuators(model: Any, path: Path) -> None:
    """Raise an InputError if a model has no actuator, as in every URDF."""
    if model.nu == 0:
        remedy = "add actuators to its file"
        if path.suffix == ".urdf":
            remedy = (
                f"MuJoCo reads none of a URDF: write {path.stem}.xml with the text of "
                f"mujoco.MjSpec.from_file({path.name!r}).to_xml(), and add actuators there"
            )
        raise InputError("the model has no actuator to command", where=str(path), remedy=remedy)


class MuJoCoRollouts:
    """Rollouts of one model under many parameter sets.

    Args:
        spec: MjSpec of the model.
        markers: kind and name of each.
        cables: actuators whose pull is measured.
        channels: actuators that are commanded.
        start: see `MuJoCo`.
        threads: see `MuJoCo`.
        path: path of the model's source file.

    Attributes:
        spec: unchanged specification of the file.
        model: compiled, with sensors of the markers and cables.
        channels: number of the actuator's command in ``ctrl``, by channel.
        edits: effect of each parameter on the model, by name.
        first: state, and ``ctrl``, before anything settles.

    Raises:
        InputError: a model that does not compile, or names that it does not have.
    """

    def __init__(
        self,
        spec: Any,
        markers: Mapping[str, tuple[str, str]],
        cables: Mapping[str, str | int],
        channels: Mapping[str, str | int] | Sequence[str] | None,
        start: str,
        threads: int | None,
        path: Path,
    ) -> None:
        import mujoco

        self.path = path
        self.spec, self.threads, self.start = spec, threads or os.cpu_count() or 1, start
        measured = spec.copy()
        kinds = {"site": "mjOBJ_SITE", "body": "mjOBJ_XBODY", "geom": "mjOBJ_GEOM"}
        for number, (kind, name) in enumerate(markers.values()):
            place = {"objtype": getattr(mujoco.mjtObj, kinds[kind]), "objname": name}
            measured.add_sensor(type=mujoco.mjtSensor.mjSENS_FRAMEPOS, name=f"rfdropo marker {number}", **place)
        try:
            self.model = measured.compile()
        except ValueError as error:
            raise InputError(f"MuJoCo cannot compile it: {error}", where=str(spec.modelname)) from None
        self.cables = {
            cable: number_of(self.model, "actuator", actuator, where=f"cable {cable!r}")
            for cable, actuator in cables.items()
        }
        for cable, number in self.cables.items():
            name = mujoco.mj_id2name(self.model, mujoco.mjtObj.mjOBJ_ACTUATOR, number)
            if not name:
                raise InputError(f"the actuator of cable {cable!r} has no name", where="cables", remedy="name it")
            place = {"objtype": mujoco.mjtObj.mjOBJ_ACTUATOR, "objname": name}
            measured.add_sensor(type=mujoco.mjtSensor.mjSENS_ACTUATORFRC, name=f"rfdropo cable {cable}", **place)
        self.model = measured.compile()
        self.actuators = self._commanded(channels)
        self.channels = {name: int(self.model.actuator_ctrladr[k]) for name, k in self.actuators.items()}
        sensors = [self.model.sensor(f"rfdropo marker {k}").adr[0] for k in range(len(markers))]
        self._places = np.array([np.arange(adr, adr + 3) for adr in sensors])
        self._pulls = np.array([self.model.sensor(f"rfdropo cable {c}").adr[0] for c in self.cables], dtype=int)
        self.edits: dict[str, Edit] = {}
        self._models: list[Any] = []
        self.first = self._first_state()

    def bodies(self, markers: Mapping[str, tuple[str, str]]) -> list[int]:
        """Numbers of the bodies that markers are on."""
        model = self.model
        on = {"site": model.site_bodyid, "geom": model.geom_bodyid, "body": np.arange(model.nbody)}
        return [int(on[kind][number_of(model, kind, name, where="markers")]) for kind, name in markers.values()]

    def _commanded(self, channels: Mapping[str, str | int] | Sequence[str] | None) -> dict[str, int]:
        """Number of the actuator of each channel."""
        names = element_names(self.model, "actuator")
        _check_actuators(self.model, self.path)
        if channels is None:
            channels = {name if not name.isdigit() else f"actuator_{name}": name for name in names}
        given = dict(channels) if isinstance(channels, Mapping) else {each: each for each in channels}
        if not given:
            raise InputError("no actuator is commanded", where="channels", remedy="name one, or leave channels out")
        return {
            channel: number_of(self.model, "actuator", actuator, where=f"channel {channel!r}")
            for channel, actuator in given.items()
        }

    @property
    def engine(self) -> str:
        """Name and version of the engine."""
        import mujoco

        return f"mujoco {mujoco.__version__}"

    @property
    def command_unit(self) -> str:
        """Unit of the commands: of a length or an angle that actuators follow, of a force or a torque, else "-"."""
        units = {self._unit_of(number) for number in self.actuators.values()}
        return units.pop() if len(units) == 1 else "-"

    def _unit_of(self, number: int) -> str:
        import mujoco

        model, turning = self.model, False
        if int(model.actuator_trntype[number]) == mujoco.mjtTrn.mjTRN_JOINT:
            turning = motion_of(model, int(model.actuator_trnid[number][0])) == TURNING
        feedback, gain = model.actuator_biasprm[number], model.actuator_gainprm[number][0]
        gear = float(model.actuator_gear[number][0])
        if feedback[1] != 0.0 and np.isclose(feedback[1], -gain) and np.isclose(gear, 1.0):
            return "rad" if turning else "m"
        plain = not np.any(feedback) and int(model.actuator_dyntype[number]) == 0
        return ("N m" if turning else "N") if plain and np.isclose(gain * gear, 1.0) else "-"

    @property
    def usual_command(self) -> float:
        """Size of usual commands: half the mean of their ranges, 1 without ranges."""
        ranges = [np.ptp(self.model.actuator_ctrlrange[k]) for k in self.actuators.values()]
        return 0.5 * float(np.mean([r if r > 0.0 else 2.0 for r in ranges]))

    @property
    def limits(self) -> dict[str, tuple[float, float]]:
        """Range of each channel's command, if its actuator has a range."""
        ranges = {name: self.model.actuator_ctrlrange[k] for name, k in self.actuators.items()}
        limited = {name for name, k in self.actuators.items() if self.model.actuator_ctrllimited[k]}
        return {name: (float(low), float(high)) for name, (low, high) in ranges.items() if name in limited}

    @cached_property
    def digest(self) -> str:
        """Digest of the compiled model and of its measured elements."""
        import mujoco

        content = np.empty(mujoco.mj_sizeModel(self.model), np.uint8)
        mujoco.mj_saveModel(self.model, None, content)
        edits = sorted((name, edit.form, edit.elements) for name, edit in self.edits.items())
        settings = repr((self.start, sorted(self.channels.items()), sorted(self.cables.items()), edits))
        return hashlib.sha256(content.tobytes() + settings.encode()).hexdigest()

    def _first_state(self) -> tuple[np.ndarray, np.ndarray]:
        """Whole state, and commands, that a rollout begins with."""
        import mujoco

        data = mujoco.MjData(self.model)
        key = None
        if self.start not in (REST, SETTLED):
            keys = [self.model.key(k).name or str(k) for k in range(self.model.nkey)]
            if self.start not in keys:
                remedy = nearest(self.start, [REST, SETTLED, *keys])
                raise InputError(f"no keyframe {self.start!r}", where="start", remedy=remedy)
            key = keys.index(self.start)
        if key is not None:
            mujoco.mj_resetDataKeyframe(self.model, data, key)
        state = np.empty(mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
        mujoco.mj_getState(self.model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        return state, data.ctrl.copy()

    def __call__(
        self, values: Mapping[str, Float[np.ndarray, " n"]], commands: Float[np.ndarray, "n row channel"]
    ) -> dict[str, np.ndarray]:
        """Roll out a batch: positions (n, row, marker, 3) [m] and tensions (n, row, cable) [N], NaN after a diverged
        rollout.
        """
        models = self.models(values, len(commands))
        ctrl = np.tile(self.first[1], (*commands.shape[:2], 1))
        ctrl[:, :, list(self.channels.values())] = commands
        state, valid = self.begun(models, ctrl[:, 0])
        # MuJoCo's sensors refer to the state before a step: one step more than rows shows the last row.
        played = np.concatenate([ctrl[:, 1:], ctrl[:, -1:]], axis=1)
        states, sensed = self.rolled(models, state, played)
        valid &= self._arrived(states[:, -1], len(commands[0]))
        position, pull = self.shown(sensed)
        position[~valid], pull[~valid] = np.nan, np.nan
        return {"position": position, "tension": pull} if self.cables else {"position": position}

    def models(self, values: Mapping[str, Float[np.ndarray, " n"]], count: int) -> list[Any]:
        """A model for each parameter set."""
        import mujoco

        while len(self._models) < count:
            self._models.append(copy.copy(self.model))
        scratch = self._data[0]
        for lane, model in enumerate(self._models[:count]):
            for field, nominal in self._touched.items():
                field_of(model, field)[...] = nominal
            for name, edit in self.edits.items():
                if name in values:
                    edit.apply(model, float(values[name][lane]))
            mujoco.mj_setConst(model, scratch)
        return self._models[:count]

    def written(self, values: Mapping[str, float], remarks: Sequence[str]) -> tuple[str, str]:
        """Suffix and text of a file of the model with some values; the text begins with ``remarks``.

        Raises:
            InputError: the file cannot describe the model.
        """
        (model,) = self.models({name: np.array([value]) for name, value in values.items()}, 1)
        return ".xml", model_text(self, model, self.path, values, remarks)

    @cached_property
    def _touched(self) -> dict[str, np.ndarray]:
        """Fields that parameters change, as the model has them."""
        fields = {place.field for edit in self.edits.values() for place in edit.places}
        return {field: np.array(field_of(self.model, field)[...]) for field in sorted(fields)}

    @cached_property
    def _data(self) -> list[Any]:
        import mujoco

        return [mujoco.MjData(self.model) for _ in range(self.threads)]

    @cached_property
    def _pool(self) -> Any:
        from mujoco.rollout import Rollout

        return Rollout(nthread=self.threads)

    def rolled(
        self, models: list[Any], state: Float[np.ndarray, "n state"], ctrl: Float[np.ndarray, "n step ctrl"]
    ) -> tuple[Float[np.ndarray, "n step state"], Float[np.ndarray, "n step sensor"]]:
        """States after each step, and sensor values before it."""
        with _unheard():
            return self._pool.rollout(models, self._data, state, np.ascontiguousarray(ctrl))

    def shown(
        self, sensed: Float[np.ndarray, "n step sensor"]
    ) -> tuple[Float[np.ndarray, "n step marker 3"], Float[np.ndarray, "n step cable"]]:
        """Positions of the markers [m] and pulls of the cables [N] from sensor values."""
        return sensed[:, :, self._places], -sensed[:, :, self._pulls]

    def begin_lanes(self, count: int) -> MuJoCoLanes:
        """Lanes for a session, which continue from their state; see `MuJoCoLanes`."""
        return MuJoCoLanes(self, count)

    def _arrived(self, state: Float[np.ndarray, "n state"], steps: int) -> Bool[np.ndarray, " n"]:
        """Mask of complete rollouts; MuJoCo stops the clock of a rollout with a warning."""
        late = state[:, 0] - self.first[0][0] - steps * self.model.opt.timestep
        return (np.abs(late) < 0.5 * self.model.opt.timestep) & np.isfinite(state).all(axis=1)

    def begun(
        self, models: list[Any], ctrl: Float[np.ndarray, "n ctrl"]
    ) -> tuple[Float[np.ndarray, "n state"], Bool[np.ndarray, " n"]]:
        """Initial states under the first commands, and which of them were found."""
        state = np.tile(self.first[0], (len(models), 1))
        valid = np.ones(len(models), dtype=bool)
        if self.start != SETTLED:
            return state, valid
        speed = slice(1 + self.model.nq, 1 + self.model.nq + self.model.nv)
        before, still = np.zeros(len(models)), np.zeros(len(models), dtype=int)
        constant = np.repeat(ctrl[:, None], PERIOD, axis=1)
        for _ in range(LONGEST):
            moving = valid & (still < SHAKES)
            if not moving.any():
                break
            rows = np.flatnonzero(moving)
            state[rows, 0] = self.first[0][0]
            state[rows] = self.rolled([models[k] for k in rows], state[rows], constant[rows])[0][:, -1]
            valid[rows] = self._arrived(state[rows], PERIOD)
            energy = np.sum(state[:, speed] ** 2, axis=1)
            still = np.where(np.abs(state[:, speed]).max(axis=1, initial=0.0) < STILL, still + 1, 0)
            turned = moving & (energy < before)
            state[turned, speed] = 0.0
            before = np.where(turned, 0.0, energy)
        state[:, 0] = self.first[0][0]
        return state, valid & (still >= SHAKES)


@contextmanager
def _unheard() -> Iterator[None]:
    """Warnings of unstable rollouts are dropped, since a status marks diverged rollouts."""
    import mujoco

    kept = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(kept)
