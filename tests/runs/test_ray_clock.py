"""A node of a Ray cluster whose clock is a day ahead; slow, like `test_ray.py`."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from alpasim_plugin.runs.executors.choice import Executor
from tests.runs.cluster_nodes import Nodes, on
from tests.runs.on_ray import run, scripted
from tests.runs.remote_work import Scripted
from tests.runs.test_runs import cheap_plan, comparable

pytest.importorskip("ray", reason="the extra [ray] is not installed")
pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]


@pytest.fixture(scope="module")
def three() -> Iterator[Nodes]:
    nodes = Nodes(3)
    yield nodes
    nodes.close()


AHEAD = """
#define _GNU_SOURCE
#include <dlfcn.h>
#include <sys/time.h>
#include <time.h>
int clock_gettime(clockid_t id, struct timespec *t) {
  int (*real)(clockid_t, struct timespec *) = dlsym(RTLD_NEXT, "clock_gettime");
  int code = real(id, t);
  if (id == CLOCK_REALTIME || id == CLOCK_REALTIME_COARSE) t->tv_sec += 86400;
  return code;
}
time_t time(time_t *out) { struct timespec t; clock_gettime(CLOCK_REALTIME, &t); if (out) *out = t.tv_sec; return t.tv_sec; }
int gettimeofday(struct timeval *t, void *zone) {
  struct timespec now; clock_gettime(CLOCK_REALTIME, &now); t->tv_sec = now.tv_sec; t->tv_usec = now.tv_nsec / 1000; return 0;
}
"""

BEGIN_AHEAD = """
import os, sys
if os.environ.get("LD_PRELOAD") != {library!r}:  # Ray takes the variable from its workers, so each begins again with it
    os.environ["LD_PRELOAD"] = {library!r}
    os.execv(sys.executable, sys.orig_argv)
"""


@pytest.mark.skipif(
    shutil.which("gcc") is None, reason="needs a C compiler to put a node's clock ahead"
)
def test_a_node_whose_clock_is_a_day_ahead_gives_the_same_run(tmp_path: Path, three: Nodes) -> None:
    (tmp_path / "ahead.c").write_text(AHEAD)
    library = tmp_path / "ahead.so"
    subprocess.run(
        ["gcc", "-shared", "-fPIC", "-o", str(library), str(tmp_path / "ahead.c"), "-ldl"],
        check=True,
    )
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(BEGIN_AHEAD.format(library=str(library)))
    ahead = three.add(
        env_vars={"PYTHONPATH": f"{tmp_path / 'site'}:{os.environ.get('PYTHONPATH', '')}"}
    )
    (tmp_path / "notes").mkdir()
    scripted(three, Scripted(tmp_path / "notes"), [f"sleep 0.5 #{i}" for i in range(24)])
    _, announced = run(cheap_plan((0, 1)), tmp_path / "run", on(three))
    three.cluster.remove_node(ahead)
    days = dict(note.read_text().split() for note in (tmp_path / "notes").iterdir())
    assert int(days.pop(next(name for name in days if ahead.node_id[:8] in name))) > max(
        map(int, days.values())
    )
    assert announced.results == [("ok", False)] * 8
    run(cheap_plan((0, 1)), tmp_path / "here", Executor())
    assert comparable(tmp_path / "run") == comparable(tmp_path / "here")
    _, again = run(cheap_plan((0, 1)), tmp_path / "run", Executor())
    assert again.results == [("ok", True)] * 8
