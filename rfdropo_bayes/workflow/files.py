"""Folders that runs write to."""

from __future__ import annotations

import os
from pathlib import Path

from rfdropo_bayes.errors import InputError


def output_folder(path: Path) -> Path:
    """Make the folder, or say why it cannot be written to."""
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"cannot make the output folder: {error.strerror}", where=str(path), remedy="choose another with --out"
        ) from None
    if not os.access(path, os.W_OK | os.X_OK):
        raise InputError("the output folder is not writable", where=str(path), remedy="choose another with --out")
    return path
