"""Small valid files of every kind that a reader takes: what the fuzzer damages."""

from __future__ import annotations

import json
import random
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import yaml

from alpasim_plugin.core.config import load_yaml
from tests.core.checksum_files import vouch_for
from tests.fuzz.seen import compressed_ply, xodr

REPO = Path(__file__).resolve().parents[2]


def make_scene_file(name: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        merged = load_yaml(
            REPO / "scenarios" / name
        ).data  # what it extends does not lie beside the damaged file
        (folder / "scene.yaml").write_text(yaml.safe_dump(merged, sort_keys=False))

    return make


def make_background(folder: Path) -> None:
    from alpasim_plugin.gaussians import write_ply
    from tests.gaussians.test_coverage import ROAD, street

    (folder / "scene.yaml").write_text(ROAD + "background: {file: a.ply}\n")
    write_ply(folder / "a.ply", street(900))


def make_file(name: str, content: Callable[[], bytes]) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_bytes(content()) and None


RICH = """version: 1
seed: 3
description: everything at once
road:
  lanes_forward: 2
  segments: [{kind: straight, length_m: 120}, {kind: arc, length_m: 30, curvature_per_m: 0.01}, {kind: clothoid, length_m: 30}, {kind: straight, length_m: 80}]
ego: {lane: 0, speed_mps: 8, cruise_mps: 9, lane_changes: [{at_m: 20, to_lane: 1}]}
actors:
  - {kind: parked, id: a, s_m: 40, count: 2}
  - {kind: idm, id: b, s_m: 50, speed_mps: 9, lane: 1}
  - {kind: drive, id: c, s_m: 45, lane: 0, speeds: [[0, 9], [4, 9]]}
  - {kind: oncoming, id: d, s_m: 120, speed_mps: 9}
  - {kind: logged, id: e, points: [[0, 100, 40, 0], [4, 110, 40, 0]]}
timing: {duration_us: 2000000, warmup_us: 200000}
cameras: [{name: front, width: 64, height: 36}]
variations: {ego.cruise_mps: {low: 8, high: 10}}
samples: [{timing.warmup_us: 100000}]
"""


SUITE = """version: 1
description: two scenes
scenarios: [smoke/straight, {path: smoke/curve, seeds: [0, 3], set: {timing.warmup_us: 100000}}]
"""


def picture_bytes(form: str) -> bytes:
    import cv2

    done, data = cv2.imencode(form, np.arange(24 * 32 * 3, dtype=np.uint8).reshape(24, 32, 3))
    assert done
    return data.tobytes()


def make_usdz(folder: Path) -> None:
    from tests.scenarios import make_usdz

    make_usdz.write(folder / "scene.usdz")


def make_xodr(folder: Path) -> None:
    xodr("200", '<arc curvature="0.001"/>')(folder)


def make_argoverse(folder: Path) -> None:
    from tests.scenarios.make_argoverse import write_argoverse

    write_argoverse(folder / "log")


def make_commonroad(folder: Path) -> None:
    from tests.scenarios.make_commonroad import write_commonroad

    write_commonroad(folder / "scene.xml")


def make_cloud(writer: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        from alpasim_plugin.gaussians import write_ply
        from alpasim_plugin.gaussians.files.packed import write_splat
        from tests.gaussians.gaussian_scenes import random_cloud

        if writer == "ply":
            write_ply(folder / "a.ply", random_cloud(6, degree=1))
        elif writer == "splat":
            write_splat(folder / "a.splat", random_cloud(6, degree=0))
        elif writer == "spz":
            import gzip
            import struct

            head = struct.pack("<IIIBBBB", 0x5053474E, 2, 4, 0, 12, 0, 0)
            (folder / "a.spz").write_bytes(gzip.compress(head + random.Random(0).randbytes(4 * 20)))
        else:
            (folder / "a.ply").write_bytes(
                compressed_ply().replace(b"property float packed_", b"property uint packed_")
            )

    return make


def make_log(folder: Path) -> None:
    from alpasim_plugin.log import write_facts
    from tests.log.make_rollout import write_rollout

    write_rollout(folder / "rollout.asl")
    write_facts(folder / "frames.jsonl", [{"t_us": 100_000, "camera": "front", "alpha_mean": 0.5}])


def make_bundle(folder: Path) -> None:
    from safetensors.numpy import save

    settings = json.dumps({"name": "onefixer-tiny", "steps": [1000.0], "vae": {"kind": "tiny"}})
    tensors = {f"{part}.a": np.zeros((2, 3), np.float32) for part in ("dit", "vae")}
    (folder / "a.safetensors").write_bytes(
        save(tensors, {"format": "simrun-fixer-1", "settings": settings, "trained": "true"})
    )


def make_torch_weights(folder: Path) -> None:
    import torch

    torch.save(
        {"state_dict": {"net.a": torch.zeros(2, 3), "net.b": torch.ones(4)}}, folder / "a.pt"
    )


def make_video(folder: Path) -> None:
    from alpasim_plugin.log.video import write_mp4

    write_mp4(folder / "a.mp4", [np.full((32, 32, 3), 20 * i, np.uint8) for i in range(6)], 10)


def make_run(folder: Path) -> None:
    from tests.report.make_run import Plan, make_run

    vouch_for(
        make_run(
            folder / "run",
            Plan(scenes=("plain", "other"), seeds=(0, 1), steps=20, pictures=False, clips=False),
        )
    )


def make_baseline(folder: Path) -> None:
    from evaluators.opening import read_run
    from evaluators.statistics.baselines import write_baseline

    make_run(folder)
    write_baseline(read_run(folder / "run"), folder / "baseline.json")
    shutil.copy(REPO / "configs" / "gates" / "default.yaml", folder / "gate.yaml")


def make_views(folder: Path) -> None:
    (folder / "images").mkdir()
    (folder / "images" / "0.png").write_bytes(picture_bytes(".png"))
    frame = {"file_path": "images/0.png", "transform_matrix": np.eye(4).tolist(), "t_us": 0}
    lens = {"axes": "opencv", "w": 32, "h": 24, "fl_x": 30.0, "fl_y": 30.0, "cx": 16.0, "cy": 12.0}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": [frame]}))
