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
        begin, end: shares of the whole work that are done before this part of it and after.
    """

    folder: Path | None = None
    resume: bool = False
    progress: Progress | None = None
    begin: float = 0.0
    end: float = 1.0

    def checkpoint(self, name: str, digest: str) -> Checkpoint:
        """Checkpoint of a part of the run, see `open_checkpoint`."""
        return open_checkpoint(self.folder, name, digest, resume=self.resume)

    def part(self, begin: float, end: float, folder: str | None = None) -> Logbook:
        """Of a part of the work, from one share of it to another, in a folder of its own where one is named."""
        own = self.folder if self.folder is None or folder is None else self.folder / folder
        width = self.end - self.begin
        return Logbook(own, self.resume, self.progress, self.begin + begin * width, self.begin + end * width)

    def stage(self, share: float, **facts: Any) -> None:
        """Report the end of a stage, see `Progress.stage`."""
        if self.progress is not None:
            self.progress.stage(self.begin + share * (self.end - self.begin), **facts)


UNRECORDED = Logbook()
