"""Forces, energies and work of a simulated motion, beside it in its NetCDF file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import jax
import numpy as np
import xarray as xr

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.fem.balance import UNITS, Balance
from rfdropo_bayes.simulators.commands import Commands
from rfdropo_bayes.simulators.robot_simulator import RobotSimulator

GROUP = "balance"
"""Group of the NetCDF file."""


def append_balance(
    simulator: RobotSimulator, values: Mapping[str, float], commands: Commands, time: np.ndarray, path: Path
) -> str:
    """Add the group `GROUP` to a NetCDF file: a variable for every field of `fem.balance.Balance`, with its unit.

    Returns:
        "written", or why these values cannot be had.
    """
    given = {name: np.asarray(value) for name, value in values.items()}
    try:
        found: Balance = jax.jit(simulator.balance)(given, commands)
    except InputError as error:
        return str(error)
    rows = {**found._asdict(), "other_loss": found.other_loss}
    variables = {
        name: (("time", "axis")[: np.ndim(value)], np.asarray(value), {"units": UNITS.get(name, "J")})
        for name, value in rows.items()
    }
    coordinates = {"time": ("time", time, {"units": "s"}), "axis": list("xyz")}
    xr.Dataset(variables, coordinates).to_netcdf(path, mode="a", engine="h5netcdf", group=GROUP)
    return "written"
