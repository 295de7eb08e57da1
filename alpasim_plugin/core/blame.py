"""The line of the user's code at which an error was raised."""

from __future__ import annotations

import os
import sysconfig
import traceback

from alpasim_plugin import OWN_PACKAGES
from alpasim_plugin.core.places import PACKAGE

LIBRARIES = ("site-packages", "dist-packages", sysconfig.get_paths()["stdlib"], "<frozen ")
OWN_CODE = tuple(f"{PACKAGE.parent / package}{os.sep}" for package in OWN_PACKAGES)


def raised(error: BaseException) -> str:
    """Name an error and the last line of the user's code in its traceback: neither simrun's, nor
    that of a library which the user's code called.

    Where all code is simrun's or a library's, it is the line that simrun called, or simrun's last.
    """
    frames = traceback.extract_tb(error.__traceback__)
    outside = [frame for frame in frames if not frame.filename.startswith(OWN_CODE)]
    users = [frame for frame in outside if not any(part in frame.filename for part in LIBRARIES)]
    chosen = [*frames[-1:], *outside[:1], *users[-1:]]
    where = ""
    if chosen:
        where = f" at {chosen[-1].filename}:{chosen[-1].lineno}, in {chosen[-1].name}"
    return f"{type(error).__name__}: {error}{where}"
