"""Stop on SIGINT, SIGTERM and SIGHUP alike: what runs is unwound, the message says what is kept,
the exit code names the signal.
"""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
NOTHING_KEPT = "the same command starts again"


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


@contextmanager
def stoppable() -> Iterator[None]:
    """Raise `Stopped` in the block at the first signal; a second one ends the process at once.

    A signal that the process was started to ignore (``nohup``) stays ignored. Outside the main
    thread, where Python has no handlers, nothing changes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, frame: FrameType | None) -> None:
        for one in before:
            signal.signal(one, _leave)
        raise Stopped(number)

    before = {
        number: signal.getsignal(number)
        for number in SIGNALS
        if signal.getsignal(number) is not signal.SIG_IGN
    }
    try:
        for number in before:
            signal.signal(number, stop)
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def leave_at_once() -> None:
    """Let the signals end the process without a traceback, while nothing is there to be unwound:
    during imports.
    """
    for number in SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _leave)


def _leave(number: int, frame: FrameType | None) -> None:
    os._exit(128 + number)
