"""Errors of parts: the part that they are blamed on, and the line of the user's code."""

import os
import re
import sysconfig
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from alpasim_plugin import OWN_PACKAGES
from alpasim_plugin.core.errors import SimrunError
from alpasim_plugin.core.files.places import PACKAGE, damaged_kernels

PYTHON = ("<frozen ", sysconfig.get_paths()["stdlib"] + os.sep)
LIBRARIES = ("site-packages", "dist-packages")
OWN_CODE = tuple(f"{PACKAGE.parent / package}{os.sep}" for package in OWN_PACKAGES)


TRACEBACK = "Correct that line; --debug, and output.log of a rollout, have the traceback."


@contextmanager
def blaming(kind: type[SimrunError], name: str, called: str = "") -> Iterator[None]:
    """Blame a part for whatever it raises in the block, a `SimrunError` and damaged kernels
    excepted. See `raised` for ``called``.
    """
    try:
        yield
    except SimrunError:
        raise
    except Exception as error:
        own = kind(f"{name}: {raised(error, called)}", TRACEBACK)
        raise (damaged_kernels(error) or own) from error


def raised(error: BaseException, called: str = "") -> str:
    """Name an error and the last line of the user's code in its traceback: neither simrun's, nor
    that of a library which the user's code called.

    Where all code is simrun's or a library's, it is the line that simrun called, or ``called``, as
    `defined` gives it: a call that does not fit the user's method never enters it. Without that it
    is simrun's last.
    """
    frames = traceback.extract_tb(error.__traceback__)
    outside = [frame for frame in frames if not frame.filename.startswith((*OWN_CODE, *PYTHON))]
    users = [frame for frame in outside if not any(part in frame.filename for part in LIBRARIES)]
    chosen = [*outside[:1], *users[-1:]]
    if not chosen and not called and not isinstance(error, SyntaxError):
        chosen = frames[-1:]
    where = called
    if chosen:
        where = f" at {chosen[-1].filename}:{chosen[-1].lineno}, in {chosen[-1].name}"
    text = re.sub(r"simrun_file_\w{12}", "the file", str(error))  # as a file is imported
    return f"{type(error).__name__}: {text}{where}"


def is_own(part: Any) -> bool:
    """Tell whether a part is one of simrun's."""
    return type(part).__module__.partition(".")[0] in OWN_PACKAGES


def defined(part: Any, method: str) -> str:
    """Name the line at which a method of a user's part is defined: `` (mine.py:12)``; nothing for a
    part of simrun's.
    """
    code = getattr(getattr(type(part), method, None), "__code__", None)
    if is_own(part) or code is None:
        return ""
    return f" ({code.co_filename}:{code.co_firstlineno})"
