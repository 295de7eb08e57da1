"""Write small AlpaSim scenes: two straight lanes along x, one parked and one moving track."""

import io
import json
import zipfile

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import yaml

START_US = 1_689_697_803_493_732
LANE_M = 3.6


def rail(y, n=5, as_struct=False):
    xs = np.linspace(-20.0, 100.0, n)
    if as_struct:
        return {"x": xs.tolist(), "y": [y] * n, "z": [0.0] * n}
    return [{"x": float(x), "y": y, "z": 0.0} for x in xs]


def parquet(rows):
    sink = io.BytesIO()
    pq.write_table(pa.Table.from_pylist(rows), sink)
    return sink.getvalue()


def key(name, **more):
    return {"clip_id": "c", "map_id": name, **more}


def tables(as_struct=False):
    def lane(i, y):
        left, right = (rail(y + side * LANE_M / 2, as_struct=as_struct) for side in (1, -1))
        return {"key": key(f"L{i}"), "lane": {"left_rail": left, "right_rail": right}}

    lanes = [lane(i, y) for i, y in enumerate((0.0, LANE_M))]
    links = [
        {"key": key("a", kind="LEFT_LANE"), "association": {"subjects": "L0", "objects": ["L1"]}}
    ]
    edges = [
        {"key": key(f"E{i}"), "road_boundary": {"location": rail(y)}}
        for i, y in enumerate((-LANE_M / 2, 1.5 * LANE_M))
    ]
    sign = [
        {
            "key": key("s"),
            "traffic_sign": {"center": {"x": 50.0, "y": -3.0, "z": 2.0}, "category": "STOP"},
        }
    ]
    wait = [
        {
            "key": key("w-L0"),
            "wait_line": {"location": rail(0.0, 2), "category": "STOP", "is_implicit": False},
        }
    ]
    rows = {
        "lane": lanes,
        "association": links,
        "road_boundary": edges,
        "clip": [{"key": key("c")}],
        "traffic_sign": sign,
        "wait_line": wait,
    }
    return {f"clipgt/{name}.parquet": parquet(table) for name, table in rows.items()}


def rig(n=60, **more):
    t_us = [START_US + 100_000 * i for i in range(n)]
    poses = [
        [[1.0, 0, 0, 8.0 * 0.1 * i], [0, 1.0, 0, 0.0], [0, 0, 1.0, 0.0], [0, 0, 0, 1.0]]
        for i in range(n)
    ]
    box = {"centroid": [1.4, 0.0, 0.75], "dim": [4.6, 1.9, 1.5], "rot": [0, 0, 0]}
    own = {
        "sequence_id": "s",
        "T_rig_world_timestamps_us": t_us,
        "T_rig_worlds": poses,
        "rig_bbox": box,
    }
    return {"T_world_base": np.eye(4).tolist(), "rig_trajectories": [own]} | more


def sequence():
    t_us = [START_US, START_US + 4_000_000]
    parked = [[40.0, LANE_M, 0.75, 0, 0, 0, 1.0], [40.0, LANE_M, 0.75, 0, 0, 0, 1.0]]
    moving = [
        [20.0, 0.0, 0.75, 0, 0, 0, 1.0],
        [60.0, 0.0, 0.75, 0, 0, 1.0, 0.0],
    ]  # turns to face back
    tracks = {
        "tracks_id": ["p", "m"],
        "tracks_label_class": ["heavy_truck", "person"],
        "tracks_flags": [[], ["CONTROLLABLE"]],
        "tracks_timestamps_us": [t_us, t_us],
        "tracks_poses": [parked, moving],
    }
    return {
        "s": {
            "tracks_data": tracks,
            "cuboidtracks_data": {"cuboids_dims": [[8.0, 2.5, 3.0], [0.6, 0.6, 1.8]]},
        }
    }


def members(scene_id="small"):
    meta = {"scene_id": scene_id, "version_string": "1", "sensors": {"camera_ids": []}}
    return {
        "metadata.yaml": yaml.safe_dump(meta).encode(),
        "rig_trajectories.json": json.dumps(rig()).encode(),
        "sequence_tracks.json": json.dumps(sequence()).encode(),
        **tables(),
    }


def write(path, content=None):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as z:
        for name, data in (members() if content is None else content).items():
            z.writestr(name, data)
    return path
