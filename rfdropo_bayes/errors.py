"""The error for unusable input: fault, location and remedy."""

from __future__ import annotations


class InputError(ValueError):
    """Input that cannot be used.

    Args:
        what: the fault, in one clause.
        where: file, row, column, table or key of the fault.
        remedy: advice to the user.

    ``str(error)`` is a single line.
    """

    def __init__(self, what: str, *, where: str = "", remedy: str = "") -> None:
        self.what, self.where, self.remedy = what, where, remedy
        parts = [f"{where}: {what}" if where else what]
        if remedy:
            parts.append(remedy)
        super().__init__("; ".join(" ".join(part.split()) for part in parts))


class NoLikelihoodError(InputError):
    """No tried parameter set has a positive likelihood: the prior excludes the data, or more draws are needed."""


class NoRolloutError(InputError):
    """No draw could be simulated under the commands of some recordings."""


class Interrupted(KeyboardInterrupt):
    """Ctrl-C in the middle of a run.

    Args:
        folder: folder of the run.
        going_on: options that continue the run, possibly empty; None if it has to start again.
    """

    def __init__(self, folder: str, going_on: str | None) -> None:
        self.folder, self.going_on = folder, going_on
        super().__init__(folder)
