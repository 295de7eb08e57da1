"""Write a text file whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path

from alpasim_plugin.errors import InfrastructureError


def write_whole(path: Path, text: str) -> None:
    """Write a file beside its place and rename it, so that a reader never meets half of it.

    Raises:
        InfrastructureError: The disk refused; what stood at ``path`` before is untouched.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_text(text, encoding="utf-8")
        temporary.replace(path)
    except OSError as error:
        raise InfrastructureError(
            "writing a report",
            str(path),
            error.strerror or str(error),
            "free disk space or make the folder writable, then run simrun report",
        ) from error
    finally:
        temporary.unlink(missing_ok=True)
