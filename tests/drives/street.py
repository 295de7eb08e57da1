"""A street of known shape, photographed: a bowed road between two walls, with a box beside the
path, drawn by casting rays.
"""

import json
import struct
from contextlib import contextmanager
from dataclasses import dataclass

import cv2
import numpy as np

from alpasim_plugin.core.geometry import quat_from_matrix

WIDTH = 320
HEIGHT = 128
FOCAL = 180.0
CAMERA_M = 1.5
STEP_M = 0.6
COUNT = 24
WALL_M = 5.0
BOX_LOW = np.array([14.0, 2.0, 0.0])
BOX_HIGH = np.array([18.0, 3.8, 1.4])
K = np.array([[FOCAL, 0.0, WIDTH / 2 + 3], [0.0, FOCAL, HEIGHT / 2 - 10], [0.0, 0.0, 1.0]])
RIG_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


_seen = {}  # photographs that were drawn in this process


@dataclass(frozen=True)
class Street:
    """What the photographs show.

    Attributes:
        bow_m: How far the road rises in its middle over 30 m.
    """

    bow_m: float = 0.3

    def ground(self, x):
        """Return the road's height at stations."""
        return self.bow_m * np.sin(np.pi * np.clip(x, -10, 40) / 30)

    def pose(self, x, lateral_m=0.0):
        """Return ``T_world_camera`` at a station; the world is x along, y left, z up."""
        T = np.eye(4)
        slope = float(self.ground(np.array(x + 0.5)) - self.ground(np.array(x - 0.5)))
        c = np.cos(np.arctan(slope))
        s = np.sin(np.arctan(slope))
        T[:3, :3] = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]) @ RIG_FROM_CAMERA
        T[:3, 3] = x, -lateral_m, float(self.ground(np.array(x))) + CAMERA_M
        return T

    def photograph(self, T, bend=None, fisheye=False):
        """Return what a camera at a pose sees, ``(H, W, 3)`` uint8 BGR; with a lens that bends
        lines where coefficients are given.
        """
        key = (
            self.bow_m,
            np.round(T, 9).tobytes(),
            None if bend is None else bend.tobytes(),
            fisheye,
        )
        if key not in _seen:
            _seen[key] = self._photograph(T, bend, fisheye)
        return _seen[key]

    def _photograph(self, T, bend, fisheye):
        v, u = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float64)
        pixels = np.stack([u.ravel(), v.ravel()], axis=1)[:, None]
        middle = K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        if bend is None:
            rays = (pixels[:, 0] - middle[:2, 2]) / FOCAL
        else:
            rays = (cv2.fisheye if fisheye else cv2).undistortPoints(pixels, middle, bend)[:, 0]
        direction = np.column_stack([rays, np.ones(len(rays))]) @ T[:3, :3].T
        return self._colours(T[:3, 3], direction).reshape(HEIGHT, WIDTH, 3)

    def _colours(self, at, ray):
        far = 1e6
        t = np.where(ray[:, 2] < -1e-3, -CAMERA_M / np.minimum(ray[:, 2], -1e-3), far)
        for _ in range(8):  # the bowed road is met where the ray is as high as it
            x = at[0] + np.clip(t, 0, 200) * ray[:, 0]
            t = np.where(
                ray[:, 2] < -1e-3, (self.ground(x) - at[2]) / np.minimum(ray[:, 2], -1e-3), far
            )
        best = np.where(t > 0, t, far)
        kind = np.zeros(len(ray), dtype=int)
        for side in (1.0, -1.0):
            t = np.where(
                ray[:, 1] * side > 1e-6,
                (side * WALL_M - at[1]) / np.where(np.abs(ray[:, 1]) > 1e-6, ray[:, 1], 1),
                far,
            )
            z = at[2] + t * ray[:, 2]
            hit = (t > 0) & (t < best) & (z < 6.0)
            best = np.where(hit, t, best)
            kind = np.where(hit, 1, kind)
        lift = np.array([0, 0, float(self.ground(np.array(16.0)))])
        low = BOX_LOW + lift
        high = BOX_HIGH + lift
        with np.errstate(divide="ignore", invalid="ignore"):
            a = (low - at) / ray
            b = (high - at) / ray
        t0 = np.minimum(a, b).max(axis=1)
        t1 = np.maximum(a, b).min(axis=1)
        hit = (t0 < t1) & (t0 > 0) & (t0 < best)
        best = np.where(hit, t0, best)
        kind = np.where(hit, 2, kind)
        place = at + np.minimum(best, 1e3)[:, None] * ray
        grey = 0.55 * noise(place, 0.25) + 0.45 * noise(place + 7.0, 0.06)
        grey = np.where(best > 60, 0.8, grey)
        tint = np.array([[0.5, 0.5, 0.5], [0.4, 0.55, 0.8], [0.8, 0.4, 0.3]])[kind]
        sky = np.array([0.95, 0.9, 0.85])
        colour = np.where((best >= 1e5)[:, None], sky, tint * (0.4 + 1.1 * grey[:, None]))
        return np.rint(255 * colour.clip(0, 1)).astype(np.uint8)


def noise(place, cell_m):
    """Return smooth noise 0..1 at places ``(N, 3)``: values at the corners of cells,
    interpolated.
    """
    q = place / cell_m
    base = np.floor(q).astype(np.int64)
    f = q - base
    f = f * f * (3 - 2 * f)
    total = np.zeros(len(place))
    for corner in range(8):
        offset = np.array([corner & 1, corner >> 1 & 1, corner >> 2 & 1])
        weight = np.prod(np.where(offset == 1, f, 1 - f), axis=1)
        i = (base + offset).astype(np.uint64)
        h = (
            i[:, 0] * np.uint64(0x9E3779B97F4A7C15)
            + i[:, 1] * np.uint64(0xC2B2AE3D27D4EB4F)
            + i[:, 2] * np.uint64(0x165667B19E3779F9)
        )
        h ^= h >> np.uint64(29)
        h *= np.uint64(0xBF58476D1CE4E5B9)
        h ^= h >> np.uint64(32)
        total += weight * (h & np.uint64(0xFFFF)).astype(np.float64) / 0xFFFF
    return total


def stations():
    """Return where the photographs are taken."""
    return np.arange(COUNT) * STEP_M


@contextmanager
def edited(folder):
    """Let a test change the ``transforms.json`` of a folder."""
    path = folder / "transforms.json"
    document = json.loads(path.read_text())
    yield document
    path.write_text(json.dumps(document))


def write_transforms(
    folder,
    axes="opencv",
    say_axes=True,
    street=None,
    bend=None,
    **keys,
):
    """Write the street as ``transforms.json``; keys of the document are added. ``bend`` is k1, k2, p1,
    p2 of the lens.
    """
    chosen = street or Street()
    (folder / "images").mkdir(parents=True)
    turn = np.eye(4) if axes == "opencv" else np.diag([1.0, -1.0, -1.0, 1.0])
    frames = []
    for i, x in enumerate(stations()):
        name = f"images/{i:03d}.png"
        coefficients = None if bend is None else np.array(bend)
        cv2.imwrite(str(folder / name), chosen.photograph(chosen.pose(x), coefficients))
        frames.append({"file_path": name, "transform_matrix": (chosen.pose(x) @ turn).tolist()})
    lens = {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "cx": K[0, 2], "cy": K[1, 2]}
    lens |= dict(zip(("k1", "k2", "p1", "p2"), bend or (), strict=False))
    document = {**lens, **({"axes": axes} if say_axes else {}), "frames": frames, **keys}
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder


def write_kitti(folder, spare_pictures=0, stereo=True):
    """Write the street as a KITTI odometry folder; ``spare_pictures`` have no pose."""
    chosen = Street()
    base = 0.54
    for name, lateral_m in (("image_l", 0.0), ("image_r", base))[: 2 if stereo else 1]:
        (folder / name).mkdir(parents=True)
        for i, x in enumerate(np.arange(COUNT + spare_pictures) * STEP_M):
            cv2.imwrite(
                str(folder / name / f"{i:06d}.png"),
                cv2.cvtColor(chosen.photograph(chosen.pose(x, lateral_m)), cv2.COLOR_BGR2GRAY),
            )
    first = np.linalg.inv(chosen.pose(0.0))
    poses = [first @ chosen.pose(x) for x in stations()]
    (folder / "poses.txt").write_text(
        "\n".join(" ".join(f"{v:.9e}" for v in pose[:3].ravel()) for pose in poses) + "\n"
    )
    P = np.column_stack([K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]), np.zeros(3)])
    right = P.copy()
    right[0, 3] = -FOCAL * base
    (folder / "calib.txt").write_text(
        "\n".join(" ".join(f"{v:.12e}" for v in one.ravel()) for one in (P, right))
    )
    return folder


def write_colmap(folder, binary, model="SIMPLE_PINHOLE", bend=()):
    """Write the street as a COLMAP model in ``sparse/0`` with pictures in ``images``; the unit is
    arbitrary.
    """
    street = Street()
    sparse = folder / "sparse/0"
    sparse.mkdir(parents=True)
    (folder / "images").mkdir()
    number = {"SIMPLE_PINHOLE": 0, "SIMPLE_RADIAL": 2, "OPENCV": 4, "OPENCV_FISHEYE": 5}[model]
    focal = (FOCAL,) if model.startswith("SIMPLE") else (FOCAL, FOCAL)
    p = (*focal, K[0, 2], K[1, 2], *bend)
    coefficients = np.array([*bend, 0, 0, 0, 0][:4], dtype=float) if bend else None
    rows = []
    for i, x in enumerate(stations()):
        T = street.pose(x)
        cv2.imwrite(
            str(folder / f"images/{i:03d}.png"),
            street.photograph(T, coefficients, model == "OPENCV_FISHEYE"),
        )
        back = np.linalg.inv(T)
        rows.append(
            (i + 1, *quat_from_matrix(back[:3, :3]), *(0.5 * back[:3, 3]), 1, f"{i:03d}.png")
        )
    places = np.array(
        [
            [x, y, float(street.ground(np.array(x)))]
            for x in np.arange(2.0, 25.0, 0.5)
            for y in np.arange(-2.0, 2.1, 0.5)
        ]
    )
    if binary:
        images = b"".join(
            struct.pack("<i7di", *row[:9])
            + row[9].encode()
            + b"\0"
            + struct.pack("<Qddq", 1, 1.0, 2.0, -1)
            for row in rows
        )
        points = b"".join(
            struct.pack("<Q3d3BdQii", i, *(0.5 * q), 90, 90, 90, 0.5, 1, 1, 0)
            for i, q in enumerate(places)
        )
        camera = struct.pack("<iiQQ", 1, number, WIDTH, HEIGHT) + struct.pack(f"<{len(p)}d", *p)
        for name, count, body in (
            ("cameras", 1, camera),
            ("images", len(rows), images),
            ("points3D", len(places), points),
        ):
            (sparse / f"{name}.bin").write_bytes(struct.pack("<Q", count) + body)
    else:
        (sparse / "cameras.txt").write_text(
            f"# cameras\n1 {model} {WIDTH} {HEIGHT} {' '.join(map(str, p))}\n"
        )
        (sparse / "images.txt").write_text(
            "# images\n" + "".join(" ".join(map(str, row)) + "\n1.0 2.0 -1\n" for row in rows)
        )
        text = "".join(
            f"{i} {0.5 * q[0]} {0.5 * q[1]} {0.5 * q[2]} 90 90 90 0.5 1 0\n"
            for i, q in enumerate(places)
        )
        (sparse / "points3D.txt").write_text("# points\n" + text)
    return folder
