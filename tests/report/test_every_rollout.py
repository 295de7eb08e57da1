"""The block of every rollout: what is packed is what the tables say, and it stays small."""

from __future__ import annotations

import base64
import dataclasses
import gzip
import json
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pytest

from evaluators.opening import Run, read_run
from evaluators.report import rollouts
from evaluators.report.rollouts import (
    COLLIDED,
    FAILED,
    HAS_CLIP,
    HAS_FOLDER,
    OTHERWISE,
    rollout_block,
)

TYPES = {"u8": "<u1", "u32": "<u4", "f32": "<f4"}


def unpacked(data: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read a block as the page's script does, plainly."""
    plain = gzip.decompress(base64.b64decode(data))
    size = int.from_bytes(plain[:4], "little")
    header = json.loads(plain[4 : 4 + size])
    at = 4 + size
    found = {}
    for column in header["columns"]:
        kind = np.dtype(TYPES[column["type"]])
        n = header["rows"]
        planes = np.frombuffer(plain, np.uint8, n * kind.itemsize, at).reshape(kind.itemsize, n)
        values = np.ascontiguousarray(planes.T).reshape(-1).view(kind)
        found[column["name"]] = (
            [column["values"][code] for code in values] if "values" in column else values
        )
        at += n * kind.itemsize
    assert at == len(plain)
    return header, found


@pytest.fixture(scope="module")
def run(usual_run: Path) -> Run:
    return read_run(usual_run)


def test_every_row_and_number_of_the_table_is_in_the_block(run: Run) -> None:
    header, found = unpacked(rollout_block(run).data)
    assert header["rows"] == len(run.rollouts)
    assert header["renderers"] == run.renderers
    for i, rollout in enumerate(run.rollouts):
        assert (
            found["renderer"][i],
            found["policy"][i],
            found["scene"][i],
            int(found["seed"][i]),
        ) == rollout.cell
        assert f"{unquote(found['folder'][i])}/{unquote(found['leaf'][i])}" == rollout.path
        state = int(found["state"][i])
        assert bool(state & FAILED) is not rollout.ok
        assert bool(state & COLLIDED) is (rollout.ok and rollout.flag("collision_any"))
        assert bool(state & OTHERWISE) is (rollout.ok and rollout.flag("offroad"))
        assert bool(state & HAS_FOLDER) is (run.folder / rollout.path).is_dir()
        assert (
            (rollout.failure_class in found["failure"][i])
            if not rollout.ok
            else found["failure"][i] == ""
        )
    for name in run.metric_names:
        exact = np.array(
            [np.nan if (v := r.metrics.get(name)) is None else v for r in run.rollouts]
        )
        np.testing.assert_allclose(found[name], exact, rtol=2.0**-13, atol=0, equal_nan=True)


def test_clips_are_linked_where_the_run_made_them(run: Run) -> None:
    _, without = unpacked(rollout_block(run).data)
    info = {**run.info, "config": {**run.info["config"], "video": "all"}}
    _, found = unpacked(rollout_block(dataclasses.replace(run, info=info)).data)
    for i, rollout in enumerate(run.rollouts):
        assert (
            bool(found["state"][i] & HAS_CLIP)
            is (run.folder / rollout.path / "front.mp4").is_file()
        )
    assert (run.info["config"].get("video") or "none") != "none" or not any(
        state & HAS_CLIP for state in without["state"]
    )


def test_a_folder_outside_the_run_is_not_linked(run: Run, tmp_path: Path) -> None:
    (tmp_path / "0").mkdir()
    outside = tuple(
        dataclasses.replace(r, path=f"../{'../' * len(run.folder.parts)}{tmp_path}/0")
        for r in run.rollouts
    )
    _, found = unpacked(rollout_block(dataclasses.replace(run, rollouts=outside)).data)
    assert not any(state & HAS_FOLDER for state in found["state"])


def test_more_rollouts_than_a_page_can_hold_are_counted(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rollouts, "MAX_ROLLOUTS", 5)
    block = rollout_block(run)
    assert (block.shown, block.left_out) == (5, len(run.rollouts) - 5)
    assert unpacked(block.data)[0]["rows"] == 5
