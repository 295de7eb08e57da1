"""The server of a running run: what finishes is picked up, and nothing but files of the run is
given, to nobody else.
"""

from __future__ import annotations

import http.client
import json
import math
import os
import shutil
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.log.run_folder.reader import RunSoFar
from evaluators.opening import read_so_far
from evaluators.viewer import serve
from evaluators.viewer.cells import Wanted
from evaluators.viewer.page import Options
from evaluators.viewer.serve import RunServer, file_below, loopback
from tests.report.make_run import Plan
from tests.viewer.make_watched import make_watched, unfinished

PLAN = Plan(renderers=("clean", "3dgs"), scenes=("smoke-straight",), seeds=(0, 1), steps=12)
LATE = (
    "rollouts/3dgs/lane-camera/smoke-straight/0",
    "rollouts/clean/lane-camera/smoke-straight/1",
    "rollouts/3dgs/lane-camera/smoke-straight/1",
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_watched(tmp_path_factory.mktemp("served"), PLAN)


@pytest.fixture
def running(made: Path, tmp_path: Path) -> tuple[Path, dict[str, bytes]]:
    """Copy a run, of which one rollout of four has finished; with the manifests of the others."""
    root = Path(shutil.copytree(made, tmp_path / "run"))
    return root, unfinished(root, LATE)


@pytest.fixture
def server(
    running: tuple[Path, dict[str, bytes]], monkeypatch: pytest.MonkeyPatch
) -> Iterator[RunServer]:
    monkeypatch.setattr(serve, "LEAST_AGE_S", 0.0)
    monkeypatch.setattr(serve, "MOST_SHARE", math.inf)
    with RunServer(
        ("127.0.0.1", 0), lambda: read_so_far(running[0]), Wanted(), Options()
    ) as opened:
        thread = threading.Thread(target=opened.serve_forever, args=(0.02,), daemon=True)
        thread.start()
        yield opened
        opened.shutdown()
        thread.join()


def ask(
    server: RunServer, path: str, method: str = "GET", host: str | None = ""
) -> tuple[int, dict[str, str], bytes]:
    """Send one request as it stands: no part of the path is tidied up on the way."""
    connection = http.client.HTTPConnection("127.0.0.1", server.server_address[1], timeout=20)
    connection.putrequest(method, path, skip_host=True)
    if host is not None:
        connection.putheader("Host", host or f"127.0.0.1:{server.server_address[1]}")
    connection.endheaders()
    answer = connection.getresponse()
    body = answer.read() if method != "HEAD" else b""
    connection.close()
    return answer.status, {name.lower(): value for name, value in answer.getheaders()}, body


def get_json(server: RunServer, path: str) -> Any:
    status, headers, body = ask(server, path)
    assert (status, headers["content-type"]) == (200, "application/json")
    return json.loads(body)


def test_what_finishes_is_picked_up(
    server: RunServer, running: tuple[Path, dict[str, bytes]]
) -> None:
    root, later = running
    index = get_json(server, "/index.json")
    assert (index["done"], index["planned"], index["finished"], index["live"]) == (
        1,
        4,
        False,
        True,
    )
    (cell,) = index["cells"]
    assert list(cell["outcomes"]) == ["clean"]
    assert [
        drive["renderer"] for drive in get_json(server, f"/cells/{cell['id']}.json")["drives"]
    ] == ["clean"]
    for path, manifest in later.items():
        (root / path / "manifest.json").write_bytes(manifest)
        index = get_json(server, "/index.json")
    assert (index["done"], len(index["cells"])) == (4, 2)
    same = next(one for one in index["cells"] if one["id"] == cell["id"])
    assert list(same["outcomes"]) == ["clean", "3dgs"]
    drives = get_json(server, f"/cells/{cell['id']}.json")["drives"]
    assert [(drive["renderer"], len(drive["cameras"][0]["t"])) for drive in drives] == [
        ("clean", 12),
        ("3dgs", 12),
    ]


def test_a_rollout_whose_files_changed_after_its_manifest_is_named_and_not_shown(
    server: RunServer, running: tuple[Path, Any]
) -> None:
    log = running[0] / "rollouts/clean/lane-camera/smoke-straight/0/rollout.asl"
    log.write_bytes(log.read_bytes()[:-100])
    index = get_json(server, "/index.json")
    assert index["done"] == 0
    assert index["cells"] == []
    assert "rollout.asl" in index["notes"][0]


def test_the_page_may_ask_its_own_server_and_nobody_else(server: RunServer) -> None:
    status, headers, body = ask(server, "/")
    assert status == 200
    assert b"connect-src 'self';" in body
    assert b"unsafe" not in body[: body.index(b"<style>")]
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["x-frame-options"] == "DENY"
    assert headers["cross-origin-resource-policy"] == "same-origin"
    assert "access-control-allow-origin" not in headers


@pytest.mark.parametrize(
    "method", ["POST", "PUT", "DELETE", "HEAD", "OPTIONS", "PATCH", "TRACE", "CONNECT"]
)
def test_only_get_is_answered(server: RunServer, method: str) -> None:
    assert ask(server, "/index.json", method)[0] == 405


@pytest.mark.parametrize(
    "host",
    [
        None,
        "evil.example",
        "127.0.0.1:1",
        "localhost",
        "127.0.0.1.evil.example:{port}",
        "x@127.0.0.1:{port}",
    ],
)
def test_a_page_of_another_name_gets_nothing(server: RunServer, host: str | None) -> None:
    status, _, body = ask(
        server,
        "/index.json",
        host=None if host is None else host.format(port=server.server_address[1]),
    )
    assert status == 403
    assert b"cells" not in body


def test_its_own_names_are_answered(server: RunServer) -> None:
    for name in ("localhost", "127.0.0.1", "[::1]", "LOCALHOST"):
        assert ask(server, "/index.json", host=f"{name}:{server.server_address[1]}")[0] == 200


OUTSIDE = (
    "/run/../secret.json",
    "/run/%2e%2e/secret.json",
    "/run/..%2fsecret.json",
    "/run/rollouts/../../secret.json",
    "/run//etc/passwd",
    "/run/%2fetc/hostname.json",
    "/run/..%5csecret.json",
    "/run/C:%5csecret.json",
    "/run/link.json",
    "/run/folder/secret.json",
    "/run/.hidden.json",
    "/run/.simrun.lock",
    "/run/run.json%00.html",
    "/run/",
    "/run/rollouts",
    "/run/rollouts/",
    "/run/notes.py",
    "/../secret.json",
    "/secret.json",
    "/cells/../index.json",
    "/cells/nobody.json",
    "/cells/",
    "//etc/passwd",
    "/run/%ff%fe.json",
    "/index.json/..",
)


@pytest.mark.parametrize("path", OUTSIDE)
def test_nothing_but_files_of_the_run_is_given(
    server: RunServer, running: tuple[Path, Any], path: str
) -> None:
    root = running[0]
    (root.parent / "secret.json").write_text('"secret"')
    (root / ".hidden.json").write_text('"secret"')
    (root / "notes.py").write_text("secret")
    if not (root / "link.json").is_symlink():
        os.symlink(root.parent / "secret.json", root / "link.json")
        os.symlink(root.parent, root / "folder")
    status, _, body = ask(server, path)
    assert status == 404
    assert b"secret" not in body


def test_files_of_the_run_are_given(server: RunServer, running: tuple[Path, Any]) -> None:
    status, headers, body = ask(
        server, "/run/rollouts/clean/lane-camera/smoke-straight/0/strip.jpg"
    )
    assert (status, headers["content-type"]) == (200, "image/jpeg")
    assert (
        body == (running[0] / "rollouts/clean/lane-camera/smoke-straight/0/strip.jpg").read_bytes()
    )
    assert file_below(running[0], "run.json") == running[0] / "run.json"


def test_a_page_of_the_run_is_an_origin_of_its_own_that_may_ask_nobody(
    server: RunServer, running: tuple[Path, Any]
) -> None:
    (running[0] / "sent.html").write_text("<script>fetch('/index.json')</script>")
    status, headers, _ = ask(server, "/run/sent.html")
    policy = headers["content-security-policy"]
    assert status == 200
    assert policy.startswith("sandbox allow-scripts")
    assert "allow-same-origin" not in policy
    assert "default-src 'none'" in policy
    assert "connect-src" not in policy


def test_a_client_that_wants_the_connection_closed_gets_it_closed_after_a_file(
    server: RunServer,
) -> None:
    with socket.create_connection(("127.0.0.1", server.server_address[1]), timeout=20) as wire:
        host = f"127.0.0.1:{server.server_address[1]}"
        wire.sendall(
            f"GET /run/run.json HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n".encode()
        )
        answer = b""
        while piece := wire.recv(
            65536
        ):  # ends when the server closes; otherwise the time limit ends it with an error
            answer += piece
    assert answer.startswith(b"HTTP/1.1 200")


def test_many_askers_wait_for_one_look_at_the_folder(running: tuple[Path, Any]) -> None:
    looks = []

    def slow() -> RunSoFar:
        looks.append(time.monotonic())
        time.sleep(0.05)
        return read_so_far(running[0])

    with RunServer(("127.0.0.1", 0), slow, Wanted(), Options()) as server:
        threads = [threading.Thread(target=server.seen) for _ in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(looks) == 1  # the one of the beginning is young enough
        assert server._seen is not None
        assert server._seen[0] - looks[0] >= 0.05 / serve.MOST_SHARE


def test_addresses_of_this_machine_alone() -> None:
    assert loopback("127.0.0.2:80") == ("127.0.0.2", 80)
    assert loopback("localhost:0") == ("localhost", 0)
    near = ("127.0.0.1.example:80", "127.0.0.1", "127.0.0.1:99999", "127.0.0.1:-1")
    for refused in ("0.0.0.0:80", "192.168.1.2:80", "[::]:80", "example.com:80", "", *near):
        with pytest.raises(InputError):
            loopback(refused)


def test_a_port_that_is_taken_is_an_error_of_the_machine(
    server: RunServer, running: tuple[Path, Any]
) -> None:
    with pytest.raises(InfrastructureError, match="choose another port"):
        RunServer(
            ("127.0.0.1", server.server_address[1]),
            lambda: read_so_far(running[0]),
            Wanted(),
            Options(),
        )
