"""The error a user's input can raise: it says what is wrong, where, and what to do."""

from __future__ import annotations


class InputError(ValueError):
    """Input that cannot be used.

    Args:
        what: what is wrong, in one clause.
        where: the file, row, column, table or key it was found in.
        remedy: what the user can do about it.

    ``str(error)`` is a single line, so that the command line can print it as it is.
    """

    def __init__(self, what: str, *, where: str = "", remedy: str = "") -> None:
        self.what, self.where, self.remedy = what, where, remedy
        parts = [f"{where}: {what}" if where else what]
        if remedy:
            parts.append(remedy)
        super().__init__("; ".join(" ".join(part.split()) for part in parts))


class NoLikelihoodError(InputError):
    """No parameter set that was tried has a positive likelihood: the prior excludes the data, or more must be tried."""


class Interrupted(KeyboardInterrupt):
    """Ctrl-C in the middle of a run.

    Args:
        folder: where the run writes.
        going_on: what to add to its command to go on with it, may be nothing; None where it has to start again.
    """

    def __init__(self, folder: str, going_on: str | None) -> None:
        self.folder, self.going_on = folder, going_on
        super().__init__(folder)
