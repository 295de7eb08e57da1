"""Read what the comparison with published renders needs of a Cosmos-Drive-Dreams clip in RDS-HQ
form: painted lines, boundaries, crosswalks, poles, signs, ego poses, f-theta lenses.

Layout and facts: the public data set description of NVIDIA Cosmos-Drive-Dreams (arXiv 2506.09042);
data CC-BY-4.0, (c) NVIDIA. The world is the rig frame of frame 0.
"""

import io
import json
import tarfile

import numpy as np

from alpasim_plugin.core.types import Box, LaneMap, Marking
from tests.scenarios.ftheta_projection import lens_of

# Nominal mount of the front wide camera (camera to rig). The clip has no extrinsics. This is the
# calibration of another car of the same fleet; with it the clip's own map falls on the publisher's
# renders of this clip.
T_RIG_FRONT_WIDE = np.array(
    [
        [-0.0110549, -0.0181034, 0.9997750, 1.849283],
        [-0.9999387, 0.0007966, -0.0110423, -0.0541688],
        [-0.0005965, -0.9998358, -0.0181111, 1.3234164],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
UNPAINTED = ("VIRTUAL", "BARRIER", "ROAD_BOUNDARY", "CURB")


def members(folder):
    """Return the members of the folder's tar by name, in their order."""
    (path,) = folder.glob("*.tar")
    with tarfile.open(path) as archive:
        files = [info for info in archive if info.isfile()]
        return {info.name: archive.extractfile(info).read() for info in sorted(files, key=str)}


def read_poses(folder):
    """Return the pose of the rig in every frame, ``(T, 4, 4)``."""
    poses = members(folder / "vehicle_pose")
    return np.stack([np.load(io.BytesIO(poses[name])) for name in sorted(poses)])


def read_lenses(folder):
    """Return the lenses by camera."""
    return {
        name.rsplit(".", 2)[-2]: lens_of(np.load(io.BytesIO(data)))
        for name, data in members(folder / "ftheta_intrinsic").items()
    }


def read_layer(folder, layer):
    """Return attributes and first line ``(N, 3)`` of each label of a layer."""
    (data,) = members(folder / f"3d_{layer}").values()
    out = []
    for label in json.loads(data)["labels"]:
        if label.get("labelFamily") == "EMPTY":
            continue
        shape = label["labelData"]["shape3d"]
        kind = next(kind for kind in ("polyline3d", "surface", "cuboid3d") if kind in shape)
        out.append((str(shape.get("attributes")), np.array(shape[kind]["vertices"], dtype=float)))
    return out


def sign_pose(corners):
    """Return ``(T_world_sign (4, 4), size)`` of a cuboid ``(8, 3)``: x along its thinnest side, z
    as upright as it goes.

    Corners 0 to 3 go round one face and corner 4 lies opposite corner 0.
    """
    sides = corners[[1, 3, 4]] - corners[0]  # (3, 3) rows
    lengths = np.linalg.norm(sides, axis=1)
    axes = sides / lengths[:, None]
    up = int(np.argmax(np.abs(axes[:, 2])))
    thin, wide = sorted((i for i in range(3) if i != up), key=lambda i: lengths[i])
    z = axes[up] * np.copysign(1.0, axes[up, 2])
    x = axes[thin] - z * (axes[thin] @ z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3] = np.stack([x, np.cross(z, x), z, corners.mean(axis=0)], axis=1)
    return pose, Box(float(lengths[thin]), float(lengths[wide]), float(lengths[up]))


def read_map(folder):
    """Return the clip's map; its painted lines are solid, as they are published."""
    lines = [line for words, line in read_layer(folder, "lanelines")
             if not any(style in words for style in UNPAINTED)]  # fmt: skip
    layers = {
        name: [line for _, line in read_layer(folder, name)]
        for name in ("road_boundaries", "wait_lines", "crosswalks", "poles", "traffic_signs")
    }
    return LaneMap(
        lanes={},
        road_edges=tuple(layers["road_boundaries"]),
        crosswalks=tuple(np.concatenate([ring, ring[:1]]) for ring in layers["crosswalks"]),
        stop_lines=tuple(layers["wait_lines"]),  # published: implicit ones as well
        markings=tuple(Marking(line, "solid_white") for line in lines),
        poles=tuple(layers["poles"]),
        signs=tuple(map(sign_pose, layers["traffic_signs"])),
    )
