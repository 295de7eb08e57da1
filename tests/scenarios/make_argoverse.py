"""Writes small Argoverse 2 log folders: a straight road of two lanes, an ego at 10 m/s, a parked
and a crossing actor.
"""

import json

import numpy as np
import pyarrow as pa
from pyarrow import feather

ORIGIN = np.array([512_345.0, 5_412_678.0, 60.0])  # the city frame, UTM-sized on purpose
T0_NS = 315_966_253_572_412_942
STEP_NS = 100_000_000
POSE = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")


def poses(n=21, speed_mps=10.0):
    rows = {name: np.zeros(n) for name in POSE}
    rows["timestamp_ns"] = T0_NS + STEP_NS * np.arange(n)
    rows["qw"][:] = 1.0
    rows["tx_m"] = ORIGIN[0] + speed_mps * 0.1 * np.arange(n)
    rows["ty_m"][:] = ORIGIN[1]
    rows["tz_m"][:] = ORIGIN[2] + 0.33
    return rows


def cuboids(tracks, ego=None):
    """Tracks: (uuid, category, size, frame numbers, positions in the city); the frame is the
    unturned ego's.
    """
    ego = poses() if ego is None else ego
    rows = {
        name: []
        for name in (
            "timestamp_ns",
            "track_uuid",
            "category",
            "length_m",
            "width_m",
            "height_m",
            *POSE,
        )
    }
    for uuid, category, size, frames, xyz in tracks:
        for k, at in zip(frames, np.broadcast_to(xyz, (len(frames), 3)), strict=True):
            offset = at - [ego["tx_m"][k], ego["ty_m"][k], ego["tz_m"][k]]
            values = (ego["timestamp_ns"][k], uuid, category, *size, 1.0, 0.0, 0.0, 0.0, *offset)
            for name, value in zip(rows, values, strict=True):
                rows[name].append(value)
    return rows


def place(x, y, z):
    """Return a place of the local frame in the city."""
    return ORIGIN + np.array([x, y, z])


CAR = (4.5, 1.9, 1.5)
PERSON = (0.6, 0.6, 1.8)
TRACKS = (
    ("parked", "REGULAR_VEHICLE", CAR, range(21), place(30.0, -6.0, 0.75)),
    (
        "walker",
        "PEDESTRIAN",
        PERSON,
        range(5, 16),
        np.array([place(60.0, y, 0.9) for y in range(-5, 6)]),
    ),
)


def line(*points):
    return [{"x": p[0] + ORIGIN[0], "y": p[1] + ORIGIN[1], "z": ORIGIN[2]} for p in points]


def lane(lane_id, x0, x1, y, successors=(), **more):
    return {
        "id": lane_id,
        "is_intersection": False,
        "lane_type": "VEHICLE",
        "left_lane_boundary": line((x0, y + 2), (x1, y + 2)),
        "right_lane_boundary": line((x0, y - 2), (x1, y - 2)),
        "left_lane_mark_type": "DASHED_WHITE",
        "right_lane_mark_type": "SOLID_WHITE",
        "successors": list(successors),
        "predecessors": [],
        "left_neighbor_id": None,
        "right_neighbor_id": None,
    } | more


def vector_map():
    lanes = [
        lane(1, -20, 40, 0, successors=(2, 999)),
        lane(2, 40, 200, 0),
        lane(3, -20, 200, 4, lane_type="BIKE"),
    ]
    return {
        "lane_segments": {str(k["id"]): k for k in lanes},
        "drivable_areas": {
            "7": {"id": 7, "area_boundary": line((-20, -8), (90, -8), (90, 8), (-20, 8))},
            "8": {"id": 8, "area_boundary": line((90.02, -8), (200, -8), (200, 8), (90.02, 8))},
        },
        "pedestrian_crossings": {
            "9": {"id": 9, "edge1": line((58, -8), (58, 8)), "edge2": line((62, -8), (62, 8))}
        },
    }


def write_feather(path, rows):
    feather.write_feather(
        pa.table({k: pa.array(v) for k, v in rows.items()}), str(path), compression="uncompressed"
    )


def write_argoverse(folder, ego=None, annotations=None, document=None):
    """Write a complete log folder; parts given replace the defaults."""
    (folder / "map").mkdir(parents=True)
    write_feather(folder / "city_SE3_egovehicle.feather", poses() if ego is None else ego)
    write_feather(
        folder / "annotations.feather", cuboids(TRACKS) if annotations is None else annotations
    )
    (folder / "map" / "log_map_archive_x____PIT_city_1.json").write_text(
        json.dumps(vector_map() if document is None else document)
    )
    shift = (-ORIGIN[:2] + 100.0).tolist()
    (folder / "map" / "x___img_Sim2_city.json").write_text(
        json.dumps({"R": [1.0, 0.0, 0.0, 1.0], "t": shift, "s": 0.2})
    )
    raster = np.full((40, 64), ORIGIN[2], dtype=np.float16)
    raster[:5] = np.nan
    np.save(folder / "map" / "x_ground_height_surface____PIT.npy", raster)
    return folder
