"""Stop on SIGINT, SIGTERM and SIGHUP alike: what runs is unwound, the message says what is kept,
the exit code names the signal.
"""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from alpasim_plugin.core.errors import Stopped

SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)


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
        for handled in before:
            signal.signal(handled, _leave)
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
