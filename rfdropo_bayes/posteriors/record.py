"""A posterior and its predictions as plain arrays: the input of a report, free of ArviZ."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.posteriors.derived import Derived, LessMedian, ProductOfPowers, evaluate_derived
from rfdropo_bayes.posteriors.inference_data import (
    InferenceData,
    in_arviz,
    load_posterior,
    save_posterior,
    to_tree,
    variable_key,
)
from rfdropo_bayes.posteriors.parameter_info import ParameterInfo, Scope

AXES = ("x", "y", "z")
DRAWS = "draws"  # attribute of a prediction: how many draws are its own
FIXED = "fixed_parameters"  # attribute of a posterior


@dataclass(frozen=True)
class RecordingPrediction:
    """One recording, measured and predicted, in the robot's base frame."""

    name: str  # name of the recording
    split: str  # "fit" if the parameters were inferred from it, "test" if no fit ever saw it
    time: Float[np.ndarray, " time"]  # [s]
    marker_names: tuple[str, ...]  # base to tip; the last marker is the headline
    observed: Float[np.ndarray, "time marker 3"]  # measured positions [m]; finite placeholders if masked
    mask: Bool[np.ndarray, "time marker"]  # True for usable positions
    # predictive draws of the measurement [m], observation noise included
    predicted: Float[np.ndarray, "draw time marker 3"]
    # predictive mean without noise [m]; the mean of ``predicted`` if None
    mean: Float[np.ndarray, "time marker 3"] | None = None
    # the same as ``predicted`` under the prior, or None
    prior_predicted: Float[np.ndarray, "draw time marker 3"] | None = None
    repeat_group: int = -1  # equal numbers mark repeats of the same commands; -1 marks none
    # draws of a pushed object's pose, position [m] and unit quaternion (x, y, z, w), or None. It is not kept in
    # `posterior.nc`.
    object_pose: Float[np.ndarray, "draw time 7"] | None = None

    def __post_init__(self) -> None:
        shape = (len(self.time), len(self.marker_names), 3)
        fits = np.shape(self.observed) == shape and np.shape(self.mask) == shape[:2]
        fits = fits and np.shape(self.predicted)[1:] == shape and np.shape(self.central) == shape
        if not fits or (self.prior_predicted is not None and np.shape(self.prior_predicted)[1:] != shape):
            raise InputError("measured and predicted positions differ in shape", where=self.name)
        if self.split not in ("fit", "test"):
            raise InputError(f"split is {self.split!r}", where=self.name, remedy='it must be "fit" or "test"')

    @cached_property
    def central(self) -> Float[np.ndarray, "time marker 3"]:
        """The point prediction [m]."""
        return np.mean(self.predicted, axis=0, dtype=float) if self.mean is None else np.asarray(self.mean)


@dataclass(frozen=True)
class PosteriorRecord:
    """Everything that `posterior.nc` holds."""

    parameters: tuple[ParameterInfo, ...]  # one entry per variable of ``posterior``, derived quantities included
    posterior: Mapping[str, Float[np.ndarray, "chain draw"]]  # draws of equal weight, physical units
    # prior draws, physical units; may be empty
    prior: Mapping[str, Float[np.ndarray, " draw"]] = field(default_factory=dict)
    recordings: tuple[RecordingPrediction, ...] = ()  # predictions; may be empty
    derived: tuple[Derived, ...] = ()  # definitions of the variables that are functions of others
    trace: Sequence[Mapping[str, float]] = ()  # numbers of the sampler, one dictionary per stage
    # per block ``first_row``, ``last_row`` (1-based, inclusive), ``log_score`` = log p(block | rows before it), ``sd``
    block_scores: Sequence[Mapping[str, float]] = ()
    # log likelihood of each data row at each draw, or None
    log_likelihood: Float[np.ndarray, "chain draw row"] | None = None
    attrs: Mapping[str, Any] = field(default_factory=dict)  # data hash, seed, versions and the like

    def __post_init__(self) -> None:
        if tuple(info.name for info in self.parameters) != tuple(self.posterior):
            raise InputError("parameters and draws do not list the same names in the same order", where="posterior")

    @property
    def free(self) -> tuple[ParameterInfo, ...]:
        """The inferred parameters, without the derived quantities."""
        names = {product.name for product in self.derived}
        return tuple(info for info in self.parameters if info.name not in names)

    @property
    def fixed(self) -> list[tuple[ParameterInfo, float]]:
        """Parameters whose values the fit took for known, with these."""
        return [(ParameterInfo.from_dict(each["parameter"]), each["value"]) for each in self.attrs.get(FIXED, ())]

    def flat(self, name: str) -> Float[np.ndarray, " n"]:
        """Draws of one variable, chains joined."""
        return np.asarray(self.posterior[name]).reshape(-1)

    def with_derived(self, quantities: Sequence[Derived]) -> PosteriorRecord:
        """The same record with quantities added that are functions of its parameters, in posterior and prior.

        Raises:
            InputError: see `evaluate_derived`.
        """
        lows = [0.0 if isinstance(q, ProductOfPowers) else -np.inf for q in quantities]
        infos = [
            ParameterInfo(q.parameter, q.unit, low, np.inf, {}, q.description, Scope(q.owner))
            for q, low in zip(quantities, lows, strict=True)
        ]
        prior = {**self.prior, **evaluate_derived(self.prior, quantities)} if self.prior else {}
        return PosteriorRecord(
            (*self.parameters, *infos),
            {**self.posterior, **evaluate_derived(self.posterior, quantities)},
            prior,
            self.recordings,
            (*self.derived, *quantities),
            self.trace,
            self.block_scores,
            self.log_likelihood,
            self.attrs,
        )

    def inference_data(self) -> InferenceData:
        """The record in ArviZ's layout."""
        return in_arviz(self.tree())

    def tree(self) -> xr.DataTree:
        """The record as a tree of datasets, one for each of ArviZ's groups."""
        derived = [asdict(quantity) for quantity in self.derived]
        masks = {  # ArviZ expects a prediction of all observed data
            f"mask_{i}": ((f"time_{i}", f"marker_{i}"), np.asarray(r.mask, dtype=np.int8))
            for i, r in enumerate(self.recordings)
        }
        return to_tree(
            self.posterior,
            prior=self.prior,
            posterior_predictive=_predictions(self.recordings),
            prior_predictive=_prior_predictions(self.recordings),
            observed_data=_observations(self.recordings),
            constant_data=xr.Dataset(masks) if masks else None,
            sample_stats=_stages(self.trace, self.block_scores),
            log_likelihood=self.log_likelihood,
            parameters=self.parameters,
            attrs={"attributes": dict(self.attrs), "derived": derived, "names": list(self.posterior)},
        )

    def save(self, path: Path) -> None:
        """Write `posterior.nc`.

        Raises:
            InputError: if the file cannot be written.
        """
        save_posterior(self.tree(), path)

    @classmethod
    def load(cls, path: Path) -> PosteriorRecord:
        """Read `posterior.nc`.

        Raises:
            InputError: if the file is missing, damaged, or not one of ours.
        """
        tree = load_posterior(path)
        try:
            return _from_groups(tree)
        except (KeyError, AttributeError, json.JSONDecodeError) as error:
            raise InputError(
                f"lacks part of a posterior of ours ({error})", where=str(path), remedy="calibrate again"
            ) from None


def _derived(stored: Mapping[str, Any]) -> Derived:
    if "powers" in stored:
        return ProductOfPowers(**stored)
    return LessMedian(**{**stored, "family": tuple(stored["family"])})


def _from_groups(tree: xr.DataTree) -> PosteriorRecord:
    data = {name: child.to_dataset() for name, child in tree.children.items()}
    names = json.loads(tree.attrs["names"])
    variables = [data["posterior"][variable_key(name)] for name in names]
    parameters = tuple(
        ParameterInfo.from_dict(
            {
                **{key: v.attrs[key] for key in ("parameter", "unit", "description")},
                **{key: float(v.attrs[key]) for key in ("low", "high")},
                **{key: json.loads(v.attrs[key]) for key in ("prior", "scope")},
            }
        )
        for v in variables
    )
    prior, stats = data.get("prior", xr.Dataset()), data.get("sample_stats", xr.Dataset())
    return PosteriorRecord(
        parameters,
        {name: v.values for name, v in zip(names, variables, strict=True)},
        {name: prior[variable_key(name)].values[0] for name in names if variable_key(name) in prior},
        _recordings(data) if "observed_data" in data else (),
        tuple(_derived(quantity) for quantity in json.loads(tree.attrs["derived"])),
        _rows(stats, "stage"),
        _rows(stats, "block"),
        data["log_likelihood"]["row"].values if "log_likelihood" in data else None,
        json.loads(tree.attrs["attributes"]),
    )


def _predictions(recordings: Sequence[RecordingPrediction]) -> xr.Dataset | None:
    """Recordings differ in length and may differ in the number of draws, but ArviZ has a single number of draws."""
    predicted = {i: np.asarray(r.predicted, dtype=np.float32) for i, r in enumerate(recordings)}
    data = _with_draws(predicted)
    for i, r in enumerate(recordings):
        data[f"mean_{i}"] = ((f"time_{i}", f"marker_{i}", "axis"), r.central)
    return xr.Dataset(data, coords={"axis": list(AXES)}) if data else None


def _prior_predictions(recordings: Sequence[RecordingPrediction]) -> xr.Dataset | None:
    predicted = {
        i: np.asarray(r.prior_predicted, dtype=np.float32)
        for i, r in enumerate(recordings)
        if r.prior_predicted is not None
    }
    return xr.Dataset(_with_draws(predicted), coords={"axis": list(AXES)}) if predicted else None


def _with_draws(predicted: Mapping[int, Float[np.ndarray, "draw time marker 3"]]) -> dict[str, Any]:
    """Positions with one dimension of draws; recordings with fewer draws are repeated to the same length."""
    most = max((len(each) for each in predicted.values()), default=0)
    data: dict[str, Any] = {}
    for i, each in predicted.items():
        dims = ("chain", "draw", f"time_{i}", f"marker_{i}", "axis")
        data[f"position_{i}"] = (dims, np.resize(each, (1, most, *each.shape[1:])), {DRAWS: len(each)})
    return data


def _own_draws(positions: xr.DataArray) -> Float[np.ndarray, "draw time marker 3"]:
    return positions.values[0, : int(positions.attrs[DRAWS])]


def _observations(recordings: Sequence[RecordingPrediction]) -> xr.Dataset | None:
    data: dict[str, Any] = {}
    coords: dict[str, Any] = {"axis": list(AXES)}
    for i, r in enumerate(recordings):
        attrs = {"name": r.name, "split": r.split, "repeat_group": int(r.repeat_group), "unit": "m"}
        data[f"position_{i}"] = ((f"time_{i}", f"marker_{i}", "axis"), np.asarray(r.observed, dtype=float), attrs)
        coords |= {f"time_{i}": np.asarray(r.time, dtype=float), f"marker_{i}": list(r.marker_names)}
    return xr.Dataset(data, coords=coords, attrs={"recordings": len(recordings)}) if recordings else None


def _recordings(data: Mapping[str, xr.Dataset]) -> tuple[RecordingPrediction, ...]:
    observed, predicted, masks = (data[name] for name in ("observed_data", "posterior_predictive", "constant_data"))
    before = data.get("prior_predictive", xr.Dataset())
    return tuple(
        RecordingPrediction(
            observed[f"position_{i}"].attrs["name"],
            observed[f"position_{i}"].attrs["split"],
            observed[f"time_{i}"].values,
            tuple(str(name) for name in observed[f"marker_{i}"].values),
            observed[f"position_{i}"].values,
            masks[f"mask_{i}"].values.astype(bool),
            _own_draws(predicted[f"position_{i}"]),
            predicted[f"mean_{i}"].values,
            _own_draws(before[f"position_{i}"]) if f"position_{i}" in before else None,
            int(observed[f"position_{i}"].attrs["repeat_group"]),
        )
        for i in range(int(observed.attrs["recordings"]))
    )


def _stages(trace: Sequence[Mapping[str, Any]], blocks: Sequence[Mapping[str, Any]]) -> xr.Dataset | None:
    data = {}
    for dim, rows in (("stage", trace), ("block", blocks)):
        for key in dict.fromkeys(key for row in rows for key in row):
            column = [_number(row.get(key)) for row in rows]
            if not all(value is None for value in column):
                data[f"{dim}_{key}"] = (dim, np.array([np.nan if v is None else v for v in column], dtype=float))
    return xr.Dataset(data) if data else None


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, bool | int | float | np.number | np.bool_) else None


def _rows(stats: xr.Dataset, dim: str) -> tuple[dict[str, float], ...]:
    """One dictionary per stage or block; missing values are left out."""
    columns = {str(key).removeprefix(f"{dim}_"): v.values for key, v in stats.items() if v.dims == (dim,)}
    return tuple(
        {key: float(column[i]) for key, column in columns.items() if not np.isnan(column[i])}
        for i in range(stats.sizes.get(dim, 0))
    )
