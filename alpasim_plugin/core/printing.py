"""The one place that prints: names come from files of strangers, and none of them makes a terminal
act or looks like a line of its own.
"""

import contextlib
import json
import os
import sys
from collections.abc import Mapping, Sequence
from typing import Any, TextIO

from alpasim_plugin.core.escape import terminal

_kept: list[TextIO] = []  # standard output, where it is kept for the document of ``--json``


def say(*lines: str) -> None:
    """Print lines on standard output."""
    for line in lines:
        print(terminal(line), flush=True)


def say_document(facts: Mapping[str, Any] | Sequence[Any]) -> None:
    """Print the one JSON document of ``--json``."""
    stream = _kept[-1] if _kept else sys.stdout
    text = json.dumps(facts).replace("\x7f", "\\u007f")  # JSON lets this control character pass
    print(text, file=stream, flush=True)


def keep_stdout_for_document() -> None:
    """Keep standard output for `say_document`, until this process ends.

    Whatever else is written to it goes to standard error: by parts, by the processes that they
    start, and by libraries that know nothing of ``sys.stdout``. Nothing changes where standard
    output is closed, or where a program that calls `main` has put a stream of its own in its place.
    """
    with contextlib.suppress(OSError, AttributeError, ValueError):
        if sys.stdout.fileno() != 1:
            return
        document = os.dup(1)
        try:
            os.dup2(2, 1)
        except OSError:  # standard error is closed
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        _kept.append(os.fdopen(document, "w", encoding="utf-8"))


def drop_unwritten() -> None:
    """Drop what was printed and cannot be written, so that Python does not fail on it at its
    end.
    """
    for stream in (sys.stdout, *_kept):
        try:
            stream.flush()
        except (OSError, ValueError, AttributeError):
            with contextlib.suppress(OSError, ValueError, AttributeError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def warn(*lines: str) -> None:
    """Print lines on standard error."""
    for line in lines:
        print(terminal(line), file=sys.stderr, flush=True)


def print_any_character() -> None:
    r"""Let both streams print any character: one that their encoding lacks becomes an escape such as
    ``\u2212``.
    """
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
