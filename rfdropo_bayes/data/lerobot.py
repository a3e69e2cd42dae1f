"""LeRobotDatasets of versions 2 and 3, folders of JSON and Parquet files: read with pyarrow, not the package lerobot.

Each episode is a recording. A column is called ``feature.name``, such as ``observation.state.tip_x``;
``feature[number]`` if the dataset has no names, such as ``action[0]``; and ``feature`` if the feature is a single
number, such as ``timestamp``. Pictures, videos and texts are skipped.

Timing. The action of a frame is commanded after its observation, and in force until the next frame.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from rfdropo_bayes.errors import InputError

FORMAT = "lerobot"
INFO = Path("meta") / "info.json"
TIME = "timestamp"
INDICES = ("episode_index", "frame_index")
NUMBERS = ("float", "int", "uint", "bool")
VERSIONS = ("v2.", "v3.")
ROUNDING = 1e-6  # relative error of times in single precision


class _Episode(NamedTuple):
    """Location of an episode: its number, frames and file."""

    number: int
    length: int
    file: Path


def episode_numbers(folder: Path) -> list[int]:
    """The numbers of a dataset's episodes, in its order.

    Raises:
        InputError: see `read_episode`.
    """
    return [episode.number for episode in _episodes(folder, _info(folder))]


def read_episode(folder: Path, number: int) -> pd.DataFrame:
    """The numbers of an episode, one row per frame.

    Raises:
        InputError: pyarrow is not installed, a dataset of another version, no such episode, or a file that is missing,
            damaged or cut short.
    """
    info = _info(folder)
    episode = next((each for each in _episodes(folder, info) if each.number == number), None)
    if episode is None:
        raise InputError(
            f"has no episode {number}", where=str(folder), remedy="see meta/episodes for the existing numbers"
        )
    features = {name: fact for name, fact in info["features"].items() if str(fact["dtype"]).startswith(NUMBERS)}
    rows = _parquet(episode.file, list(dict.fromkeys([*features, *INDICES])), [("episode_index", "==", number)])
    if len(rows["episode_index"]) != episode.length:
        raise InputError(
            f"episode {number} has {len(rows['episode_index'])} frames, but its description has {episode.length}",
            where=str(episode.file),
            remedy="fetch the dataset again",
        )
    columns: dict[str, np.ndarray] = {}
    for name, fact in features.items():
        try:
            values = np.array(rows[name], dtype=float).reshape(episode.length, -1)
        except ValueError:
            remedy = "convert the dataset again"
            raise InputError(f"{name} is not of one size", where=str(episode.file), remedy=remedy) from None
        columns |= dict(zip(_names(name, fact, values.shape[1]), values.T, strict=True))
    table = pd.DataFrame(columns)
    if TIME in table:
        table[TIME] = _unrounded(table[TIME].to_numpy(), np.array(rows["frame_index"]) / float(info["fps"]))
    return table


def _unrounded(time: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Times in double precision if they equal a grid in single precision."""
    return grid if np.allclose(time, grid, rtol=ROUNDING, atol=ROUNDING) else time


def _names(feature: str, fact: dict[str, Any], count: int) -> list[str]:
    """Names of the numbers of a feature."""
    if count == 1 and math.prod(fact.get("shape") or [1]) == 1:
        return [feature]
    given = fact.get("names") or []
    names = [name for group in given.values() for name in group] if isinstance(given, dict) else list(given)
    if len(names) == count and len({str(name) for name in names}) == count:
        return [f"{feature}.{name}" for name in names]
    return [f"{feature}[{index}]" for index in range(count)]


def _info(folder: Path) -> dict[str, Any]:
    path = folder / INFO
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
        version, _, _, _ = str(info["codebase_version"]), info["features"], info["fps"], info["data_path"]
    except OSError:
        remedy = "give the folder of a LeRobotDataset, which holds meta and data"
        raise InputError(f"has no {INFO}", where=str(folder), remedy=remedy) from None
    except (ValueError, KeyError, TypeError):
        raise InputError("does not describe a LeRobotDataset", where=str(path), remedy="fetch it again") from None
    if not version.startswith(VERSIONS):
        raise InputError(
            f"is a LeRobotDataset of version {version!r}",
            where=str(folder),
            remedy="convert it to version 2.1 or 3.0 with lerobot's own converter",
        )
    return dict(info)


def _episodes(folder: Path, info: dict[str, Any]) -> list[_Episode]:
    """The episodes of a dataset: version 2 lists them in JSON and has a file for each, version 3 in Parquet."""
    if str(info["codebase_version"]).startswith("v2."):
        listing = folder / "meta" / "episodes.jsonl"
        try:
            lines = listing.read_text(encoding="utf-8").splitlines()
            facts = [json.loads(line) for line in lines if line.strip()]
            chunk = int(info["chunks_size"])
            return [
                _Episode(number := int(fact["episode_index"]), int(fact["length"]), folder / _path(info, number, chunk))
                for fact in facts
            ]
        except (OSError, ValueError, KeyError, TypeError) as error:
            remedy = "fetch the dataset again"
            raise InputError(f"lists no episodes ({error!r})", where=str(listing), remedy=remedy) from None
    keys = ["episode_index", "length", "data/chunk_index", "data/file_index"]
    episodes: list[_Episode] = []
    for file in sorted((folder / "meta" / "episodes").glob("*/*.parquet")):
        rows = _parquet(file, keys)
        for number, length, chunk, index in zip(*(rows[key] for key in keys), strict=True):
            path = info["data_path"].format(chunk_index=chunk, file_index=index)
            episodes.append(_Episode(int(number), int(length), folder / path))
    if not episodes:
        raise InputError("lists no episodes in meta/episodes", where=str(folder), remedy="fetch the dataset again")
    return episodes


def _path(info: dict[str, Any], number: int, chunk: int) -> str:
    return str(info["data_path"].format(episode_chunk=number // chunk, episode_index=number))


def _parquet(
    path: Path, columns: Sequence[str], filters: list[tuple[str, str, int]] | None = None
) -> dict[str, list[Any]]:
    """Columns of a Parquet file, restricted to the rows that filters keep."""
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        remedy = 'install it: pip install "rfdropo_bayes[formats]"'
        raise InputError(
            "LeRobotDatasets need pyarrow, which is not installed", where=str(path), remedy=remedy
        ) from None
    try:
        table = parquet.read_table(path, columns=list(columns), filters=filters)
        return {name: table.column(name).to_pylist() for name in columns}
    except FileNotFoundError:
        raise InputError("no such file", where=str(path), remedy="fetch the dataset again") from None
    except KeyError as error:
        raise InputError(f"lacks the column {error.args[0]}", where=str(path), remedy="fetch it again") from None
    except (OSError, pyarrow.ArrowException) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(
            f"is not a readable Parquet file ({reason})", where=str(path), remedy="fetch it again"
        ) from None
