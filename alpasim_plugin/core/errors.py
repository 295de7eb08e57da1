"""Errors in two sentences: what is wrong with which value, and what to do.

Every failure that a user can meet is a `SimrunError`. Its class sets the process exit code
(docs/cli.md) and the failure class in ``rollouts.parquet``, so the printed text, the table and the
exit code agree.
"""

from __future__ import annotations

import signal
import traceback
from collections.abc import Mapping
from typing import ClassVar

from alpasim_plugin.core.escape import shorten, terminal

NOTHING_KEPT = "the same command starts again"


class SimrunError(Exception):
    """State what is wrong, and what the user can do.

    Neither sentence is longer than `alpasim_plugin.core.escape.MAX_PART` characters, and nothing in
    them can act on a terminal.

    Args:
        message: What is wrong with which value, as one sentence without its full stop.
        hint: What to do, as one sentence without its full stop.
    """

    exit_code: ClassVar[int] = 2
    failure_class: ClassVar[str] = "input"

    def __init__(self, message: str, hint: str) -> None:
        self.message = shorten(terminal(message))
        self.hint = shorten(terminal(hint))
        super().__init__(self.message, self.hint)

    def __str__(self) -> str:
        return "\n".join(error_lines(self.as_dict()))

    def as_dict(self) -> dict[str, str]:
        """Return message, hint and failure class, for ``--json`` and manifests."""
        return {
            "message": self.message,
            "hint": self.hint,
            "failure_class": self.failure_class,
        }


def error_lines(error: Mapping[str, str]) -> list[str]:
    """Return the two lines of an error from what `SimrunError.as_dict` gave."""
    return [f"error: {error['message']}", f"  hint: {error['hint']}"]


class InputError(SimrunError):
    """Bad usage, configuration, file or scene content."""


class InfrastructureError(SimrunError):
    """The machine or a service failed: disk full, lost worker, unreachable server."""

    exit_code: ClassVar[int] = 4
    failure_class: ClassVar[str] = "infrastructure"


class RendererError(InfrastructureError):
    """A renderer could not produce a frame."""

    failure_class: ClassVar[str] = "renderer"


FAULTS_OF_CODE = (
    AssertionError,
    AttributeError,
    NameError,
    NotImplementedError,
    TypeError,
    UnboundLocalError,
    ZeroDivisionError,
)


class FaultOfPart(SimrunError):
    """A part of the user's own raised, or broke its contract."""

    @property
    def is_final(self) -> bool:
        """Tell whether another try with the same code and files must end in the same way: what the
        part returned broke its contract, or it raised what only wrong code raises.

        Anything else that it raised may come from the world outside: a file that was corrected
        since, a full card, a peer that is lost, a deadline. Libraries derive their errors from
        Python's, so that the class itself counts and no base of it.
        """
        return self.__cause__ is None or type(self.__cause__) in FAULTS_OF_CODE


class RendererFault(FaultOfPart, RendererError):
    """A renderer of the user's own raised, or broke its contract."""

    exit_code: ClassVar[int] = 2
    failure_class: ClassVar[str] = "renderer fault"


class FixerError(InfrastructureError):
    """A fixer returned no usable frame, and the raw frame could not replace it."""

    failure_class: ClassVar[str] = "fixer"


class FixerFault(FaultOfPart, FixerError):
    """A fixer of the user's own raised, or broke its contract."""

    exit_code: ClassVar[int] = 2
    failure_class: ClassVar[str] = "fixer fault"


class PolicyError(FaultOfPart):
    """A policy raised, or broke its contract: a fault of what is under test, not of the machine."""

    failure_class: ClassVar[str] = "policy"


class EvaluatorError(SimrunError):
    """An evaluator could not compute a required value."""

    exit_code: ClassVar[int] = 5
    failure_class: ClassVar[str] = "evaluator"


class InternalError(SimrunError):
    """The program itself failed: an exception that nothing has foreseen."""

    exit_code: ClassVar[int] = 70
    failure_class: ClassVar[str] = "internal"

    @classmethod
    def of(cls, error: BaseException, command: str) -> InternalError:
        """Return the error for an exception, which says where it was raised.

        Args:
            error: What was raised.
            command: The command that ran.
        """
        frames = traceback.extract_tb(error.__traceback__)
        location = f" at {frames[-1].filename}:{frames[-1].lineno}" if frames else ""
        do_this = (
            "run the command with --debug and report the traceback to whoever maintains that file"
        )
        return cls(f"{command}: {type(error).__name__}: {error}{location}", do_this)


class Stopped(BaseException):
    """A signal asks the process to stop. No library takes it for an error of its own, since it is
    no ``Exception``.

    Attributes:
        kept: What is kept and how to go on; whoever knows sets it on the way up.
    """

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number
        self.kept = ""

    @property
    def exit_code(self) -> int:
        """Give the exit code of a process that a signal ended, as shells count it: 130, 143 or
        129.
        """
        return 128 + self.number

    def __str__(self) -> str:
        return f"stopped by {signal.Signals(self.number).name}; {self.kept or NOTHING_KEPT}"

    def as_dict(self) -> dict[str, str]:
        """Return message, hint and class of an error, for ``--json``."""
        return {
            "message": f"stopped by {signal.Signals(self.number).name}",
            "hint": self.kept or NOTHING_KEPT,
            "failure_class": "stopped",
        }


def is_interruption(error: BaseException) -> bool:
    """Tell whether a signal that this process received has raised an error: the command line
    raises `Stopped`, and Python's own handler ``KeyboardInterrupt``.
    """
    if isinstance(error, KeyboardInterrupt):
        return signal.getsignal(signal.SIGINT) is signal.default_int_handler
    return isinstance(error, Stopped)
