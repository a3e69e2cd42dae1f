"""A simulator in another process, in any language: one JSON object a line in each direction."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float


class ProcessSimulation:
    """A process that is started once and simulates one line after the other.

    It reads ``{"parameters": {name: number}, "command": [[...], ...], "time_step": s}`` and answers with
    ``{"position": [[[x, y, z], ...], ...]}``, in metres and one entry per row of the command, perhaps with
    ``"tension": [[...], ...]``. An answer ``{"error": "..."}`` says that these parameters cannot be simulated. What the
    process writes to stderr stays visible.

    Args:
        words: command line.
        time_step: between rows of the command [s].
    """

    def __init__(self, words: Sequence[str], time_step: float) -> None:
        self.words, self.time_step = tuple(words), time_step
        self._process: subprocess.Popen[str] | None = None

    def __call__(self, parameters: Mapping[str, float], command: Float[np.ndarray, "row channel"]) -> dict[str, Any]:
        """Simulate one parameter set.

        Raises:
            ArithmeticError: the process says that it cannot.
            ConnectionError: the process has ended, or does not answer in JSON.
        """
        process = self._running()
        request = {"parameters": dict(parameters), "command": command.tolist(), "time_step": self.time_step}
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            process.stdin.write(json.dumps(request) + "\n")
            process.stdin.flush()
            answer = json.loads(process.stdout.readline())
        except (OSError, ValueError) as error:
            self.close()
            raise ConnectionError(f"{self.words[0]} does not answer in JSON ({error})") from None
        if "error" in answer:
            raise ArithmeticError(answer["error"])
        return {name: np.asarray(answer[name], dtype=float) for name in ("position", "tension") if name in answer}

    def _running(self) -> subprocess.Popen[str]:
        if self._process is None or self._process.poll() is not None:
            self._process = subprocess.Popen(self.words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        return self._process

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None

    def __del__(self) -> None:
        self.close()
