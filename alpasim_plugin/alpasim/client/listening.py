"""Where a child process shall listen: a socket file that only this user can reach, or a port of the loopback device."""

from __future__ import annotations

import shutil
import socket
from contextlib import suppress
from pathlib import Path
from typing import Protocol

from alpasim_plugin.core.errors import InputError

MAX_PATH = 100  # of a socket file; the system's own limit is 104 (macOS) or 108 (Linux)
LOOPBACK = "127.0.0.1"


class Place(Protocol):
    """Where a child shall listen."""

    address: str  # as gRPC dials it

    def filled_in(self, word: str) -> str:
        """Return a word of the command with its place holders replaced."""
        ...

    def is_open(self) -> bool:
        """Tell whether somebody accepts connections there."""
        ...

    def close(self) -> None:
        """Give the place back."""
        ...


class SocketFile:
    """A socket file in a folder of its own.

    Raises:
        InputError: Its path is too long for a socket.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, path = folder, folder / "policy.sock"
        if len(str(path)) > MAX_PATH:
            shutil.rmtree(folder)
            found = f"{path} is longer than {MAX_PATH} characters"
            raise InputError("choosing a socket", "the folder for temporary files", found, "set TMPDIR=/tmp, or name {port} in the command")
        self._path, self.address = path, f"unix:{path}"

    def filled_in(self, word: str) -> str:
        """Replace ``{address}`` and ``{folder}``, the socket's folder, which a container must mount."""
        return word.replace("{address}", self.address).replace("{folder}", str(self._folder))

    def is_open(self) -> bool:
        """Tell whether somebody accepts connections there."""
        with socket.socket(socket.AF_UNIX) as one, suppress(OSError):
            one.connect(str(self._path))
            return True
        return False

    def close(self) -> None:
        """Remove the folder; harmless if it is gone."""
        shutil.rmtree(self._folder, ignore_errors=True)


class LoopbackPort:
    """A free port, kept from other processes of ours by a datagram socket of the same number.

    gRPC lets two servers share a port, and between our choice and the child's listening another of us might choose the same.
    """

    def __init__(self) -> None:
        while True:
            with socket.socket() as free:
                free.bind((LOOPBACK, 0))
                self._port = int(free.getsockname()[1])
            self._claim = socket.socket(type=socket.SOCK_DGRAM)
            try:
                self._claim.bind((LOOPBACK, self._port))
            except OSError:
                self._claim.close()
                continue
            break
        self.address = f"{LOOPBACK}:{self._port}"

    def filled_in(self, word: str) -> str:
        """Replace ``{address}`` and ``{port}``."""
        return word.replace("{address}", self.address).replace("{port}", str(self._port))

    def is_open(self) -> bool:
        """Tell whether somebody accepts connections there."""
        with socket.socket() as one, suppress(OSError):
            one.connect((LOOPBACK, self._port))
            return True
        return False

    def close(self) -> None:
        """Give the port's number back."""
        self._claim.close()
