"""Errors with four parts: doing what, with what, found what, do this.

Every failure that a user can meet is a `SimrunError`. Its class sets the process exit code
(docs/cli.md) and the failure class in ``rollouts.parquet``, so the printed text, the table and the
exit code agree.
"""

from __future__ import annotations

import traceback
from collections.abc import Mapping
from typing import ClassVar

from alpasim_plugin.core.escape import shorten, terminal


class SimrunError(Exception):
    """State what was attempted, with which object, what was found, and what the user can do.

    A part is at most `alpasim_plugin.core.escape.MAX_PART` characters long, and nothing in it can
    act on a terminal.

    Args:
        doing: The attempted action, as a verb phrase ("reading a scenario").
        with_what: The object of the action: file with line and column, option, renderer name.
        found: What was found instead, with the offending value.
        do_this: One action that would help.
    """

    exit_code: ClassVar[int] = 2
    failure_class: ClassVar[str] = "input"

    def __init__(self, doing: str, with_what: str, found: str, do_this: str) -> None:
        doing, with_what, found, do_this = (
            shorten(terminal(str(part))) for part in (doing, with_what, found, do_this)
        )
        super().__init__(doing, with_what, found, do_this)
        self.doing, self.with_what, self.found, self.do_this = doing, with_what, found, do_this

    def __str__(self) -> str:
        return four_parts(self.as_dict())

    def as_dict(self) -> dict[str, str]:
        """Return the four parts and the failure class, for ``--json`` and manifests."""
        return {
            "doing": self.doing,
            "with": self.with_what,
            "found": self.found,
            "do": self.do_this,
            "failure_class": self.failure_class,
        }


def four_parts(error: Mapping[str, str]) -> str:
    """Return the text of an error from what `SimrunError.as_dict` gave."""
    return f"error: {error['doing']}\n   with: {error['with']}\n  found: {error['found']}\n     do: {error['do']}"


class InputError(SimrunError):
    """Bad usage, configuration, file or scene content."""


class InfrastructureError(SimrunError):
    """The machine or a service failed: disk full, lost worker, unreachable server."""

    exit_code: ClassVar[int] = 4
    failure_class: ClassVar[str] = "infrastructure"


class RendererError(InfrastructureError):
    """A renderer could not produce a frame."""

    failure_class: ClassVar[str] = "renderer"


class FixerError(InfrastructureError):
    """A fixer returned no usable frame, and the raw frame could not replace it."""

    failure_class: ClassVar[str] = "fixer"


class PolicyError(SimrunError):
    """A policy raised, or broke its contract: a fault of what is under test, not of the machine."""

    failure_class: ClassVar[str] = "policy"

    @property
    def is_final(self) -> bool:
        """Tell whether another try must end in the same way: yes, unless a file, memory or a
        package was missing.
        """
        return not isinstance(self.__cause__, OSError | MemoryError | ImportError)


class EvaluatorError(SimrunError):
    """An evaluator could not compute a required value."""

    exit_code: ClassVar[int] = 5
    failure_class: ClassVar[str] = "evaluator"


class InternalError(SimrunError):
    """The program itself failed: an exception that nothing has foreseen, of ours or of a
    plug-in.
    """

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
        where = f" at {frames[-1].filename}:{frames[-1].lineno}" if frames else ""
        do_this = (
            "run the command with --debug and report the traceback to whoever maintains that file"
        )
        return cls("running a command", command, f"{type(error).__name__}: {error}{where}", do_this)
