"""Which run is meant where none is named."""

import os

from alpasim_plugin.cli.options import run_or_newest
from alpasim_plugin.log.run_folder.manifests import write_run_json
from alpasim_plugin.log.run_folder.schema import RUN_INFO
from tests.run_records import run_info

MEMBERS = {
    "key": "k",
    "content": "c",
    "command": ["simrun"],
    "preset": "strict",
    "renderers": ["clean"],
    "policies": ["p"],
    "seeds": [0],
    "scenes": {},
    "version": "0",
}
HOUR_NS = 3_600_000_000_000


def written(folder):
    folder.mkdir(parents=True, exist_ok=True)
    write_run_json(folder, run_info(MEMBERS))
    return folder


def test_the_run_that_was_begun_last_is_the_newest_though_the_clock_was_set_back(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    first = written(tmp_path / "runs" / "first")
    late_ns = (first / RUN_INFO).stat().st_mtime_ns + HOUR_NS
    os.utime(first / RUN_INFO, ns=(late_ns, late_ns))
    second = written(tmp_path / "runs" / "second")
    assert run_or_newest(None).name == second.name
    assert written(first).name == run_or_newest(None).name
