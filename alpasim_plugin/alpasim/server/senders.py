"""Calls that hold a place for their message and have not sent it yet."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

SENDING_S = 30.0  # a caller that has not sent its message after so long is cancelled
CROWDED_S = 0.5  # the same where others wait for their places


class Senders:
    """Calls whose message has not come, by the context of the call, and who waits for their places."""

    def __init__(self) -> None:
        self._since_s: dict[Any, float] = {}
        self._leaving: set[Any] = set()  # cancelled calls that still hold their places
        self._waiting = 0
        self._lock = threading.Lock()

    def enter(self, context: Any) -> None:
        """Enter a call that has a place now."""
        with self._lock:
            self._since_s[context] = time.monotonic()

    def received(self, context: Any) -> None:
        """Take note that the message of a call has come, or will not come."""
        with self._lock:
            self._since_s.pop(context, None)

    def left(self, context: Any) -> None:
        """Take note that a call has given its place back."""
        with self._lock:
            self._leaving.discard(context)

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Wait for a place during the block."""
        with self._lock:
            self._waiting += 1
        try:
            yield
        finally:
            with self._lock:
                self._waiting -= 1

    def cancel_slow(self, limit_s: float) -> None:
        """Cancel the calls that have not sent their message within a time."""
        latest_s = time.monotonic() - limit_s
        with self._lock:
            slow = [context for context, since_s in self._since_s.items() if since_s < latest_s]
        for context in slow:
            context.cancel()

    def make_room(self) -> None:
        """Cancel a slow sender earlier, because a call waits for its place: on the connection that
        has the most places, the call that came first. No more are cancelled than calls wait, however
        long the cancelled ones take to give their places back.
        """
        latest_s = time.monotonic() - CROWDED_S
        with self._lock:
            if len(self._leaving) >= self._waiting:
                return
            places = Counter(context.peer() for context in self._since_s)
            slow = [sender for sender in self._since_s.items() if sender[1] < latest_s]
            if not slow:
                return
            context, _ = min(slow, key=lambda sender: (-places[sender[0].peer()], sender[1]))
            del self._since_s[context]
            self._leaving.add(context)
        context.cancel()
