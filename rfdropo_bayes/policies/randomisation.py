"""Sources of the parameters of an episode: a posterior, RF-DROPO's phi, uniform ranges, or one point."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float
from scipy.stats import truncnorm

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.mechanisms import REGISTRY, mechanisms_named
from rfdropo_bayes.posteriors import PosteriorRecord
from rfdropo_bayes.robots import Robot
from rfdropo_bayes.simulators.black_box import BlackBox
from rfdropo_bayes.simulators.parameters import ParameterSpec, check_names, check_value

POSTERIOR, PHI = "posterior.nc", "summary.json"


class Randomisation(Protocol):
    """A distribution over a simulator's parameters."""

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters that the randomisation varies or sets."""
        ...

    @property
    def kind(self) -> str:
        """ "posterior", "phi", "uniform" or "point"."""
        ...

    @property
    def sha256(self) -> str:
        """Digest of its inputs."""
        ...

    def draw(self, rng: np.random.Generator) -> dict[str, float]:
        """Values for one episode."""
        ...


def _digest(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=float).encode()).hexdigest()


@dataclass(frozen=True)
class Point:
    """The same values in every episode; an empty mapping is the nominal simulator."""

    values: Mapping[str, float]
    kind: str = "point"

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters that are set."""
        return tuple(self.values)

    @property
    def sha256(self) -> str:
        """Digest of the values."""
        return _digest(dict(self.values))

    def draw(self, rng: np.random.Generator) -> dict[str, float]:
        """The values."""
        return dict(self.values)


@dataclass(frozen=True)
class Uniform:
    """Independent uniform ranges: uniform domain randomisation."""

    ranges: Mapping[str, tuple[float, float]]
    kind: str = "uniform"

    def __post_init__(self) -> None:
        for name, (low, high) in self.ranges.items():
            if not low <= high:
                raise InputError(
                    f"the range of {name} begins at {low:g} and ends at {high:g}",
                    where="ranges",
                    remedy="give the lower end first",
                )

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters that vary."""
        return tuple(self.ranges)

    @property
    def sha256(self) -> str:
        """Digest of the ranges."""
        return _digest({name: list(ends) for name, ends in self.ranges.items()})

    def draw(self, rng: np.random.Generator) -> dict[str, float]:
        """A point of the box."""
        return {name: float(rng.uniform(low, high)) for name, (low, high) in self.ranges.items()}


@dataclass(frozen=True)
class Phi:
    """RF-DROPO's distribution: independent normals, cut off at ``low`` and ``high`` [parameter units]."""

    normals: Mapping[str, Mapping[str, float]]
    kind: str = "phi"

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters that vary."""
        return tuple(self.normals)

    @property
    def sha256(self) -> str:
        """Digest of the normals."""
        return _digest({name: dict(normal) for name, normal in self.normals.items()})

    def draw(self, rng: np.random.Generator) -> dict[str, float]:
        """Independent draws."""
        values = {}
        for name, normal in self.normals.items():
            mean, std = normal["mean"], max(normal["std"], 1e-300)
            low, high = (normal["low"] - mean) / std, (normal["high"] - mean) / std
            values[name] = float(truncnorm.rvs(low, high, loc=mean, scale=std, random_state=rng))
        return values


@dataclass(frozen=True)
class Draws:
    """Rows of a posterior: whole rows, so that correlations between parameters stay."""

    names: tuple[str, ...]
    rows: Float[np.ndarray, "draw parameter"]
    sha256: str
    kind: str = "posterior"

    def draw(self, rng: np.random.Generator) -> dict[str, float]:
        """One row."""
        row = self.rows[rng.integers(len(self.rows))]
        return dict(zip(self.names, map(float, row), strict=True))


@dataclass(frozen=True)
class Sessions:
    """Rows of a posterior, each in a new session that no fit has seen."""

    draws: Draws  # the rows; their parameters are shared by all sessions
    # standard deviations between sessions of the varying parameters, one value per row
    spreads: Mapping[str, Float[np.ndarray, " draw"]]
    ends: Mapping[str, tuple[float, float]]  # hard bounds of these parameters
    kind: str = "posterior"

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters of the rows."""
        return self.draws.names

    @property
    def sha256(self) -> str:
        """Digest of rows and spreads."""
        return _digest([self.draws.sha256, {name: column.tolist() for name, column in self.spreads.items()}])

    def draw(self, rng: np.random.Generator) -> dict[str, float]:
        """One row plus a session's deviations, which are normal with the row's spread; sums are clipped to the hard
        bounds, as in fits and predictions.
        """
        index = int(rng.integers(len(self.draws.rows)))
        values = dict(zip(self.names, map(float, self.draws.rows[index]), strict=True))
        for name, column in self.spreads.items():
            values[name] = float(np.clip(rng.normal(values[name], float(column[index])), *self.ends[name]))
        return values


@dataclass(frozen=True)
class Layers:
    """Several randomisations at once; if two vary the same parameter, the later part wins."""

    parts: tuple[Randomisation, ...]  # randomisations, from fixed values to values that differ between episodes
    kind: str  # kind of the part that names the whole

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters that vary or are held."""
        return tuple(dict.fromkeys(name for part in self.parts for name in part.names))

    @property
    def sha256(self) -> str:
        """Digest of all parts."""
        return _digest([part.sha256 for part in self.parts])

    def draw(self, rng: np.random.Generator) -> dict[str, float]:
        """A draw of every part."""
        return {name: value for part in self.parts for name, value in part.draw(rng).items()}


@dataclass(frozen=True)
class Present:
    """A posterior or phi without values that would show the future.

    A recording may have time stamps from before its motion; a policy sees nothing early.
    """

    recorded: Randomisation  # the randomisation as the recordings determine it
    early: tuple[str, ...]  # parameters whose values below zero become zero, see `ClockOffset.shows_future`

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters that vary or are held."""
        return self.recorded.names

    @property
    def kind(self) -> str:
        """Kind of the randomisation."""
        return self.recorded.kind

    @property
    def sha256(self) -> str:
        """Digest of its inputs."""
        return _digest([self.recorded.sha256, self.early])

    def draw(self, rng: np.random.Generator) -> dict[str, float]:
        """Values for one episode."""
        drawn = self.recorded.draw(rng)
        return {name: max(value, 0.0) if name in self.early else value for name, value in drawn.items()}

    def share_changed(self, name: str) -> float:
        """Share of 1,000 draws in which a parameter is below zero."""
        rng = np.random.default_rng(0)
        return float(np.mean([self.recorded.draw(rng)[name] < 0.0 for _ in range(1000)]))


def fitting(randomisation: Randomisation, specs: Sequence[ParameterSpec]) -> Randomisation:
    """The randomisation, if every value that it can give lies within the hard bounds of a parameter of the simulator.

    Raises:
        InputError: an unknown parameter, or values outside its bounds, with the number of such draws of a posterior.
    """
    if isinstance(randomisation, Layers):
        for part in randomisation.parts:
            fitting(part, specs)
        return randomisation
    if isinstance(randomisation, Sessions):
        fitting(randomisation.draws, specs)
        return randomisation
    if isinstance(randomisation, Present):
        fitting(randomisation.recorded, specs)
        return randomisation
    where = f"randomisation ({randomisation.kind})"
    check_names(randomisation.names, specs, where=where)
    known = {spec.name: spec for spec in specs}
    if isinstance(randomisation, Draws):
        for index, name in enumerate(randomisation.names):
            column, spec = randomisation.rows[:, index], known[name]
            bad = ~((column >= spec.low) & (column <= spec.high))
            if bad.any():
                raise InputError(
                    f"{int(bad.sum())} of {len(column)} draws of {name} are outside its hard bounds "
                    f"[{spec.low:g}, {spec.high:g}] {spec.unit}, or not finite",
                    where=where,
                    remedy="calibrate with this robot",
                )
        return randomisation
    ends: dict[str, tuple[float, ...]] = {}
    if isinstance(randomisation, Point):
        ends = {name: (float(value),) for name, value in randomisation.values.items()}
    elif isinstance(randomisation, Uniform):
        ends = {name: tuple(map(float, pair)) for name, pair in randomisation.ranges.items()}
    elif isinstance(randomisation, Phi):
        ends = {name: (n["low"], n["high"]) for name, n in randomisation.normals.items()}
    for name, values in ends.items():
        for value in values:
            check_value(known[name], value, where=where)
    return randomisation


def with_width(randomisation: Randomisation, width: float, specs: Sequence[ParameterSpec]) -> Randomisation:
    """A posterior or phi whose draws are ``width`` times as far from their middle, up to the parameters' hard bounds.

    Positive parameters are spread in logarithms.

    Raises:
        InputError: the distribution is uniform or a point, whose width the user states directly.
    """
    if isinstance(randomisation, Layers):
        *before, last = randomisation.parts
        return replace(randomisation, parts=(*before, with_width(last, width, specs)))
    known = {spec.name: spec for spec in specs}
    if isinstance(randomisation, Sessions):
        spreads = {name: width * column for name, column in randomisation.spreads.items()}
        return replace(randomisation, draws=_spread_rows(randomisation.draws, width, known), spreads=spreads)
    if isinstance(randomisation, Draws):
        return _spread_rows(randomisation, width, known)
    if isinstance(randomisation, Phi):
        normals = {name: {**normal, "std": width * normal["std"]} for name, normal in randomisation.normals.items()}
        return replace(randomisation, normals=normals)
    raise InputError(
        f"width = {width:g} applies only to a posterior and to phi",
        where="[training]",
        remedy='leave width out, or set randomisation = "posterior" or "phi"',
    )


def _spread_rows(draws: Draws, width: float, known: Mapping[str, ParameterSpec]) -> Draws:
    columns = []
    for name, column in zip(draws.names, draws.rows.T, strict=True):
        if (column > 0.0).all():
            logarithm = np.log(column)
            wide = np.exp(logarithm.mean() + width * (logarithm - logarithm.mean()))
        else:
            wide = column.mean() + width * (column - column.mean())
        columns.append(np.clip(wide, known[name].low, known[name].high))
    return replace(draws, rows=np.stack(columns, axis=1), sha256=_digest([draws.sha256, width]))


def read_posterior(path: Path, specs: Sequence[ParameterSpec], robot: Robot | BlackBox | None = None) -> Draws:
    """Draws of a saved posterior, restricted to the simulator's parameters; noise and values of single recordings are
    left out.

    Args:
        path: posterior.nc, or the run folder that holds it.
        specs: the simulator's parameters.
        robot: simulated robot, which determines the parameters of mechanisms.

    Raises:
        InputError: no such file, no posterior of ours, a posterior that shares no parameter with the simulator, or a
            posterior with a mechanism that the simulator lacks.
    """
    path = Path(path)
    file = path / POSTERIOR if path.is_dir() else path
    record = PosteriorRecord.load(file)
    drawn = drawn_rows(record, specs, where=str(file), robot=robot)
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    return replace(drawn, sha256=digest)


def drawn_rows(
    record: PosteriorRecord,
    specs: Sequence[ParameterSpec],
    *,
    where: str = "posterior",
    robot: Robot | BlackBox | None = None,
) -> Draws:
    """Rows of a posterior, of the parameters that the simulator has.

    Raises:
        InputError: the source shares no parameter with the simulator, or has a mechanism that the simulator lacks.
    """
    known = {spec.name for spec in specs}
    _require_mechanisms([info.name for info in record.free if info.name not in known], robot, where)
    names = tuple(info.name for info in record.free if info.name in known)
    if not names:
        raise InputError(
            "the posterior shares no parameter with the simulator",
            where=where,
            remedy="use a calibration of this robot",
        )
    rows = np.stack([record.flat(name) for name in names], axis=1)
    return Draws(names, rows, hashlib.sha256(np.ascontiguousarray(rows).tobytes()).hexdigest())


def read_phi(path: Path, specs: Sequence[ParameterSpec], robot: Robot | BlackBox | None = None) -> Phi:
    """RF-DROPO's distribution from a run folder.

    Raises:
        InputError: the folder has no summary, the method has no phi, or phi does not match the simulator.
    """
    path = Path(path)
    file = path / PHI if path.is_dir() else path
    try:
        summary = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise InputError("cannot read the summary of a run", where=str(file), remedy="name a run folder") from None
    if not summary.get("phi"):
        raise InputError(
            f"the method {summary.get('method')!r} has no phi",
            where=str(file),
            remedy='calibrate with method = "rfdropo", or randomise over the posterior',
        )
    known = {spec.name for spec in specs}
    _require_mechanisms([name for name in summary["phi"] if name not in known], robot, str(file))
    shared = {name: normal for name, normal in summary["phi"].items() if name in known}
    if not shared:
        raise InputError(
            "phi shares no parameter with the simulator", where=str(file), remedy="use a calibration of this robot"
        )
    return Phi(shared)


def _require_mechanisms(missing: Sequence[str], robot: Robot | BlackBox | None, where: str) -> None:
    """Raise an InputError if a parameter that the simulator lacks belongs to a mechanism of the library."""
    for name in REGISTRY if missing else ():
        (mechanism,) = mechanisms_named([name], robot)
        own = [spec.name for spec in mechanism.parameters if spec.name in missing]
        if own:
            raise InputError(
                f"has {own[0]}, of the mechanism {name!r}, which the simulator lacks",
                where=where,
                remedy=f'add "{name}" to [model] mechanisms',
            )
