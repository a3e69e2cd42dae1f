"""Progress of a long inference: a bar for people, one JSON line per stage for programs."""

from __future__ import annotations

import json
import math
import sys
import time
from pathlib import Path
from types import TracebackType
from typing import Any

from tqdm import tqdm


class Progress:
    """Reports stages. Both outputs are optional and neither influences a result.

    Args:
        title: what is running.
        show: draw a bar on stderr; None shows it on a terminal only.
        log: file that gets one JSON object per line and stage, appended.
    """

    def __init__(self, title: str = "", *, show: bool | None = False, log: Path | None = None) -> None:
        self.log = log
        self.title = title
        self._began = time.monotonic()
        disable = not sys.stderr.isatty() if show is None else not show
        self._bar = tqdm(
            total=1.0,
            desc=title,
            disable=disable,
            file=sys.stderr,
            bar_format="{desc} {percentage:3.0f}%|{bar}| {elapsed}{postfix}",
        )

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.close()

    def stage(self, share: float, **facts: Any) -> None:
        """Report the end of a stage.

        Args:
            share: part of the work that is done, 0 to 1.
            facts: numbers of the stage.
        """
        self._bar.n = min(max(share, self._bar.n), 1.0)
        shown = {k: v for k, v in facts.items() if k in ("horizon", "ess", "acceptance", "loss", "rollouts")}
        self._bar.set_postfix({k: f"{v:.3g}" for k, v in shown.items() if v is not None})
        if self.log is not None:
            self.log.parent.mkdir(parents=True, exist_ok=True)
            line = {"time": time.time(), "elapsed": time.monotonic() - self._began, "run": self.title, **facts}
            with self.log.open("a") as file:
                file.write(json.dumps({k: _plain(v) for k, v in line.items()}) + "\n")


def _plain(value: Any) -> Any:
    """Numbers that JSON has not become null."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
