"""Stores by URL: each rollout committed once, whoever drives it, and a store that goes away and
comes back.

`pytest -m "" tests/runs/test_stores.py` also talks to moto's S3 server, about a minute and a half.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.runs.commits import (
    Commits,
    FolderObjects,
    Index,
    Objects,
    RemoteObjects,
    RolloutResult,
    open_objects,
)
from alpasim_plugin.runs.executors.base import Node
from alpasim_plugin.runs.run import execute_run
from tests.runs.s3_server import Line, s3_line
from tests.runs.test_runs import Announced, cheap_plan, comparable


def result(text: str) -> RolloutResult:
    data = text.encode()
    facts = {"bytes": len(data), "mtime_ns": 0, "sha256": hashlib.sha256(data).hexdigest()}
    return RolloutResult(
        {"path": "rollouts/a/b/c/0", "status": "ok", "files": {"rollout.asl": facts}},
        {"rollout.asl": data},
    )


def check_objects(objects: Objects) -> None:
    assert objects.read("a/b") is None
    objects.write("a/b", b"1")
    objects.write("a/b", b"2")
    assert objects.read("a/b") == b"2"
    assert not objects.create("a/b", b"3")
    with ThreadPoolExecutor(8) as threads:
        made = list(threads.map(lambda i: objects.create("c", b"%d" % i), range(8)))
    assert sum(made) == 1
    assert objects.read("c") == b"%d" % made.index(True)


def check_commits(objects: Objects) -> None:
    one, other = Commits("one", objects), Commits("other", objects)
    assert one.find("k1") is None
    assert one.commit("k1", result("first")) == result("first")
    assert other.commit("k1", result("second")) == result("first")
    assert other.find("k1") == result("first")


def test_a_key_of_a_folder_is_made_once(tmp_path: Path) -> None:
    check_objects(FolderObjects(tmp_path))
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["a", "b", "c"]


def test_the_first_commit_stands(tmp_path: Path) -> None:
    check_commits(FolderObjects(tmp_path))


def test_a_commit_whose_files_are_cut_is_named(tmp_path: Path) -> None:
    commits = Commits("here", FolderObjects(tmp_path))
    commits.commit("k1", result("first"))
    next(tmp_path.rglob("rollout.asl")).write_text("fir")
    with pytest.raises(InfrastructureError, match="is not what was committed"):
        commits.find("k1")


def test_files_of_an_attempt_that_was_cut_off_are_no_rollout(tmp_path: Path) -> None:
    class Killed(FolderObjects):
        def create(self, key: str, data: bytes) -> bool:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Commits("here", Killed(tmp_path)).commit("k1", result("first"))
    assert list(tmp_path.rglob("rollout.asl"))
    assert Commits("here", FolderObjects(tmp_path)).find("k1") is None


def test_two_drivers_write_one_index(tmp_path: Path) -> None:
    one, other = Index(FolderObjects(tmp_path)), Index(FolderObjects(tmp_path))
    one.load()
    other.load()
    one.add(["a", "b"])
    one.flush()
    other.add(["b", "c"])
    other.flush()
    later = Index(FolderObjects(tmp_path))
    later.load()
    assert later.keys == other.keys == {"a", "b", "c"}
    assert sorted(path.name for path in (tmp_path / "index").iterdir()) == [
        "000000.json",
        "000001.json",
    ]


def test_a_full_part_of_the_index_is_written_at_once(tmp_path: Path) -> None:
    index = Index(FolderObjects(tmp_path))
    index.add(str(i) for i in range(999))
    assert not (tmp_path / "index").exists()
    index.add(["999"])
    assert (tmp_path / "index" / "000000.json").exists()


def test_a_store_of_an_unknown_kind_is_refused() -> None:
    pytest.importorskip("fsspec")
    with pytest.raises(InputError, match="nowhere"):
        open_objects("nowhere://a/b")


def test_the_answer_to_a_commit_that_was_lost_is_no_second_rollout(tmp_path: Path) -> None:
    class Deaf(FolderObjects):
        def create(self, key: str, data: bytes) -> bool:
            super().create(key, data)
            return False

    own = result("first")
    assert Commits("here", Deaf(tmp_path)).commit("k1", own) is own


@pytest.mark.slow
def test_a_run_with_a_store_is_taken_from_it_into_an_empty_folder(tmp_path: Path) -> None:
    plan, store = cheap_plan(), str(tmp_path / "store")
    first, again = Announced(), Announced()
    execute_run(
        plan, tmp_path / "plain", 1, ["simrun"], Announced(), certificate="none", report=False
    )
    execute_run(
        plan, tmp_path / "one", 1, ["simrun"], first, certificate="none", report=False, store=store
    )
    execute_run(
        plan, tmp_path / "two", 1, ["simrun"], again, certificate="none", report=False, store=store
    )
    assert first.results == [("ok", False)] * 4
    assert again.results == [("ok", True)] * 4
    assert (
        comparable(tmp_path / "one")
        == comparable(tmp_path / "two")
        == comparable(tmp_path / "plain")
    )
    one, two = (pq.read_table(tmp_path / name / "rollouts.parquet") for name in ("one", "two"))
    assert one == two, "wall_s too: it is the same drive"
    latest = tmp_path / "store" / (tmp_path / "store" / "latest").read_text()
    assert (latest / "rollouts.parquet").read_bytes() == (
        tmp_path / "two" / "rollouts.parquet"
    ).read_bytes()


DRIVER = """
import sys
from pathlib import Path
from alpasim_plugin.runs.run import execute_run
from tests.runs.s3_server import Line, s3_line
from tests.runs.test_runs import Announced, cheap_plan
execute_run(cheap_plan((0, 1)), Path(sys.argv[1]), 1, ["simrun"], Announced(), certificate="none", report=False, store=sys.argv[2])
"""


def driver(repo: Path, root: Path, store: str, **environment: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-c", DRIVER, str(root), store]
    return subprocess.Popen(
        command, cwd=repo, env={**os.environ, "PYTHONPATH": str(repo), **environment}
    )


@pytest.mark.slow
def test_two_drivers_of_one_run_commit_each_rollout_once(tmp_path: Path, repo: Path) -> None:
    store = str(tmp_path / "store")
    both = [driver(repo, tmp_path / name, store) for name in ("one", "two")]
    assert [one.wait(280) for one in both] == [0, 0]
    assert len(list((tmp_path / "store" / "commits").rglob("*.json"))) == 8
    one, two = (pq.read_table(tmp_path / name / "rollouts.parquet") for name in ("one", "two"))
    assert one == two, "wall_s too: both have the drive that was committed"


@pytest.mark.slow
def test_a_killed_driver_goes_on_from_another_folder(tmp_path: Path, repo: Path) -> None:
    store = tmp_path / "store"
    first = driver(repo, tmp_path / "one", str(store))
    until = time.monotonic() + 200
    while len(list(store.glob("commits/*/*.json"))) < 3:
        assert time.monotonic() < until
        time.sleep(0.02)
    first.kill()
    first.wait()
    kept = {path.name: path.read_bytes() for path in store.glob("commits/*/*.json")}
    announced = Announced()
    execute_run(
        cheap_plan((0, 1)),
        tmp_path / "two",
        1,
        ["simrun"],
        announced,
        certificate="none",
        report=False,
        store=str(store),
    )
    assert all(
        (store / "commits" / name[:2] / name).read_bytes() == data for name, data in kept.items()
    )
    execute_run(
        cheap_plan((0, 1)),
        tmp_path / "plain",
        1,
        ["simrun"],
        Announced(),
        certificate="none",
        report=False,
    )
    assert comparable(tmp_path / "two") == comparable(tmp_path / "plain")


@pytest.fixture
def s3() -> Iterator[Line]:
    """Give a line to moto's S3 server with a bucket ``runs``; the environment names it."""
    with s3_line() as line:
        yield line


@pytest.mark.slow
def test_a_bucket_keeps_the_same_promises(s3: Line) -> None:
    objects = open_objects("s3://runs/promises")
    assert isinstance(objects, RemoteObjects)
    check_objects(objects)
    check_commits(open_objects("s3://runs/commits"))
    with pytest.raises(InfrastructureError, match="check the address, the bucket"):
        open_objects("s3://no-such-bucket/a").write("b", b"")


@pytest.mark.slow
def test_a_store_that_is_away_for_30_s_costs_time_and_nothing_else(
    tmp_path: Path, repo: Path, s3: Line
) -> None:
    away_s = 30.0
    one = driver(repo, tmp_path / "one", "s3://runs/away")
    objects = open_objects("s3://runs/away")
    folder = tmp_path / "one" / "rollouts"
    until = time.monotonic() + 200
    while len(list(folder.rglob("manifest.json"))) < 2:
        assert time.monotonic() < until
        time.sleep(0.02)
    s3.cut()
    time.sleep(away_s)
    assert one.poll() is None
    assert len(list(folder.rglob("manifest.json"))) < 8
    s3.mend()
    assert one.wait(200) == 0
    index = Index(objects)
    index.load()
    assert len(index.keys) == 8
    execute_run(
        cheap_plan((0, 1)),
        tmp_path / "plain",
        1,
        ["simrun"],
        Announced(),
        certificate="none",
        report=False,
    )
    assert comparable(tmp_path / "one") == comparable(tmp_path / "plain")


@pytest.mark.slow
def test_a_store_that_stays_away_is_an_error_that_names_it(s3: Line) -> None:
    import fsspec

    system, root = fsspec.core.url_to_fs("s3://runs/gone", use_listings_cache=False)
    s3.cut()
    with pytest.raises(InfrastructureError, match="no answer for 1 s"):
        RemoteObjects(system, root, "s3://runs/gone", patience_s=1.0).read("a")


def test_a_node_fetches_a_content_once_and_refuses_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from alpasim_plugin.runs.executors.assignment import place

    monkeypatch.setenv("SIMRUN_CACHE", str(tmp_path))
    fetched = []

    def fetch(sha256: str) -> bytes:
        fetched.append(sha256)
        return b"weights"

    sha256 = hashlib.sha256(b"weights").hexdigest()
    node = Node("a", fetch)
    assert place(sha256, "w.bin", node) == place(sha256, "w.bin", node)
    assert place(sha256, "w.bin", node).read_bytes() == b"weights"
    assert fetched == [sha256]
    with pytest.raises(InfrastructureError, match="SHA-256"):
        place("0" * 64, "w.bin", node)
