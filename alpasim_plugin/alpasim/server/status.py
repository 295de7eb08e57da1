"""Errors as gRPC statuses that AlpaSim's runtime treats rightly, and the time a call has left.

The runtime retries a render on UNAVAILABLE, and on a text with "Stopped waiting for backend";
anything else fails the rollout. So what may pass (an upstream that is away, busy, or sent a broken
image) is UNAVAILABLE, and what would fail again is not.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any

import grpc

from alpasim_plugin.core.errors import InfrastructureError, InputError, SimrunError
from alpasim_plugin.log.wire.services import is_lost_connection

Code = grpc.StatusCode
BACKEND = "Stopped waiting for backend"
#: Statuses of an upstream that a second attempt may not meet again, beside those of a lost
#: connection.
PASSING = (Code.RESOURCE_EXHAUSTED, Code.ABORTED, Code.DEADLINE_EXCEEDED)
log = logging.getLogger("simrun.serve")
POLL_S = 0.1


class UnknownScene(InputError):
    """A scene id that the server does not know."""


class Full(InfrastructureError):
    """There is as much of something as there may be."""


class UpstreamFault(InfrastructureError):
    """The upstream sent something unusable; another attempt may go well."""


class Unimplemented(InputError):
    """A call that only an upstream can answer."""


class Late(Exception):
    """The caller is gone, or its time is over."""


STATUSES: tuple[tuple[type[SimrunError], Any], ...] = (
    (UnknownScene, Code.NOT_FOUND),
    (Unimplemented, Code.UNIMPLEMENTED),
    (Full, Code.RESOURCE_EXHAUSTED),
    (UpstreamFault, Code.UNAVAILABLE),
    (InputError, Code.INVALID_ARGUMENT),
)


class CallTime:
    """How long a call may still take.

    Args:
        context: The server's context of the call; None: for ever.
    """

    def __init__(self, context: Any = None) -> None:
        self._context = context
        left = context.time_remaining() if context is not None else None
        self._end_s: float | None = None if left is None or left > 1e6 else time.monotonic() + left

    def left_s(self) -> float | None:
        """Return the seconds left; None: no limit.

        Raises:
            Late: None are left, or the caller is gone.
        """
        if self._context is not None and not self._context.is_active():
            raise Late("the caller is gone")
        if self._end_s is None:
            return None
        left: float = self._end_s - time.monotonic()
        if left <= 0:
            raise Late("the deadline has passed")
        return left

    @contextmanager
    def holding(
        self,
        lock: threading.Lock | threading.Semaphore,
        make_room: Callable[[], None] = lambda: None,
    ) -> Iterator[None]:
        """Hold a lock, or a place of a semaphore; waiting ends with the call's time.

        Args:
            lock: The lock.
            make_room: Called again and again while there is no place.
        """
        while True:
            left = self.left_s()
            if lock.acquire(timeout=POLL_S if left is None else min(left, POLL_S)):
                break
            make_room()
        try:
            yield
        finally:
            lock.release()


def status_of(error: BaseException) -> tuple[Any, str]:
    """Return the status and text that a caller gets for an error."""
    if isinstance(error, grpc.RpcError):
        code = error.code()
        text = error.details() or ""
        if BACKEND in text:
            return code, text
        return (
            Code.UNAVAILABLE if code in PASSING or is_lost_connection(error) else code
        ), f"upstream: {code.name}: {text}"
    if isinstance(error, Late):
        return Code.CANCELLED, str(error)
    if isinstance(error, SimrunError):
        code = next((code for kind, code in STATUSES if isinstance(error, kind)), Code.INTERNAL)
        return code, f"{error.message}; {error.hint}"
    return Code.INTERNAL, f"{type(error).__name__}: {error}"


def answering(call: Callable[[Any, Any, Any], Any]) -> Callable[[Any, Any, Any], Any]:
    """Make a service's method answer errors as statuses; every one is handed to the service's
    ``failed``.
    """

    @wraps(call)
    def answer(self: Any, request: Any, context: Any) -> Any:
        try:
            return call(self, request, context)
        except BaseException as error:  # an exit of a served policy ends no thread of the server
            code, text = status_of(error)
            self.failed(call.__name__, code, text, error)
            context.abort(code, text)

    return answer


class Failures:
    """Counts and logs the calls that failed."""

    def __init__(self) -> None:
        self.statuses: Counter[str] = Counter()

    def failed(self, call: str, code: Any, text: str, error: BaseException) -> None:
        """Note a failed call; an unforeseen error is logged with its traceback."""
        self.statuses[code.name] += 1
        foreseen = code is not Code.INTERNAL
        log.warning("%s: %s: %s", call, code.name, text, exc_info=None if foreseen else error)
