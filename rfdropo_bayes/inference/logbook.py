"""Where a run keeps its checkpoints and reports its stages."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rfdropo_bayes.inference.checkpoints import Checkpoint, open_checkpoint
from rfdropo_bayes.inference.progress import Progress


@dataclass(frozen=True)
class Logbook:
    """Checkpoints and progress of a run; the empty one keeps and shows nothing.

    Attributes:
        folder: for checkpoints; None keeps none.
        resume: go on from the checkpoints found there.
        progress: where stages are reported.
    """

    folder: Path | None = None
    resume: bool = False
    progress: Progress | None = None

    def checkpoint(self, name: str, digest: str) -> Checkpoint:
        """Checkpoint of a part of the run, see `open_checkpoint`."""
        return open_checkpoint(self.folder, name, digest, resume=self.resume)

    def stage(self, share: float, **facts: Any) -> None:
        """Report the end of a stage, see `Progress.stage`."""
        if self.progress is not None:
            self.progress.stage(share, **facts)


UNRECORDED = Logbook()
