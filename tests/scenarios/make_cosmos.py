"""Writes small Cosmos-Drive-Dreams clips: two lanes one behind the other, a shoulder, and a
straight drive of 31 poses.
"""

from __future__ import annotations

import io
import json
import tarfile

import numpy as np

CLIP = "0-clip_1000000_2000000"
WIDE = [960.0, 740.0, 1920.0, 1080.0, 0.0, 1.0576e-3, 8.2e-9, -3.4e-11, 8.1e-14, -2.9e-17, 1.0]


def label(feature_id, shape, **attributes):
    def packed(name, value):
        if isinstance(value, list):
            kind = "textList" if name.endswith("_ids") else "enumsList"
            return {"name": name, kind: {kind: value} if value else {}}
        return {
            "name": name,
            "flag"
            if isinstance(value, bool)
            else "numerical"
            if isinstance(value, float)
            else "text": value,
        }

    rows = [packed(k, v) for k, v in {"feature_id": feature_id, **attributes}.items()]
    return {
        "labelFamily": "SHAPE3D",
        "labelData": {"shape3d": {"attributes": rows, "unit": "METRIC", **shape}},
    }


def polyline(*points):
    return {"polyline3d": {"vertices": [list(p) for p in points]}}


def lane(feature_id, x0, x1, y, following=(), turned=False, swapped=False, **more):
    left, right = (
        [(x0, y + w, 0.0), ((x0 + x1) / 2, y + w, 0.0), (x1, y + w, 0.0)] for w in (2, -2)
    )
    if turned:
        left, right = left[::-1], right[::-1]
    edges = [right, left] if swapped else [left, right]
    attributes = {
        "next_lane_ids": list(following),
        "left_lane_id": "-1",
        "right_lane_id": "-1",
        "speed_limit": 65.0,
        "use_types": [],
        "lane_direction": "STRAIGHT",
        "left_edge_styles": ["SOLID_SINGLE"] * 3,
        "left_edge_colors": ["YELLOW"] * 3,
        "right_edge_styles": ["LONG_DASHED_SINGLE"] * 3,
        "right_edge_colors": ["WHITE"] * 3,
    }
    return label(
        feature_id,
        {"polylines3d": {"polylines": [{"vertices": [list(p) for p in e]} for e in edges]}},
        **(attributes | more),
    )


def cuboid(centre, thin, wide, high):
    a, b, c = np.diag([thin, wide, high]) / 2
    corners = [
        -a - b - c,
        -a + b - c,
        a + b - c,
        a - b - c,
        -a - b + c,
        -a + b + c,
        a + b + c,
        a - b + c,
    ]
    return {"cuboid3d": {"vertices": (np.array(corners) + centre).tolist()}}


def layers():
    empty = {"labelFamily": "EMPTY", "labelData": {"emptyLabel": True}}
    line = {"styles": ["SHORT_DASHED_SINGLE"] * 2, "colors": ["WHITE"] * 2}
    square = [[60.0, -4.0, 0.0], [64.0, -4.0, 0.0], [64.0, 4.0, 0.0], [60.0, 4.0, 0.0]]
    return {
        "3d_lanes": [
            lane("1", -20, 50, 0, ("2",)),
            lane("2", 50, 200, 0),
            lane("3", -20, 200, -4, use_types=["SHOULDER_LANE"]),
        ],
        "3d_lanelines": [label("10", polyline((-20, -2, 0), (200, -2, 0)), **line)],
        "3d_road_boundaries": [
            label("20", polyline((-20, -6, 0), (200, -6, 0))),
            label("21", polyline((-20, 2, 0), (200, 2, 0))),
        ],
        "3d_wait_lines": [
            label("30", polyline((58, -2, 0), (58, 2, 0)), is_implicit=False),
            label("31", polyline((90, -2, 0), (90, 2, 0)), is_implicit=True),
        ],
        "3d_crosswalks": [label("40", {"surface": {"vertices": square}})],
        "3d_poles": [label("50", polyline((30, -9, 0), (30, -9, 6)))],
        "3d_traffic_signs": [label("60", cuboid((30.0, -9.0, 3.0), 0.01, 0.7, 0.9)), empty],
    }


def poses(n=31):
    matrices = np.repeat(np.eye(4, dtype=np.float32)[None], n, axis=0)
    matrices[:, 0, 3] = np.arange(n) / 3  # 10 m/s
    return matrices


def npy(array):
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def write_tar(folder, members):
    folder.mkdir(parents=True)
    with tarfile.open(folder / f"{CLIP}.tar", "w") as archive:
        for name, data in members.items():
            info = tarfile.TarInfo(name)
            info.size = len(data)
            archive.addfile(info, io.BytesIO(data))


def write_cosmos(folder, matrices=None, lens=WIDE, **changed):
    """Write a complete clip; layers given replace the defaults, matrices and lens likewise."""
    for name, labels in (layers() | changed).items():
        write_tar(
            folder / name, {f"{CLIP}.{name[3:]}.json": json.dumps({"labels": labels}).encode()}
        )
    matrices = poses() if matrices is None else matrices
    frames = matrices if isinstance(matrices, dict) else dict(enumerate(matrices))
    write_tar(
        folder / "vehicle_pose",
        {f"{CLIP}.{i:06d}.vehicle_pose.npy": npy(m) for i, m in frames.items()},
    )
    write_tar(
        folder / "ftheta_intrinsic",
        {f"{CLIP}.ftheta_intrinsic.camera_front_wide_120fov.npy": npy(np.array(lens))},
    )
    return folder
