"""A record of speed has every stage with its error, and ratios that are those of its times."""

import json

import pytest

from alpasim_plugin.lab.bench import loop as module
from alpasim_plugin.lab.bench.loop import STAGES, bench_loop, markdown


def test_a_record_has_stages_errors_commands_and_the_ratios_of_its_times(
    monkeypatch,
):
    monkeypatch.setattr(module, "COMMANDS", {"start": ("--version",)})
    monkeypatch.setattr(module, "SIZES", ((128, 72), (64, 36)))
    record = bench_loop(["clean"], repeats=1, seconds=0.5)
    assert json.loads(json.dumps(record)) == record
    (frame, small), (start,) = record["frames"], record["commands"]
    assert [frame["size"], small["size"]] == ["128x72", "64x36"]
    assert {"render", "policy", "control", "log"} <= set(frame["stages"]) <= set(STAGES)
    assert frame["ms"] == pytest.approx(sum(stage["ms"] for stage in frame["stages"].values()))
    assert frame["ratio"] == pytest.approx(frame["ms"] / record["reference_ms"])
    assert start["ratio"] == pytest.approx(1e3 * start["processor_s"] / record["reference_ms"])
    assert frame["psnr_db"] == 100  # the scene as built, against itself
    rows = [line.split("|") for line in markdown(record).splitlines() if line.startswith("|")]
    assert {len(row) for row in rows[:3]} == {len(rows[0])}
    assert [row[1].strip() for row in rows] == [
        "frame behind",
        "---",
        "`clean`",
        "`clean`",
        "command",
        "---",
        "start",
    ]
