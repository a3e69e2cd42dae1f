"""Posteriors as trees of datasets, in NetCDF and as ArviZ has them; all code that depends on ArviZ's version is
here.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from jaxtyping import Float

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import whole
from rfdropo_bayes.posteriors.parameter_info import ParameterInfo
from rfdropo_bayes.tables import plain

with warnings.catch_warnings():  # 0.23 announces its successor on import
    warnings.simplefilter("ignore", FutureWarning)
    import arviz

TREES = not arviz.__version__.startswith("0.")  # from 1.0 on ArviZ takes trees as they are
if TYPE_CHECKING or not TREES:
    from arviz import InferenceData
else:
    InferenceData = xr.DataTree

SCHEMA = "rfdropo_bayes.posterior/2"

Draws = Mapping[str, Float[np.ndarray, "chain draw"]]


def to_tree(
    posterior: Draws,
    *,
    prior: Mapping[str, Float[np.ndarray, " draw"]] | None = None,
    posterior_predictive: xr.Dataset | None = None,
    prior_predictive: xr.Dataset | None = None,
    observed_data: xr.Dataset | None = None,
    constant_data: xr.Dataset | None = None,
    sample_stats: xr.Dataset | None = None,
    log_likelihood: Float[np.ndarray, "chain draw row"] | None = None,
    parameters: Sequence[ParameterInfo] = (),
    attrs: Mapping[str, Any] | None = None,
) -> xr.DataTree:
    """Put draws and their data into ArviZ's layout.

    Args:
        posterior: draws of each parameter, physical (SI) units.
        prior: prior draws of each parameter.
        posterior_predictive, prior_predictive, observed_data, constant_data, sample_stats: groups to store unchanged.
        log_likelihood: log likelihood of every data row at every draw.
        parameters: facts about the parameters, stored as attributes of the variables.
        attrs: attributes of the tree, numbers, strings or JSON-able objects (data hash, seed, versions, ...).

    Raises:
        InputError: draws that are not (chain, draw), differ in shape, or are not finite.
    """
    shapes = {name: np.shape(values) for name, values in posterior.items()}
    if not shapes or len(set(shapes.values())) != 1 or len(next(iter(shapes.values()))) != 2:
        raise InputError(f"draws must all have one shape (chain, draw), got {shapes}", where="posterior")
    for name, values in posterior.items():
        if not np.isfinite(values).all():
            raise InputError(f"draws of {name} are not finite", where="posterior", remedy="report this as an error")

    known = {info.name: info for info in parameters}

    def described(values: Mapping[str, np.ndarray]) -> xr.Dataset:
        dataset = _draws_dataset(values)
        for name in values:
            said = known.get(name, ParameterInfo(name, "")).as_dict()
            said |= {key: json.dumps(said[key]) for key in ("prior", "scope")}
            dataset[variable_key(name)].attrs = {"name": name, **said}
        return dataset

    groups = {
        "posterior": described(posterior),
        "prior": described({name: np.asarray(v)[None] for name, v in prior.items()}) if prior else None,
        "posterior_predictive": posterior_predictive,
        "prior_predictive": prior_predictive,
        "observed_data": observed_data,
        "constant_data": constant_data,
        "sample_stats": sample_stats,
        "log_likelihood": None,
    }
    if log_likelihood is not None:
        groups["log_likelihood"] = xr.Dataset({"row": (("chain", "draw", "row_index"), np.asarray(log_likelihood))})
    stored = {"schema": SCHEMA, **{key: _attribute(value) for key, value in (attrs or {}).items()}}
    present: dict[str, Any] = {name: group for name, group in groups.items() if group is not None}
    tree = xr.DataTree.from_dict(present)
    tree.attrs = stored
    return tree


def in_arviz(tree: xr.DataTree) -> InferenceData:
    """ArviZ's type of a posterior: InferenceData, and from 1.0 on the tree itself."""
    converted: Any = tree
    if not TREES:
        groups: dict[str, Any] = {name: child.to_dataset() for name, child in tree.children.items()}
        converted = arviz.InferenceData(attrs=dict(tree.attrs), **groups)
    return converted


def variable_key(name: str) -> str:
    """Name of a NetCDF variable for a parameter: a slash would open a group."""
    return name.replace("/", "|")


def _draws_dataset(values: Mapping[str, np.ndarray]) -> xr.Dataset:
    chains, draws = np.shape(next(iter(values.values())))
    data = {variable_key(name): (("chain", "draw"), np.asarray(v, dtype=float)) for name, v in values.items()}
    return xr.Dataset(data, coords={"chain": np.arange(chains), "draw": np.arange(draws)})


def _attribute(value: Any) -> str | int | float:
    value = plain(value)
    return value if isinstance(value, str | int | float) and not isinstance(value, bool) else json.dumps(value)


def save_posterior(tree: xr.DataTree, path: Path) -> None:
    """Write NetCDF; an interrupted call leaves the earlier file.

    Raises:
        InputError: if the file cannot be written.
    """
    with whole(path) as partial:
        packed = {f"/{name}": {v: {"zlib": True} for v in child.data_vars} for name, child in tree.children.items()}
        tree.to_netcdf(str(partial), engine="h5netcdf", encoding=packed)


def load_posterior(path: Path) -> xr.DataTree:
    """Read a file of `save_posterior` into memory.

    Raises:
        InputError: if the file is missing, damaged, or not a posterior of ours.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError("no such file", where=str(path), remedy="give the folder of a finished calibration")
    try:
        with xr.open_datatree(str(path), engine="h5netcdf") as opened:
            tree = opened.load()
    except Exception as error:  # the HDF5 stack raises many types on damaged files, none of them ours
        raise InputError(
            f"is not a readable NetCDF file ({type(error).__name__})", where=str(path), remedy="calibrate again"
        ) from None
    if tree.attrs.get("schema") != SCHEMA or "posterior" not in tree.children:
        raise InputError(
            f"is a NetCDF file, but not a posterior of ours (attribute schema = {SCHEMA!r} is missing)",
            where=str(path),
            remedy="give posterior.nc of a calibration",
        )
    return tree


def summarise(posterior: Draws) -> dict[str, dict[str, float]]:
    """ArviZ's summary of each parameter: bulk and tail effective sample size, Monte-Carlo error of the mean, R-hat.

    ``r_hat`` (rank-normalised, split) needs chains and is NaN for a single chain. Constant chains, and chains of fewer
    than four draws, give NaN.
    """
    chains, draws = next(iter(posterior.values())).shape
    if draws < 4:
        nothing = dict.fromkeys(("ess_bulk", "ess_tail", "mcse_mean", "r_hat"), float("nan"))
        return {name: dict(nothing) for name in posterior}
    data = in_arviz(xr.DataTree.from_dict({"posterior": _draws_dataset(posterior)}))
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        bulk, tail = arviz.ess(data, method="bulk"), arviz.ess(data, method="tail")
        error = arviz.mcse(data, method="mean")
        r_hat = arviz.rhat(data) if chains > 1 else None
    return {
        name: {
            "ess_bulk": float(bulk[variable_key(name)]),
            "ess_tail": float(tail[variable_key(name)]),
            "mcse_mean": float(error[variable_key(name)]),
            "r_hat": float(r_hat[variable_key(name)]) if r_hat is not None else float("nan"),
        }
        for name in posterior
    }


def central_interval(draws: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Quantiles of the posterior that leave 5 % on either side.

    The k-th smallest of n draws has k / (n + 1) of the posterior below it, on average (Weibull's plotting position).
    The usual sample quantiles are too narrow: with 100 draws a nominal 90 % interval holds 88 %.
    """
    low, high = np.quantile(draws, [0.5 - 0.45, 0.5 + 0.45], method="weibull")
    return float(low), float(high)
