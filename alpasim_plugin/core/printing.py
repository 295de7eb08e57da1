"""The one place that prints: names come from files of strangers, and none of them makes a terminal
act or looks like a line of its own.
"""

import sys

from alpasim_plugin.core.escape import terminal


def say(*lines: str) -> None:
    """Print lines on standard output."""
    for line in lines:
        print(terminal(line), flush=True)


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
