"""Checkpoints: a killed run goes on from its last whole stage and ends with the same draws."""

from __future__ import annotations

import hashlib
import json
import os
import zipfile
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from rfdropo_bayes.bayes.problem import Problem
from rfdropo_bayes.errors import InputError
from rfdropo_bayes.files import whole

SCHEMA_VERSION = 5
_META = "meta_json"


def run_digest(problem: Problem, method: str, config: Any, key: PRNGKeyArray) -> str:
    """Digest of everything that a run's draws depend on: problem, method, its configuration and the random key.

    The problem is known by its names, units, bounds, rows, its prior's density at a few of its own draws, and its
    ``fingerprint`` where it has one.
    """
    probe = problem.to_unconstrained(problem.sample_prior(jax.random.key(0), 3))
    parts = {
        "schema": SCHEMA_VERSION,
        "method": method,
        "config": repr(config),
        "key": np.asarray(jax.random.key_data(key)).tolist(),
        "names": list(problem.names),
        "units": dict(problem.units),
        "bounds": {name: [float(x) for x in problem.bounds[name]] for name in problem.names},
        "n_rows": int(problem.n_rows),
        "prior": [float(x).hex() for x in np.asarray(problem.log_prior(probe)).ravel()],
        "fingerprint": getattr(problem, "fingerprint", ""),
    }
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


class Checkpoint:
    """One file that is replaced whole after every stage: arrays, and everything else as JSON beside them.

    Args:
        path: the file; ``None`` keeps nothing.
        digest: `run_digest` of the run; a file of another run is refused.
    """

    def __init__(self, path: Path | None, digest: str) -> None:
        self.path, self.digest = path, digest

    def save(self, arrays: dict[str, np.ndarray], meta: dict[str, Any]) -> None:
        """Write atomically: a kill leaves the previous file or this one, never half of one."""
        if self.path is None:
            return
        text = json.dumps({"digest": self.digest, "schema_version": SCHEMA_VERSION, **meta})
        entries: dict[str, Any] = {_META: np.frombuffer(text.encode(), dtype=np.uint8), **arrays}
        with whole(self.path) as partial:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with partial.open("wb") as file:
                np.savez(file, allow_pickle=False, **entries)
                file.flush()
                os.fsync(file.fileno())

    def load(self) -> tuple[dict[str, np.ndarray], dict[str, Any]] | None:
        """Arrays and the rest of the last whole stage, or None where there is no checkpoint yet.

        Raises:
            InputError: the file is damaged, or belongs to another run.
        """
        if self.path is None or not self.path.exists():
            return None
        try:
            with self.path.open("rb") as handle, np.load(handle, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files if name != _META}
                meta = json.loads(file[_META].tobytes())
            digest = meta["digest"]
        except (OSError, ValueError, KeyError, EOFError, TypeError, zipfile.BadZipFile) as error:
            raise InputError(
                "the checkpoint is damaged", where=str(self.path), remedy="delete it and start without --resume"
            ) from error
        if digest != self.digest:
            raise InputError(
                "the checkpoint belongs to a run with other data, priors, settings or seed",
                where=str(self.path),
                remedy="resume with the experiment it was made by, or start without --resume",
            )
        return arrays, meta


def open_checkpoint(folder: Path | None, name: str, digest: str, *, resume: bool) -> Checkpoint:
    """Checkpoint ``folder/name.npz`` of a run; unless resumed, one left by an earlier run is removed."""
    if folder is None:
        return Checkpoint(None, digest)
    path = Path(folder) / f"{name}.npz"
    if not resume:
        path.unlink(missing_ok=True)
    return Checkpoint(path, digest)


UNSAVED = Checkpoint(None, "")
