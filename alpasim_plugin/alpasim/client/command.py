"""``--policy "exec:COMMAND"``: a policy in another Python environment or a container, started here
and driven over a local socket.

The command serves AlpaSim's EgodriverService (`alpasim_plugin.serve_policy` does, so does AlpaSim's
own driver) at the address in the environment variable ``SIMRUN_POLICY_ADDRESS``. It is started once
in each process that drives, for all of its rollouts, and ended with the run.
"""

from __future__ import annotations

import re
import shlex
import shutil
import socket
import tempfile
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import grpc

from alpasim_plugin.alpasim.client.channel import Address
from alpasim_plugin.alpasim.client.child import Child, exit_reason
from alpasim_plugin.alpasim.client.driver import OPTIONS, DriverPolicy, cameras_sent
from alpasim_plugin.core.errors import InputError, PolicyError, SimrunError
from alpasim_plugin.core.queries import options_of
from alpasim_plugin.core.subprocesses import say
from alpasim_plugin.core.types import Scenario
from alpasim_plugin.log.wire.services import is_lost_connection

MAX_PATH = 100  # of a socket file; the system's own limit is 104 (macOS) or 108 (Linux)
LOOPBACK = "127.0.0.1"
VARIABLE = "SIMRUN_POLICY_ADDRESS"
ENCODING = "png"  # what the policy sees is what it would see in this process
READY_S = 120.0  # a container starts, a network is loaded
POLL_S = 0.02
REAP_S = 1.0  # between the end of a connection and that of the process behind it
SHOWN_LINES = 3


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
        self._folder = folder
        path = folder / "policy.sock"
        if len(str(path)) > MAX_PATH:
            shutil.rmtree(folder)
            raise InputError(
                f"the folder for temporary files: {path} is longer than {MAX_PATH} characters",
                "set TMPDIR=/tmp, or name {port} in the command",
            )
        self._path = path
        self.address = f"unix:{path}"

    def filled_in(self, word: str) -> str:
        """Replace ``{address}`` and ``{folder}``, the socket's folder, which a container must
        mount.
        """
        return word.replace("{address}", self.address).replace("{folder}", str(self._folder))

    def is_open(self) -> bool:
        """Tell whether somebody accepts connections there."""
        with socket.socket(socket.AF_UNIX) as connection, suppress(OSError):
            connection.connect(str(self._path))
            return True
        return False

    def close(self) -> None:
        """Remove the folder; harmless if it is gone."""
        shutil.rmtree(self._folder, ignore_errors=True)


class LoopbackPort:
    """A free port, kept from other processes of ours by a datagram socket of the same number.

    gRPC lets two servers share a port, and between our choice and the child's listening another of
    us might choose the same.
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
        with socket.socket() as connection, suppress(OSError):
            connection.connect((LOOPBACK, self._port))
            return True
        return False

    def close(self) -> None:
        """Give the port's number back."""
        self._claim.close()


@dataclass(frozen=True)
class Command:
    """What stands after ``exec:``: ``[?OPTION=VALUE[&...] ]PROGRAM ARGUMENT...``.

    Attributes:
        text: As it was given.
        words: Program and arguments; ``{address}``, ``{port}`` and ``{folder}`` stand for where the
            policy shall listen.
        options: Those of `alpasim_plugin.alpasim.client.driver`, and ``ready_s``.
    """

    text: str
    words: tuple[str, ...]
    options: Mapping[str, str]

    @classmethod
    def parse(cls, text: str) -> Command:
        """Read a command; no shell is asked, quotes are read as a shell reads them.

        Example:
            >>> Command.parse("?timeout_s=5 python drive.py --net 'a b.pt'").words
            ('python', 'drive.py', '--net', 'a b.pt')

        Raises:
            InputError: No program, one that is not found, an open quote, or an unknown option.
        """
        whole = f"exec:{text}"
        head, _, command_line = text.partition(" ") if text.startswith("?") else ("", "", text)
        options = options_of(head[1:], (*OPTIONS, "ready_s"), whole)
        for key in ("ready_s", "timeout_s"):
            if not re.fullmatch(r"\d+(\.\d+)?", options.get(key, "1")):
                raise InputError(f"{whole}: {key}={options[key]!r}", "write seconds as a number")
        try:
            words = tuple(shlex.split(command_line))
        except ValueError as error:
            raise InputError(f"{whole}: {error}", "close the quotes") from error
        if not words:
            raise InputError(
                f"{whole}: no program",
                "write exec:PROGRAM ARGUMENT..., such as 'exec:python my_policy.py'",
            )
        if shutil.which(words[0]) is None:
            raise InputError(
                f"{whole}: no program {words[0]!r}",
                "install it, or write its path; a shell is not asked",
            )
        return cls(text, words, options)


class Served:
    """A command that runs and has opened its address.

    Raises:
        PolicyError: It ended before, or did not open it in time.
    """

    def __init__(self, command: Command) -> None:
        self.command = command
        in_text = " ".join(command.words)
        self._place = (
            LoopbackPort()
            if "{port}" in in_text
            else SocketFile(Path(tempfile.mkdtemp(prefix="simrun-policy-")))
        )
        words = [self._place.filled_in(word) for word in command.words]
        self._child = Child(words, {VARIABLE: self._place.address}, say, self._place.close)
        self.address = self._place.address
        limit_s = float(command.options.get("ready_s", READY_S))
        end_s = time.monotonic() + limit_s
        while not self._place.is_open():
            self.require_running()
            if time.monotonic() > end_s:
                self.stop()
                raise PolicyError(
                    f"{self._name}: nothing listens at {self.address} after {limit_s:g} s{self._said()}",
                    f"let it serve at the address in {VARIABLE}, or give it longer: ?ready_s=N",
                ) from TimeoutError()
            time.sleep(POLL_S)
        self.require_running()

    def require_running(self, wait_s: float = 0.0) -> None:
        """Raise if the command has ended, or does so within a time.

        Raises:
            PolicyError: It has.
        """
        code = self._child.end_within(wait_s)
        if code is not None:
            self.stop()
            raise PolicyError(
                f"{self._name}: it ended with {exit_reason(code)}{self._said()}",
                "see output.log of the rollout",
            ) from ChildProcessError(code)

    def is_running(self) -> bool:
        """Tell whether the command still runs."""
        return self._child.end_within(0.0) is None

    def stop(self) -> None:
        """End the command; harmless if it has ended."""
        self._child.stop()

    @property
    def _name(self) -> str:
        return f"exec:{self.command.text}"

    def _said(self) -> str:
        lines = [line.strip() for line in self._child.last if line.strip()][-SHOWN_LINES:]
        return f"; its last lines: {' | '.join(lines)}" if lines else "; it printed nothing"


_served: dict[str, Served] = {}


class CommandPolicy(DriverPolicy):
    """A policy that a command serves.

    Args:
        scenario: Gives cameras, periods and the warm-up.
        address: The command, as `Command.parse` reads it. Frames are sent as PNG unless it says
            otherwise, and the main camera under its own name: the policy sees what it would see in
            this process.

    Raises:
        InputError: As `Command.parse`.
        PolicyError: The command ends, or does not serve in time.
    """

    runs_a_command = True  # of the user's, who is to blame where it hangs

    def __init__(self, scenario: Scenario, address: str) -> None:
        command = Command.parse(address)
        held = _served.get(command.text)
        if held is None or not held.is_running():
            if held is not None:
                held.stop()  # gives back its place
            held = _served[command.text] = Served(command)
        self._served = held
        try:
            super().__init__(
                scenario,
                Address(self._served.address, {"encoding": ENCODING, **command.options}),
                None,
            )
        except SimrunError:
            self._served.require_running(REAP_S)
            raise
        self._facts |= {"command": address}

    @staticmethod
    def check_scenario(scenario: Scenario, address: str) -> None:
        """Refuse a scenario whose images cannot be sent, before a run begins."""
        cameras_sent(scenario, Command.parse(address).options, None, ENCODING)

    @staticmethod
    def check_address(address: str) -> None:
        """Refuse what is no command, before a run begins."""
        Command.parse(address)

    def _call(self, method: str, request: Any) -> Any:
        try:
            return super()._call(method, request)
        # a connection is lost, too, where the command has ended: that is its own fault
        except SimrunError as error:
            self._served.require_running(0.0 if isinstance(error, PolicyError) else REAP_S)
            if "DEADLINE_EXCEEDED" in error.message:  # it hangs: the next rollout gets a new one
                self._served.stop()
            cause = error.__cause__
            if isinstance(cause, grpc.RpcError) and is_lost_connection(cause):
                # Both ends are on this machine: nothing but the command can have closed its end.
                self._served.stop()
                raise PolicyError(
                    f"exec:{self._served.command.text}: it closed the connection, and still runs",
                    "see output.log of the rollout",
                ) from error
            raise
