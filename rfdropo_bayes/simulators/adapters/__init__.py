"""Other simulators: names for experiment files, and adapters that make a `BlackBox`.

An adapter is a callable that returns a `BlackBox`. A bundled adapter is chosen by the suffix of a model's file; any
other adapter is named, ``package.module:attribute`` or ``file.py:attribute``, and gets the keys of the experiment's
table [adapter]. A new engine needs nothing here: see docs/your_simulator.md.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rfdropo_bayes.errors import InputError
from rfdropo_bayes.simulators.black_box import BlackBox

BY_SUFFIX = {
    ".xml": "rfdropo_bayes.simulators.adapters.mujoco_model:MuJoCo",
    ".urdf": "rfdropo_bayes.simulators.adapters.mujoco_model:MuJoCo",
}
"""Adapters that come with the package, by the suffix of the files that they read."""


def is_adapted(name: str) -> bool:
    """Whether a robot's name in an experiment refers to another simulator: a model's file, or an adapter."""
    return Path(name).suffix in BY_SUFFIX or ":" in name[2:]


def first_tables(path: Path, markers: Mapping[str, Any], channels: Sequence[str]) -> tuple[dict[str, Any], list[str]]:
    """First table [adapter] of an experiment with a model's file, and its assumptions.

    Args:
        path: path of the model.
        markers: names of measured markers, and their first seen positions [m], None if unknown.
        channels: names of the commands.

    Raises:
        InputError: a file that no adapter reads, or an unreadable file.
    """
    module = BY_SUFFIX[path.suffix].partition(":")[0]
    return importlib.import_module(module).first_tables(path, markers, channels)


def adapted(name: str, folder: Path, options: Mapping[str, Any]) -> BlackBox:
    """The simulator that an experiment names.

    Args:
        name: a model's file, ``package.module:attribute`` or ``file.py:attribute``. The attribute is a `BlackBox`, or a
            function that returns it.
        folder: base of relative files.
        options: keys of the table [adapter]: further arguments.

    Raises:
        InputError: no such file or attribute, arguments that the adapter does not take, or no `BlackBox`.
    """
    suffix = Path(name).suffix
    if suffix in BY_SUFFIX:
        beside = folder / name
        path = beside if beside.is_file() else Path(name)
        if not path.is_file():
            raise InputError("no such model", where=str(beside), remedy="correct robot = ... in the experiment")
        return _made(_imported(BY_SUFFIX[suffix], folder), name, {"path": path, **options})
    return _made(_imported(name, folder), name, options)


def _imported(name: str, folder: Path) -> Any:
    """The attribute named by ``module:attribute`` or ``file.py:attribute``."""
    source, _, attribute = name.rpartition(":")
    try:
        if not source.endswith(".py"):
            return getattr(importlib.import_module(source), attribute)
        path = Path(folder).resolve() / source
        own = f"rfdropo_adapter_{hashlib.sha256(str(path).encode()).hexdigest()[:12]}"
        spec = importlib.util.spec_from_file_location(own, path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[own] = module  # as an import does it: dataclasses look their module up while they are made
        spec.loader.exec_module(module)
        return getattr(module, attribute)
    except Exception as error:  # whatever a user's code raises
        raise InputError(
            f"cannot import the simulator {name!r} ({type(error).__name__}: {error})",
            where="robot",
            remedy="give module:attribute of an installed module, or file.py:attribute beside the experiment file",
        ) from None


def _made(adapter: Any, name: str, options: Mapping[str, Any]) -> BlackBox:
    """The simulator that an adapter makes."""
    if isinstance(adapter, BlackBox) and not options:
        return adapter
    if not callable(adapter):
        remedy = "leave [adapter] out" if isinstance(adapter, BlackBox) else "see docs/your_simulator.md"
        raise InputError(f"{name!r} takes no arguments", where="[adapter]", remedy=remedy)
    try:
        box = adapter(**options)
    except TypeError as error:
        raise InputError(f"{name}: {error}", where="[adapter]", remedy="see docs/your_simulator.md") from None
    if not isinstance(box, BlackBox):
        raise InputError(
            f"{name!r} gives {type(box).__name__}, no BlackBox", where="robot", remedy="see docs/your_simulator.md"
        )
    return box
