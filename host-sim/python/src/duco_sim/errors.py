"""What can go wrong."""

from __future__ import annotations


class DucoSimError(Exception):
    """Everything that this package raises by itself."""


class ProcessError(DucoSimError):
    """``host-sim`` did not start, or ended by itself.

    Its text ends with the last lines of the program's log.
    """


class Refused(DucoSimError):
    """The controller refused an operation, and nothing has changed. The text says why, and what is allowed."""

    def __init__(self, operation: str, why: str) -> None:
        super().__init__(f"{operation}: {why}")
        self.operation = operation
        """The operation's name, such as ``"set"``."""
        self.why = why
        """The controller's answer."""


class WaitTimeout(Refused, TimeoutError):
    """What was waited for has not come in time. The text says what is the case instead."""
