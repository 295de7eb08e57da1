"""Show a run in a browser on this machine while it goes on. Only GET, only this machine, only files
of the run.
"""

from __future__ import annotations

import ipaddress
import os
import socket
import threading
import time
from collections.abc import Callable, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote, urlsplit

from alpasim_plugin.core.errors import InfrastructureError, InputError, SimrunError
from alpasim_plugin.log.run_folder.reader import RunSoFar
from evaluators.opening import Run
from evaluators.viewer.cells import (
    Wanted,
    WatchedCell,
    cell_data,
    cells_of,
    check_wanted,
    index_data,
    read_logs,
)
from evaluators.viewer.page import Options, as_json, render

DOING = "serving a run"
LEAST_AGE_S = 1.0  # the folder is not looked through more often than this,
MOST_SHARE = 0.05  # and looking takes no more than this share of the time: the run needs the cores
PIECE = 1 << 20  # bytes
PATIENCE_S = 30.0  # for a client that says nothing
TYPES = {
    ".html": "text/html; charset=utf-8",
    ".json": "application/json",
    ".md": "text/plain; charset=utf-8",
    ".xml": "text/plain; charset=utf-8",
    ".jsonl": "text/plain; charset=utf-8",
    ".jpg": "image/jpeg",
    ".png": "image/png",
    ".mp4": "video/mp4",
    ".parquet": "application/octet-stream",
    ".asl": "application/octet-stream",
}
HEADERS = {
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}

NOTHING: Mapping[str, str] = {}
# A run folder may come from anybody: a page in it may show what it holds itself, in an origin of
# its own, and ask nobody for anything.
OF_A_RUN = {
    "Content-Security-Policy": "sandbox allow-scripts allow-popups; default-src 'none'; script-src 'unsafe-inline'; "
    "style-src 'unsafe-inline'; img-src 'self' data:; media-src 'self' data:; font-src data:"
}


def loopback(text: str) -> tuple[str, int]:
    """Read ``HOST:PORT`` or ``PORT`` of this machine.

    Raises:
        InputError: No port, or an address that other machines can reach.

    Example:
        >>> loopback("8000"), loopback("[::1]:0")
        (('127.0.0.1', 8000), ('::1', 0))
    """
    host, _, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]") or "127.0.0.1"
    if not port.isdecimal() or int(port) > 65535:
        raise InputError(
            f"--serve {text}: no port",
            "give HOST:PORT, such as 127.0.0.1:8000, or a port alone",
        )
    try:
        near = host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        near = False
    if not near:
        raise InputError(
            f"--serve {text}: not an address of this machine alone",
            "give 127.0.0.1:PORT and reach it from elsewhere through ssh -L",
        )
    return host, int(port)


class RunServer(ThreadingHTTPServer):
    """Serves one run folder.

    Args:
        address: Host and port; port 0 takes a free one.
        read: Reads the run as it is now.
        wanted: Which rollouts are shown.
        options: How camera frames are kept.

    Raises:
        InfrastructureError: The port cannot be had.
        InputError: The run does not plan what is wanted.
    """

    daemon_threads = True

    def __init__(
        self,
        address: tuple[str, int],
        read: Callable[[], RunSoFar[Run]],
        wanted: Wanted,
        options: Options,
    ) -> None:
        if ":" in address[0]:
            self.address_family = socket.AF_INET6
        self._read, self._wanted, self._options = read, wanted, options
        self._lock = threading.Lock()
        self._seen: tuple[float, RunSoFar[Run]] | None = None  # until when it is young enough
        check_wanted(self.run, wanted)
        self.root = self.run.folder.resolve()
        try:
            super().__init__(address, _Handler)
        except OSError as error:
            raise InfrastructureError(
                f"{address[0]}:{address[1]}: {error.strerror or str(error)}",
                "choose another port, or 0 for any",
            ) from error

    @property
    def url(self) -> str:
        """Give the address of the page."""
        host = str(self.server_address[0])
        return f"http://{f'[{host}]' if ':' in host else host}:{self.server_address[1]}/"

    @property
    def hosts(self) -> frozenset[str]:
        """Give the values of the header Host that are answered: a page of another name that
        resolves to this machine is not.
        """
        return frozenset(
            f"{name}:{self.server_address[1]}"
            for name in ("localhost", "127.0.0.1", "[::1]", urlsplit(self.url).hostname)
        )

    def seen(self) -> RunSoFar[Run]:
        """Return the run as it was a moment ago."""
        with self._lock:
            if self._seen is None or time.monotonic() >= self._seen[0]:
                began = time.monotonic()
                now = self._read()
                done = time.monotonic()
                self._seen = (done + max(LEAST_AGE_S, (done - began) / MOST_SHARE), now)
            return self._seen[1]

    @property
    def run(self) -> Run:
        """Give the run as it was a moment ago, with its table of metrics."""
        run = self.seen().run
        assert isinstance(run, Run), "read with `evaluators.opening.read_so_far`"
        return run

    def cells(self) -> list[WatchedCell]:
        """List the cells of which anything is there."""
        return cells_of(self.run, self._wanted, arms=True)

    def index(self) -> dict[str, Any]:
        """Return what the page shows of the run."""
        seen, cells = self.seen(), self.cells()
        report = "run/report.html" if (self.root / "report.html").is_file() else ""
        state: Mapping[str, Any] = {
            "live": True,
            "done": len(seen.run.rollouts),
            "planned": seen.planned,
            "finished": seen.finished,
            "notes": [f"Damaged: {text}" for text in seen.damage],
            "report": report,
        }
        return index_data(self.run, cells, [cell for cell in cells if cell.watchable], state)

    def cell(self, name: str) -> dict[str, Any] | None:
        """Return a cell's document; None where there is none of that id."""
        found = next((cell for cell in self.cells() if cell.id == name and cell.watchable), None)
        if found is None:
            return None
        run = self.run
        return cell_data(
            run, found, read_logs(run, found), self._options.fine, self._options.camera
        )


def file_below(root: Path, name: str) -> Path | None:
    """Find a file of a folder by its path in an address; None where there is none, or where the
    path leads elsewhere.

    Hidden files, unknown suffixes and links out of the folder are not found.
    """
    parts = PurePosixPath(name).parts
    if (
        "\0" in name
        or "\\" in name
        or name.startswith("/")
        or any(part.startswith(".") for part in parts)
    ):
        return None
    path = root.joinpath(*parts)
    if (
        path.suffix not in TYPES
        or not path.is_file()
        or not path.resolve().is_relative_to(root.resolve())
    ):
        return None
    return path


class _Handler(BaseHTTPRequestHandler):
    server: RunServer
    protocol_version = "HTTP/1.1"
    server_version = "simrun"
    sys_version = ""
    timeout = PATIENCE_S

    def do_GET(self) -> None:
        if self.headers.get("Host", "").lower() not in self.server.hosts:
            self._refuse(HTTPStatus.FORBIDDEN, "this server answers to its own address alone")
            return
        path = unquote(urlsplit(self.path).path)
        try:
            self._answer(path)
        except SimrunError as error:
            self._refuse(HTTPStatus.INTERNAL_SERVER_ERROR, str(error))

    def _answer(self, path: str) -> None:
        folder, _, name = path.removeprefix("/").partition("/")
        if path == "/":
            self._send(render(as_json(self.server.index()), {}, live=True).encode(), TYPES[".html"])
        elif path == "/index.json":
            self._send(as_json(self.server.index()).encode(), TYPES[".json"])
        elif (
            folder == "cells" and (cell := self.server.cell(name.removesuffix(".json"))) is not None
        ):
            self._send(as_json(cell).encode(), TYPES[".json"])
        elif folder == "run" and (file := file_below(self.server.root, name)) is not None:
            self._send_file(file)
        else:
            self._refuse(HTTPStatus.NOT_FOUND, "no such page")

    def _send(self, body: bytes, kind: str, status: HTTPStatus = HTTPStatus.OK) -> None:
        self._head(len(body), kind, status)
        self.wfile.write(body)

    def _send_file(self, path: Path) -> None:
        """Send a file piece by piece: a log or a video may be larger than the memory."""
        with path.open("rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            self._head(size, TYPES[path.suffix], HTTPStatus.OK, OF_A_RUN)
            left = size
            while left and (piece := stream.read(min(left, PIECE))):
                self.wfile.write(piece)
                left -= len(piece)
            if left:  # it was cut meanwhile: the client sees too few bytes
                self.close_connection = True

    def _head(
        self, size: int, kind: str, status: HTTPStatus, more: Mapping[str, str] = NOTHING
    ) -> None:
        self.send_response(status)
        for name, value in {
            "Content-Type": kind,
            "Content-Length": str(size),
            **HEADERS,
            **more,
        }.items():
            self.send_header(name, value)
        self.end_headers()

    def _refuse(self, status: HTTPStatus, why: str) -> None:
        self._send(f"{why}\n".encode(), TYPES[".md"], status)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Refuse what is no GET, or no HTTP, in plain text and without echoing it; the connection
        is closed.
        """
        self.close_connection = True
        status = (
            HTTPStatus.METHOD_NOT_ALLOWED
            if code == HTTPStatus.NOT_IMPLEMENTED
            else HTTPStatus(code)
        )
        self._refuse(
            status, "only GET" if status == HTTPStatus.METHOD_NOT_ALLOWED else status.phrase
        )

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing: the terminal shows where the page is."""
