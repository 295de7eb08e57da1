"""``simrun export --rrd``, read again by Rerun's own reader and compared with the rollout's log."""

from __future__ import annotations

import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.runs.recordings.content import distinct_labels
from tests.runs.conftest import Watched

NOT_HERE = "rerun-sdk is not installed (half a gigabyte, so not among the test dependencies): pip install rerun-sdk"
Columns = dict[
    str, list[tuple[int, Any]]
]  # component -> time in nanoseconds, value; time -1 where static


@pytest.fixture(scope="module")
def recorded(watched: Watched, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Columns]:
    """Return entity -> its columns, of a rollout named by its folder."""
    chunk = pytest.importorskip("rerun.chunk", reason=NOT_HERE)
    path = tmp_path_factory.mktemp("rrd") / "cell.rrd"
    rollout = watched.folder / "rollouts" / "clean" / "lane-camera" / "urban-left_turn" / "0"
    assert run_command(["export", str(rollout), "--rrd", str(path)]) == 0
    found: dict[str, Columns] = defaultdict(lambda: defaultdict(list))
    reader = chunk.RrdReader(str(path))
    assert len(reader.recordings()) == len(reader.blueprints()) == 1
    for one in reader.stream():
        batch = one.to_record_batch()
        assert set(one.timeline_names) <= {"t"}, "another time line"
        times = (
            batch.column("t").cast("int64").to_pylist()
            if "t" in batch.schema.names
            else [-1] * batch.num_rows
        )
        for name in batch.schema.names:
            if ":" in name:
                found[str(one.entity_path)][name] += [
                    (t, v)
                    for t, v in zip(times, batch.column(name).to_pylist(), strict=True)
                    if v is not None
                ]
    return {
        entity: {name: sorted(rows, key=lambda row: row[0]) for name, rows in columns.items()}
        for entity, columns in found.items()
    }


@pytest.mark.parametrize("renderer", ["clean", "3dgs"])
def test_what_is_recorded_is_what_the_log_holds(
    watched: Watched, recorded: dict[str, Columns], renderer: str
) -> None:
    log, base = watched.log(renderer), f"/world/{renderer}"
    for camera in ("front", "side"):
        own = recorded[f"{base}/rig/{camera}/image"]
        kept = [(1000 * image.end_us, image.data) for image in log.images if image.camera == camera]
        assert [(t, bytes(blob[0])) for t, blob in own["EncodedImage:blob"]] == kept
        assert {kind[0] for _, kind in own["EncodedImage:media_type"]} == {"image/png"}
        assert np.asarray(
            recorded[f"{base}/rig/{camera}"]["Pinhole:resolution"][0][1]
        ).tolist() == [[64.0, 36.0]]
    bodies = {f"{base}/ego": (log.ego, log.ego_box)}
    bodies |= {
        f"{base}/road\\ users/{name}": (actor.track, actor.box)
        for name, actor in log.actors.items()
    }
    for entity, (track, box) in bodies.items():
        moves = recorded[entity]["Transform3D:translation"]
        assert [t for t, _ in moves] == (1000 * track.t_us).tolist()
        assert np.allclose(
            [xyz[0] for _, xyz in moves], track.xyz, atol=1e-4
        )  # Rerun keeps float32
        turns = [xyzw[0] for _, xyzw in recorded[entity]["Transform3D:quaternion"]]
        assert np.allclose(turns, track.quat[:, [1, 2, 3, 0]], atol=1e-6)
        ((t, half),) = recorded[entity]["Boxes3D:half_sizes"]
        assert t == 1000 * track.t_us[0]
        assert np.allclose(half, [[box.length_m / 2, box.width_m / 2, box.height_m / 2]])
    plans = recorded[f"{base}/plan"]["LineStrips3D:strips"]
    assert [t for t, _ in plans] == [1000 * plan.now_us for plan in log.plans]
    for (_, strips), plan in zip(plans, log.plans, strict=True):
        assert np.allclose(strips[0], plan.trajectory.xyz, atol=1e-4)
        assert len(strips) == 1 + len(plan.samples)
    for name, rows in watched.metrics(renderer).items():
        held = recorded[f"/metrics/{name}/{renderer}"]["Scalars:scalars"]
        assert [(t // 1000, value[0]) for t, value in held] == rows, name


def test_the_map_and_the_driven_path_are_static(
    watched: Watched, recorded: dict[str, Columns]
) -> None:
    content = watched.run.scene_data("urban-left_turn")
    assert content is not None
    ((t, edges),) = recorded["/world/map/road\\ edge"]["LineStrips3D:strips"]
    assert t == -1
    assert np.allclose(np.asarray(edges[0])[:, :2], content["road_edges"][0], atol=1e-4)
    ((t, path),) = recorded["/world/clean/path"]["LineStrips3D:strips"]
    assert t == -1
    assert len(path[0]) == len(watched.log("clean").ego)


def test_without_the_library_it_is_said_how_to_get_it(
    watched: Watched,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert (
        run_command(
            ["export", str(watched.folder), "--seed", "0", "--rrd", str(tmp_path / "a.rrd")]
        )
        == 2
    )
    assert "pip install rerun-sdk" in capsys.readouterr().err
    assert not (tmp_path / "a.rrd").exists()


def test_labels_differ_where_names_do() -> None:
    assert distinct_labels(["a/b", "a:b", "onefixer@2+3dgs", "//"]) == [
        "a_b",
        "a_b-2",
        "onefixer@2+3dgs",
        "renderer",
    ]
