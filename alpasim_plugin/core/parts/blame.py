"""Errors of parts: the part that they are blamed on, and the line of the user's code.

Whatever a part of the user's raises is that part's fault, an exit and an interrupt included: only a
signal that simrun itself received is an interruption. What ends the whole process raises nothing.
So a worker notes which part it calls in a file that outlives it (`Note`).
"""

import mmap
import os
import re
import struct
import sysconfig
import threading
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from inspect import isfunction
from pathlib import Path
from typing import Any

from alpasim_plugin import OWN_PACKAGES
from alpasim_plugin.core.errors import (
    EvaluatorError,
    FaultOfPart,
    FixerFault,
    InfrastructureError,
    InputError,
    PolicyError,
    RendererFault,
    SimrunError,
    is_interruption,
)
from alpasim_plugin.core.files.places import PACKAGE, damaged_kernels

PYTHON = ("<frozen ", sysconfig.get_paths()["stdlib"] + os.sep)
LIBRARIES = ("site-packages", "dist-packages")
OWN_CODE = tuple(f"{PACKAGE.parent / package}{os.sep}" for package in OWN_PACKAGES)
TRACEBACK = "Correct that line; --debug, and output.log of a rollout, have the traceback."
FAULTS = {
    kind.__name__: kind
    for kind in (PolicyError, RendererFault, FixerFault, EvaluatorError, InputError)
}


@contextmanager
def blaming(
    kind: type[SimrunError], name: str, called: str = "", is_users: bool = False
) -> Iterator[None]:
    """Blame a part for whatever it raises in the block, damaged kernels excepted.

    Args:
        kind: Error of the part.
        name: The part, and what it does.
        called: See `raised`.
        is_users: The part is the user's own: errors of simrun that its code raises are its fault
            too, and what ends the process in the block is noted as its doing.
    """
    try:
        with noted(kind, name, called, is_users):
            yield
    except BaseException as error:
        if is_interruption(error) or (isinstance(error, SimrunError) and not is_users):
            raise
        if isinstance(error, SimrunError) and _is_known(error, kind):
            raise
        fault = kind(f"{name}: {raised(error, called)}", TRACEBACK)
        raise (damaged_kernels(error) or fault) from error


def _is_known(error: SimrunError, kind: type[SimrunError]) -> bool:
    """Tell whether an error of simrun says already whose fault it is: that of another part, of this
    one, or of a service that our own client has lost.
    """
    if isinstance(error, FaultOfPart | kind):
        return True
    frames = traceback.extract_tb(error.__traceback__)
    return isinstance(error, InfrastructureError) and frames[-1].filename.startswith(OWN_CODE)


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
    location = called
    if chosen:
        location = f" at {chosen[-1].filename}:{chosen[-1].lineno}, in {chosen[-1].name}"
    text = re.sub(r"simrun_file_\w{12}", "the file", str(error))  # as a file is imported
    return f"{type(error).__name__}{text and f': {text}'}{location}"


def is_own(part: Any) -> bool:
    """Tell whether a part is one of simrun's, and runs no command of the user's."""
    if getattr(type(part), "runs_a_command", False):
        return False
    while isinstance(part, partial):  # as shipped evaluators are made
        part = part.func
    module = part.__module__ if isfunction(part) else type(part).__module__
    return module.partition(".")[0] in OWN_PACKAGES


def runs_users_code(part: Any, method: str) -> bool:
    """Tell whether a method of a part is code of the user's, not one that a user's class inherits
    from simrun; or runs a command of theirs.
    """
    if getattr(type(part), "runs_a_command", False):
        return True
    module = getattr(getattr(type(part), method, None), "__module__", None) or ""
    return not is_own(part) and module.partition(".")[0] not in OWN_PACKAGES


def defined(part: Any, method: str) -> str:
    """Name the line at which a method of a user's part is defined: `` (mine.py:12)``; nothing for a
    part of simrun's.
    """
    code = getattr(getattr(type(part), method, None), "__code__", None)
    if code is None or type(part).__module__.partition(".")[0] in OWN_PACKAGES:
        return ""
    return f" ({code.co_filename}:{code.co_firstlineno})"


# --- which part a process calls, for whoever finds it dead

HEAD = struct.Struct("=Bdi")  # whether the part is at work, since when, bytes of text
NOTE_BYTES = 4096
NOBODY = 0
AT_WORK = 1
CALLED = 2
FORKED = 70  # exit code of a copy of this process that a part made and let out (EX_SOFTWARE)


@dataclass(frozen=True)
class Culprit:
    """The user's part that a process called last.

    Attributes:
        kind: Error of the part.
        name: The part, and what it did.
        called: Where that is defined; may be empty.
        is_at_work: Whether the call had not returned.
        since_s: When it began, in seconds of ``time.monotonic``.
    """

    kind: type[SimrunError]
    name: str
    called: str
    is_at_work: bool
    since_s: float

    def error(self, ending: str) -> SimrunError:
        """Return the part's error for what became of its process."""
        return self.kind(
            f"{self.name}: {ending}{self.called}",
            "Correct the part: it may raise, but not end or leave its process.",
        )


class Note:
    """A file in which a process keeps the name of the user's part that it calls; it stays when the
    process dies, however that ends.
    """

    def __init__(self, path: Path) -> None:
        path.touch()
        os.truncate(path, NOTE_BYTES)
        with path.open("r+b") as file:
            self._bytes = mmap.mmap(file.fileno(), NOTE_BYTES)

    def begin(self, kind: type[SimrunError], name: str, called: str) -> None:
        """Note that a part is called."""
        text = "\0".join((kind.__name__, name, called)).encode()[: NOTE_BYTES - HEAD.size]
        self._bytes[HEAD.size : HEAD.size + len(text)] = text
        self._bytes[: HEAD.size] = HEAD.pack(AT_WORK, time.monotonic(), len(text))

    def end(self) -> None:
        """Note that the call has returned."""
        self._bytes[0] = CALLED

    def clear(self) -> None:
        """Forget the part: a new job begins."""
        self._bytes[0] = NOBODY

    def read(self) -> Culprit | None:
        """Return the part that is called, or was called last, in this job; None where none was."""
        state, since_s, size = HEAD.unpack(self._bytes[: HEAD.size])
        if state == NOBODY:
            return None
        text = self._bytes[HEAD.size : HEAD.size + size].decode(errors="replace")
        kind, name, called = text.split("\0")
        return Culprit(FAULTS[kind], name, called, state == AT_WORK, since_s)

    def close(self) -> None:
        """Close the file."""
        self._bytes.close()


_notes: list[Note] = []  # of this process; at most one


def note_in(path: Path) -> Note:
    """Let `blaming` note in a file which part this process calls."""
    note = Note(path)
    _notes[:] = [note]
    return note


def last_called() -> Culprit | None:
    """Return the user's part that this process calls, or called last, in its present job; None
    where none was, or nobody asked for notes.
    """
    return _notes[0].read() if _notes else None


@contextmanager
def noted(kind: type[SimrunError], name: str, called: str, is_users: bool) -> Iterator[None]:
    """Note that a user's part is called. A copy of the process that the part made by forking, and
    let come back, ends here: it would go on with the rollout beside this one.
    """
    if not is_users:
        yield
        return
    process = os.getpid()
    # Calls from other threads, such as a server's, leave the note alone.
    notes = _notes if threading.current_thread() is threading.main_thread() else []
    for note in notes:
        note.begin(kind, name, called)
    try:
        yield
    finally:
        if os.getpid() != process:
            os._exit(FORKED)
        for note in notes:
            note.end()
