"""Read Cosmos-Drive-Dreams clips in RDS-HQ form: lane map, ego poses, f-theta calibration.

Layout and facts: the public data set description of NVIDIA Cosmos-Drive-Dreams (arXiv 2506.09042);
data CC-BY-4.0, (c) NVIDIA. The world is the rig frame of frame 0.
"""

from __future__ import annotations

import io
import re
import tarfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import (
    centre_line,
    densify,
    quat_from_matrix,
    wrap_angle,
    yaw_from_quat,
)
from alpasim_plugin.core.lane_areas import lane_polygon
from alpasim_plugin.core.reading import parse_json
from alpasim_plugin.core.reading.arrays import parse_npy
from alpasim_plugin.core.types import F64, Box, Lane, LaneMap, Marking, Vehicle
from alpasim_plugin.world.ground import from_points
from scenarios.ftheta import FRONT_WIDE, front_camera
from scenarios.map_lines import is_left_of, lane_edges
from scenarios.recorded import RecordedLog, SourceFiles, checked_trajectory, near
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


def read_tar(files, path):
    """Read the regular files of an uncompressed tar, by member name."""
    members = {}
    with tarfile.open(fileobj=io.BytesIO(files.read_bytes(path)), mode="r:") as archive:
        for info in archive:
            handle = archive.extractfile(info)
            if handle is not None:
                members[info.name] = handle.read()
    return members


def read_lenses(files, folder):
    """Read ``ftheta_intrinsic``: one array of 11 numbers a camera.

    Layout: cx, cy, width, height, six coefficients from the constant upwards, and a flag: 1 where
        they map pixel radius to angle, 0 where
    they map angle to radius.

    Raises:
        InputError: The tar is missing or damaged, or an array is not a lens.
    """
    path = files.only(folder / "ftheta_intrinsic", ("*.tar",), "the f-theta intrinsics")
    lenses = {}
    for name, data in read_tar(files, path).items():
        if not name.endswith(".npy"):
            continue
        where = f"{path}, {name}"
        values = np.asarray(parse_npy(data, where), dtype=np.float64)
        if (
            values.shape != (11,)
            or not np.isfinite(values).all()
            or values[2] < 1
            or values[3] < 1
            or values[10] not in (0.0, 1.0)
        ):
            found = f"an array of shape {values.shape} that is not an f-theta lens"
            raise InputError(
                f"{where}: {found}", "give cx, cy, width, height, 6 coefficients, flag"
            )
        lenses[name.rsplit(".", 2)[-2]] = lens_of(values)
    return lenses


@dataclass(frozen=True)
class Label:
    """One map feature: its attributes and its polylines, surface or cuboid."""

    where: str  # file and feature, for messages
    attributes: dict[str, Any]
    lines: tuple[
        F64, ...
    ]  # each (N, 3) metres, world; one for a polyline or surface, the eight corners for a cuboid

    @property
    def feature_id(self):
        """Return the id other features refer to."""
        return str(self.attributes.get("feature_id"))

    def ids(self, name):
        """Return a list attribute of ids; empty where the map gives none."""
        value = self.attributes.get(name)
        return tuple(str(v) for v in value if str(v) != "-1") if isinstance(value, list) else ()

    def one_id(self, name):
        """Return a single id; the text -1 means none."""
        value = self.attributes.get(name)
        return (
            None if value is None or isinstance(value, list) or str(value) == "-1" else str(value)
        )


def read_layer(files, folder, layer):
    """Read one layer folder, such as ``3d_lanes``; labels marked empty are left out.

    Raises:
        InputError: The folder, its tar or its JSON is missing or damaged, or a feature has no
            finite geometry.
    """
    path = files.only(folder / layer, ("*.tar",), f"layer {layer}")
    members = {name: data for name, data in read_tar(files, path).items() if name.endswith(".json")}
    if len(members) != 1:
        raise InputError(f"{path}: {len(members)} JSON members", "give a tar with one JSON member")
    name, data = next(iter(members.items()))
    document = parse_json(data, f"{path}, {name}")
    labels = document.get("labels") if isinstance(document, dict) else None
    if not isinstance(labels, list):
        raise InputError(f"{path}, {name}: no list 'labels'", "use a file of the RDS-HQ layout")
    out = []
    for number, raw in enumerate(labels):
        where = f"{path}, label {number}"
        if isinstance(raw, dict) and raw.get("labelFamily") == "EMPTY":
            continue
        try:
            shape = raw["labelData"]["shape3d"]
            attributes = {a["name"]: _value(a) for a in shape.get("attributes", ())}
            lines = tuple(np.array(v, dtype=np.float64).reshape(-1, 3) for v in _vertices(shape))
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                f"{where}: no readable shape: {error!r}", "use a file of the RDS-HQ layout"
            ) from error
        if not lines or any(len(line) == 0 or not np.isfinite(line).all() for line in lines):
            raise InputError(
                f"{where}: a shape without finite vertices", "repair or drop this label"
            )
        for line in lines:
            near(where, line)
        out.append(Label(where, attributes, lines))
    return tuple(out)


def _value(attribute):
    """Unpack an attribute: ``{"name": ..., KIND: value}``, where lists come one level deeper and
    may be absent when empty.
    """
    values = [v for k, v in attribute.items() if k != "name"]
    if not values:
        return None
    value = values[0]
    return next(iter(value.values()), []) if isinstance(value, dict) else value


def _vertices(shape):
    if "polylines3d" in shape:
        return [line["vertices"] for line in shape["polylines3d"]["polylines"]]
    for kind in ("polyline3d", "surface", "cuboid3d"):
        if kind in shape:
            return [shape[kind]["vertices"]]
    raise KeyError("polylines3d, polyline3d, surface or cuboid3d")


def paint_of(styles, colours):
    """Return the paint of a line from its styles and colours a vertex; the most frequent pair
    decides.

    Kerbs, barriers, virtual lines and road boundaries carry no paint.
    """
    if not isinstance(styles, list) or not styles:
        return "unknown"
    given = (
        colours
        if isinstance(colours, list) and len(colours) == len(styles)
        else ["UNKNOWN"] * len(styles)
    )
    style, colour = Counter(zip(styles, given, strict=True)).most_common(1)[0][0]
    yellow = colour == "YELLOW"
    if style in ("VIRTUAL", "BARRIER", "ROAD_BOUNDARY") or "CURB" in style:
        return "none"
    if colour not in ("YELLOW", "WHITE"):
        return "unknown"
    if "GROUP" in style:
        return "double_yellow" if yellow else "solid_white" if "SOLID" in style else "dashed_white"
    if "DASHED" in style:
        return "dashed_yellow" if yellow else "dashed_white"
    if "SOLID" in style:
        return "solid_yellow" if yellow else "solid_white"
    return "unknown"


def sign_pose(corners):
    """Return ``(T_world_sign (4, 4), size)`` of a cuboid ``(8, 3)``: x along its thinnest side, z
    as upright as it goes.

    Corners 0 to 3 go round one face and corner 4 lies opposite corner 0.
    """
    sides = corners[[1, 3, 4]] - corners[0]  # (3, 3) rows
    lengths = np.linalg.norm(sides, axis=1)
    axes = sides / np.maximum(lengths, 1e-9)[:, None]
    up = int(np.argmax(np.abs(axes[:, 2])))
    thin, wide = sorted((i for i in range(3) if i != up), key=lambda i: lengths[i])
    z = axes[up] * np.copysign(1.0, axes[up, 2])
    x = axes[thin] - z * (axes[thin] @ z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = x, np.cross(z, x), z, corners.mean(axis=0)
    return pose, Box(float(lengths[thin]), float(lengths[wide]), float(lengths[up]))


MPH = 0.44704  # m/s


def oriented_lanes(files, labels, ego_log):
    """Make lanes with edges in driving direction, left edge left.

    A lane runs towards the lanes named by its ``next_lane_ids``: the end of its edges that lies
    nearer to them is its end. A lane without links takes the direction of the ego that drove in it,
    else the order of its points. Left and right then follow from the turn of the ring.

    Raises:
        InputError: A lane has not exactly two edges, or two lanes share an id.
    """
    raw = {}
    for label in labels:
        if len(label.lines) != 2 or min(len(line) for line in label.lines) < 2:
            raise InputError(
                f"{label.where}: {len(label.lines)} edges",
                "give each lane two edges of at least 2 points",
            )
        if label.feature_id in raw:
            raise InputError(
                f"{label.where}: lane id {label.feature_id} twice", "give each lane its own id"
            )
        one, two = label.lines
        raw[label.feature_id] = (one, _same_order(one, two))
    links = {
        label.feature_id: tuple(i for i in label.ids("next_lane_ids") if i in raw)
        for label in labels
    }
    before = {key: [] for key in raw}
    for key, followers in links.items():
        for follower in followers:
            before[follower].append(key)
    turned = swapped = against = 0
    lanes = {}
    for label in labels:
        key = label.feature_id
        one, two = raw[key]
        vote = sum(_runs_towards(raw[key], raw[n]) for n in links[key]) - sum(
            _runs_towards(raw[key], raw[p]) for p in before[key]
        )
        if vote == 0 and not links[key] and not before[key]:
            vote = _ego_vote(one, two, ego_log)
        if vote < 0:
            one = one[::-1]
            two = two[::-1]
            turned = turned + 1
        styles = [
            (
                label.attributes.get(f"{side}_edge_styles"),
                label.attributes.get(f"{side}_edge_colors"),
            )
            for side in ("left", "right")
        ]
        if is_left_of(two, one):
            one, two, swapped = two, one, swapped + 1
            # Attributes are named by side, not by order: they stay with their side.
        against += _ego_vote(one, two, ego_log) < 0
        lanes[key] = Lane(
            lane_id=key,
            centre=centre_line(one, two),
            left=one,
            right=two,
            kind="shoulder"
            if "SHOULDER_LANE" in (label.attributes.get("use_types") or ())
            else "vehicle",
            successors=label.ids("next_lane_ids"),
            left_neighbour=label.one_id("left_lane_id"),
            right_neighbour=label.one_id("right_lane_id"),
            left_paint=paint_of(*styles[0]),
            right_paint=paint_of(*styles[1]),
            is_intersection="TURN" in str(label.attributes.get("lane_direction")),
            speed_limit_mps=_speed_limit(label),
        )
    notes = ["speed limits are taken as miles per hour"]
    notes += (
        [f"{turned} lanes were stored against their driving direction and were turned"]
        if turned
        else []
    )
    notes += [f"{swapped} lanes had their edges exchanged and were put right"] if swapped else []
    notes += [f"the recorded drive runs against {against} lanes"] if against else []
    return lanes, tuple(notes)


def _same_order(one, two):
    """Return the second edge, turned round where its far end lies nearer to the start of the
    first.
    """
    straight = np.linalg.norm(one[0] - two[0]) + np.linalg.norm(one[-1] - two[-1])
    crossed = np.linalg.norm(one[0] - two[-1]) + np.linalg.norm(one[-1] - two[0])
    return two[::-1] if straight > crossed else two


def _runs_towards(lane, other):
    """Return 1 if the lane's last points lie nearer to the other lane than its first ones, else
    -1.
    """
    ends = np.stack([(other[0][i] + other[1][i]) / 2 for i in (0, -1)])
    first, last = ((lane[0][i] + lane[1][i]) / 2 for i in (0, -1))
    distance = [float(np.linalg.norm(ends - p, axis=1).min()) for p in (first, last)]
    return 1 if distance[1] <= distance[0] else -1


def _ego_vote(one, two, ego_log):
    """Return 1 if the ego drove through the lane in the order of its points, -1 if against it, 0 if
    it was not there or crossed.
    """
    ring = lane_polygon(Lane("", one, one, two))
    inside = shapely.contains_xy(ring, ego_log.xyz[:, 0], ego_log.xyz[:, 1])
    if not inside.any():
        return 0
    middle = centre_line(one, two)
    chord = middle[-1, :2] - middle[0, :2]
    error = np.abs(wrap_angle(yaw_from_quat(ego_log.quat[inside]) - np.arctan2(chord[1], chord[0])))
    share = float(np.median(error))
    return 1 if share < np.pi / 3 else -1 if share > 2 * np.pi / 3 else 0


def _speed_limit(label):
    value = label.attributes.get("speed_limit")
    return float(value) * MPH if isinstance(value, (int, float)) and value > 0 else None


FRAME_RATE_HZ = 30
LAYERS = (
    "lanes",
    "lanelines",
    "road_boundaries",
    "wait_lines",
    "crosswalks",
    "poles",
    "traffic_signs",
)
EDGE_STEP_M = 2.0
GROUND_CELL_M = 2.0


def read_cosmos(path):
    """Read one clip: the folder that holds ``3d_lanes``, ``vehicle_pose`` and the other layers.

    Raises:
        InputError: A layer is missing or damaged, there are no lanes or no road boundaries, or the
            poses are not a drive.
    """
    folder = Path(path)
    files = SourceFiles()
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder", "give the folder that holds 3d_lanes")
    ego_log, clip = read_poses(files, folder)
    layers = {name: read_layer(files, folder, f"3d_{name}") for name in LAYERS}
    if not layers["lanes"]:
        raise InputError(f"{folder}: a map without lanes", "use a clip with lanes")
    if not layers["road_boundaries"]:
        raise InputError(f"{folder}: a map without road edges", "use a clip with road boundaries")
    lanes, lane_notes = oriented_lanes(files, layers["lanes"], ego_log)
    stops = [
        label for label in layers["wait_lines"] if label.attributes.get("is_implicit") is not True
    ]
    lane_map = LaneMap(
        lanes=lanes,
        road_edges=tuple(
            densify(label.lines[0], EDGE_STEP_M)
            for label in layers["road_boundaries"]
            if len(label.lines[0]) > 1
        ),
        crosswalks=tuple(
            np.concatenate([label.lines[0], label.lines[0][:1]]) for label in layers["crosswalks"]
        ),
        stop_lines=tuple(label.lines[0] for label in stops),
        markings=tuple(
            Marking(
                line.lines[0],
                paint_of(line.attributes.get("styles"), line.attributes.get("colors")),
            )
            for line in layers["lanelines"]
        ),
        poles=tuple(label.lines[0] for label in layers["poles"]),
        signs=tuple(
            sign_pose(label.lines[0])
            for label in layers["traffic_signs"]
            if len(label.lines[0]) == 8
        ),
    )
    lenses = read_lenses(files, folder)
    if FRONT_WIDE not in lenses:
        raise InputError(f"{folder}: no lens {FRONT_WIDE}", "use a clip with the front wide camera")
    ground = from_points(
        np.concatenate([*lane_edges(lanes), *lane_map.road_edges, ego_log.xyz]),
        GROUND_CELL_M,
        ego_log.xyz,
    )
    notes = (
        "no actor tracks in this copy: the road is empty",
        "no camera extrinsics in this copy: the front wide camera is mounted as on another car of the fleet",
        "rendered through a pinhole of 90 degrees width inside the recorded 120 degree f-theta lens",
        "vehicle size and axles assumed: the clip has none; the rig's origin is taken to be on the ground under the rear axle",
        f"{len(layers['wait_lines']) - len(stops)} implicit wait lines are no painted stop lines and were left out",
        "lane lines run between the edges of neighbouring lanes and are the same paint: draw a line once",
        "road markings (6 classes of words and arrows) and traffic lights are not used",
        *lane_notes,
    )
    wide = lenses[FRONT_WIDE]
    front = np.array([wide.cx, wide.cy, wide.width, wide.height])
    return RecordedLog(
        scene_id=f"cosmos-{clip}",
        source="cosmos",
        lane_map=lane_map,
        ground=ground,
        ego_log=ego_log,
        vehicle=Vehicle(),
        actors=(),
        cameras=(front_camera(front, T_RIG_FRONT_WIDE),),
        world_origin=(0.0, 0.0, 0.0),
        content_hash=files.content_hash,
        notes=notes,
    )


def read_poses(files, folder):
    """Read ``vehicle_pose``: one 4x4 rig-to-world matrix a frame at 30 Hz, and the clip's name.

    Times count from the clip's first microsecond, which stands in the file's name; 0 where it does
    not.

    Raises:
        InputError: Frames are missing, or a matrix is not a rigid motion.
    """
    path = files.only(folder / "vehicle_pose", ("*.tar",), "the ego poses")
    frames = {}
    for name, data in read_tar(files, path).items():
        match = re.search(r"\.(\d+)\.vehicle_pose\.npy$", name)
        if match is None:
            continue
        where = f"{path}, {name}"
        matrix = np.asarray(parse_npy(data, where), dtype=np.float64)
        if (
            matrix.shape != (4, 4)
            or not np.isfinite(matrix).all()
            or abs(np.linalg.det(matrix[:3, :3]) - 1) > 1e-3
        ):
            raise InputError(
                f"{where}: an array of shape {matrix.shape} that is not a rigid motion",
                "give 4x4 rig-to-world matrices",
            )
        frames[int(match.group(1))] = matrix
    if sorted(frames) != list(range(len(frames))):
        missing = next(i for i in range(len(frames) + 1) if i not in frames)
        raise InputError(
            f"{path}: no frame {missing:06d} among {len(frames)} poses",
            "give frames numbered from 000000 without holes",
        )
    stamp = re.match(r"(?P<clip>.+)_(?P<start>\d+)_(?P<end>\d+)$", path.stem)
    start_us = int(stamp["start"]) if stamp else 0
    poses = np.stack([frames[i] for i in range(len(frames))]) if frames else np.zeros((0, 4, 4))
    t_us = start_us + np.round(np.arange(len(poses)) * (1e6 / FRAME_RATE_HZ)).astype(np.int64)
    near(path, poses[:, :3, 3])
    quat = quat_from_matrix(poses[:, :3, :3])
    return checked_trajectory(path, t_us, poses[:, :3, 3].copy(), quat, least=2), stamp[
        "clip"
    ] if stamp else path.stem
