"""Standard output belongs to the command: what parts print goes to standard error, so that ``--json`` stays one document."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def parts_print_to_stderr() -> Iterator[None]:
    """Send what is printed during the block to standard error."""
    with contextlib.redirect_stdout(sys.stderr):
        yield
