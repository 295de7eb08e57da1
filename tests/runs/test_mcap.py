"""``simrun export --mcap``, read again by the format's own library and compared with the rollout's
log.
"""

import base64
import json
import shutil
import sys
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.geometry import inverse, offset_trajectory
from alpasim_plugin.core.types import LensModel
from alpasim_plugin.log.asl import AslReader
from alpasim_plugin.runs.recordings import _camera_items
from evaluators.pages.images import Source
from tests.core.checksum_files import vouch_for

mcap_reader = pytest.importorskip("mcap.reader", reason="mcap is not installed: pip install mcap")
CELL = ("--scene", "urban-left_turn", "--policy", "lane-camera", "--seed", "0")
Messages = dict[str, list[tuple[int, dict[str, Any]]]]  # topic -> time in nanoseconds, message


def read(path):
    """Return messages, topic -> schema, and the metadata, after the reader has checked every
    CRC.
    """
    found = defaultdict(list)
    schemas = {}
    before = 0
    with path.open("rb") as stream:
        reader = mcap_reader.make_reader(stream, validate_crcs=True)
        (metadata,) = reader.iter_metadata()
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            assert message.log_time >= before, "not in order of time"
            before = message.log_time
            body = json.loads(message.data)
            assert set(body) <= set(json.loads(schema.data)["properties"])
            schemas[channel.topic] = schema.name
            found[channel.topic].append((message.log_time, body))
        summary = reader.get_summary()
        assert summary.statistics.message_count == sum(map(len, found.values()))
    return dict(found), schemas, metadata.metadata


@pytest.fixture(scope="module")
def recorded(watched, tmp_path_factory):
    path = tmp_path_factory.mktemp("mcap") / "cell.mcap"
    assert run_command(["export", str(watched.folder), *CELL, "--mcap", str(path)]) == 0
    return read(path)


def xyz(point):
    return [point["x"], point["y"], point["z"]]


def nanoseconds(time):
    return time["sec"] * 10**9 + time["nsec"]


def test_channels_have_foxgloves_schemas(
    recorded,
):
    _, schemas, metadata = recorded
    own = {
        "boxes": "SceneUpdate",
        "path": "SceneUpdate",
        "plan": "SceneUpdate",
        "front": "CompressedImage",
        "side": "CompressedImage",
    }
    own |= {f"{camera}/calibration": "CameraCalibration" for camera in ("front", "side")}
    wanted = {
        f"/{r}/{name}": f"foxglove.{schema}"
        for r in ("clean", "3dgs")
        for name, schema in own.items()
    }
    wanted |= {f"/{r}/metrics": "simrun.Metrics" for r in ("clean", "3dgs")} | {
        "/map": "foxglove.SceneUpdate",
        "/tf": "foxglove.FrameTransform",
    }
    assert {
        topic: name for topic, name in schemas.items() if not topic.endswith("/events")
    } == wanted
    assert (metadata["scene"], metadata["policy"], metadata["seed"]) == (
        "urban-left_turn",
        "lane-camera",
        "0",
    )


@pytest.mark.parametrize("renderer", ["clean", "3dgs"])
def test_what_is_recorded_is_what_the_log_holds(watched, recorded, renderer):
    found = recorded[0]
    log = watched.log(renderer)
    for camera in ("front", "side"):
        kept = [(1000 * image.end_us, image.data) for image in log.images if image.camera == camera]
        assert [
            (t, base64.b64decode(body["data"])) for t, body in found[f"/{renderer}/{camera}"]
        ] == kept
        assert {body["format"] for _, body in found[f"/{renderer}/{camera}"]} == {"png"}
    boxes = found[f"/{renderer}/boxes"]
    assert [t for t, _ in boxes] == (1000 * log.ego.t_us).tolist()
    for k, (t, body) in enumerate(boxes):
        assert nanoseconds(body["entities"][0]["timestamp"]) == t
        cubes = {one["id"]: one["cubes"][0] for one in body["entities"]}
        assert set(cubes) == {"ego", *(f"user {name}" for name in log.actors)}
        assert xyz(cubes["ego"]["pose"]["position"]) == log.ego.xyz[k].tolist()
        assert xyz(cubes["ego"]["size"]) == [
            log.ego_box.length_m,
            log.ego_box.width_m,
            log.ego_box.height_m,
        ]
        for name, actor in log.actors.items():
            turn = cubes[f"user {name}"]["pose"]["orientation"]
            assert [turn[axis] for axis in "wxyz"] == actor.track.quat[k].tolist()
    rig = offset_trajectory(log.ego, inverse(log.T_rig_box))
    moves = [
        xyz(body["translation"])
        for _, body in found["/tf"]
        if body["child_frame_id"] == f"{renderer}/rig"
    ]
    assert np.allclose(moves, rig.xyz, atol=1e-12)
    plans = found[f"/{renderer}/plan"]
    assert [t for t, _ in plans] == [1000 * plan.now_us for plan in log.plans]
    for (_, body), plan in zip(plans, log.plans, strict=True):
        lines = body["entities"][0]["lines"]
        assert [xyz(point) for point in lines[0]["points"]] == plan.trajectory.xyz.tolist()
        assert len(lines) == 1 + len(plan.samples)
    ((_, path),) = found[f"/{renderer}/path"]
    assert np.allclose(
        [xyz(point) for point in path["entities"][0]["lines"][0]["points"]], rig.xyz, atol=1e-12
    )


@pytest.mark.parametrize(
    ("lens", "stated"),
    [
        (None, ("", [])),
        (
            LensModel("opencv", (-0.3, 0.1, 0.01, 0.02, 0.05)),
            ("rational_polynomial", [-0.3, 0.1, 0.01, 0.02, 0.05, 0, 0, 0]),
        ),
        (LensModel("fisheye", (0.1, 0.2)), ("kannala_brandt", [0.1, 0.2, 0, 0])),
        (LensModel("fisheye", (0.1, 0.2, 0.3, 0.4, 0.5)), None),
        (LensModel("opencv", (0.1, *[0.0] * 7, 0.1)), None),
        (LensModel("ftheta", (0.0, 90.0)), None),
    ],
)
def test_a_calibration_states_its_lens_or_there_is_none(watched, lens, stated):
    log = watched.log("clean")
    camera = replace(log.info["cameras"][0], lens=lens)
    described = replace(log, info=log.info | {"cameras": (camera,)})
    items = _camera_items(Source(camera.name, ()), described, "clean")
    calibrations = [body for _, topic, _, body in items if topic.endswith("/calibration")]
    models = [(body["distortion_model"], body["D"]) for body in calibrations]
    assert models == ([] if stated is None else [stated])


def test_metrics_have_the_values_of_the_table_and_none_where_they_are_not_valid(watched, recorded):
    series = defaultdict(list)
    for t, body in recorded[0]["/clean/metrics"]:
        for name, value in body.items():
            if name != "timestamp":
                series[name].append((t // 1000, value))
    assert dict(series) == watched.metrics("clean")
    assert "lateral_bias_m" in series
    assert "min_distance_to_obstacle_m" not in series  # never valid in this scene


def test_a_failed_rollout_and_missing_frames_are_said(watched, tmp_path, capsys):
    folder = Path(shutil.copytree(watched.folder, tmp_path / "run"))
    log = folder / "rollouts" / "clean" / "lane-camera" / "urban-left_turn" / "1" / "rollout.asl"
    log.write_bytes(without_images(log))
    vouch_for(folder)
    assert (
        run_command(
            ["export", str(folder), "--seed", "1", "--mcap", str(tmp_path / "a.mcap"), "--json"]
        )
        == 0
    )
    printed = json.loads(capsys.readouterr().out)
    assert [note.split(":")[0] for note in printed["notes"]] == ["3dgs", "clean"]
    assert set(read(tmp_path / "a.mcap")[0]) == {
        "/map",
        "/tf",
        "/clean/boxes",
        "/clean/path",
        "/clean/plan",
        "/clean/metrics",
    }


def without_images(log):
    """Return a log's bytes without its camera frames."""
    kept = [
        entry.SerializeToString()
        for entry in AslReader(log)
        if entry.WhichOneof("log_entry") != "driver_camera_image"
    ]
    return b"".join(len(entry).to_bytes(4, "big") + entry for entry in kept)


def test_refusals(
    watched,
    tmp_path,
    monkeypatch,
):
    run = str(watched.folder)
    out = tmp_path / "a.mcap"
    (tmp_path / "there.mcap").touch()
    rollout = f"{run}/rollouts/clean/lane-camera/urban-left_turn/0"
    for words in (
        ("export", run, "--mcap", str(out)),
        ("export", run, *CELL),
        ("export", run, *CELL, "--mcap", str(tmp_path / "there.mcap")),
        ("export", run, "--alpasim", str(tmp_path), "--mcap", str(out)),
        ("export", run, "--alpasim", str(tmp_path / "x"), "--seed", "0"),
        ("export", str(tmp_path), "--mcap", str(out)),
        ("export", run, "--seed", "1", "--renderer", "3dgs", "--mcap", str(out)),
        ("export", run, rollout, "--mcap", str(out)),
    ):
        assert run_command([*words]) == 2
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    assert run_command(["export", run, *CELL, "--mcap", str(out)]) == 2
    assert not out.exists()
