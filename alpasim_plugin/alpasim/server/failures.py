"""Count and log the calls that a service refuses or fails."""

from __future__ import annotations

import logging
from collections import Counter
from typing import Any

import grpc

log = logging.getLogger("simrun.serve")


class Failures:
    """Counts and logs the calls that failed."""

    def __init__(self) -> None:
        self.statuses: Counter[str] = Counter()

    def failed(self, call: str, code: Any, text: str, error: Exception) -> None:
        """Note a failed call; an unforeseen error is logged with its traceback."""
        self.statuses[code.name] += 1
        foreseen = code is not grpc.StatusCode.INTERNAL
        log.warning("%s: %s: %s", call, code.name, text, exc_info=None if foreseen else error)
