"""An S3 server on this machine, and a line to it that can be cut."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest


class Line:
    """A line to a server that can be cut."""

    def __init__(self, port: int) -> None:
        self._to, self._up = port, True
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._ends: list[socket.socket] = []
        threading.Thread(target=self._serve, daemon=True).start()

    def cut(self) -> None:
        self._up = False
        for end in self._ends:
            end.close()
        self._ends.clear()

    def mend(self) -> None:
        self._up = True

    def _serve(self) -> None:
        while True:
            near, _ = self._listener.accept()
            if not self._up:
                near.close()
                continue
            far = socket.create_connection(("127.0.0.1", self._to))
            self._ends += [near, far]
            for one, other in ((near, far), (far, near)):
                threading.Thread(target=self._pump, args=(one, other), daemon=True).start()

    def _pump(self, one: socket.socket, other: socket.socket) -> None:
        try:
            while data := one.recv(65536):
                other.sendall(data)
        except OSError:
            pass
        finally:
            one.close()
            other.close()


@contextmanager
def s3_line() -> Iterator[Line]:
    """Give a line to moto's S3 server with a bucket ``runs``; the environment of this process, and
    of those it starts, names it.
    """
    pytest.importorskip("s3fs", reason="the extra [s3] is not installed")
    server_of = pytest.importorskip(
        "moto.server", reason="moto[server] is not installed"
    ).ThreadedMotoServer
    server = server_of(port=0)
    server.start()
    line = Line(server.get_host_and_port()[1])
    known = {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{line.port}",
        "AWS_ACCESS_KEY_ID": "a",
        "AWS_SECRET_ACCESS_KEY": "b",
    }
    with pytest.MonkeyPatch.context() as environment:
        for name, value in {**known, "AWS_DEFAULT_REGION": "us-east-1"}.items():
            environment.setenv(name, value)
        import s3fs

        s3fs.S3FileSystem.clear_instance_cache()
        if not s3fs.S3FileSystem().exists(
            "runs"
        ):  # moto's servers of one process share their buckets
            s3fs.S3FileSystem().mkdir("runs")
        yield line
    server.stop()
