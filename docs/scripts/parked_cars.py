"""Compare where standing obstacles of an imported stereo drive begin with the bodies that
semi-global matching of the pair sees.

    python docs/scripts/parked_cars.py STREET FROM TO     # metres along the street's x; the right side of the path

Prints for every half metre the body's side (metres to the left of the path's line), the nearest
side of the obstacles there, and the difference: positive is contact too early.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np

from alpasim_plugin.drives.obstacles import standing_obstacles
from alpasim_plugin.drives.source import Points
from alpasim_plugin.gaussians.fit.photographs import read_points
from alpasim_plugin.gaussians.fit.reconstruction import Reconstruction
from alpasim_plugin.world.ground import height_at
from scenarios.drive import read_drive

BESIDE_M = (-5.0, -1.8)  # of the path's line: where cars are parked
EVERY = 3
NEAREST_PX = 12.0
FARTHEST_M = 14.0
FEWEST = 1000


def bodies(folder: Path) -> np.ndarray:
    """Return points ``(N, 3)`` of what stands beside the path, by the stereo pair alone."""
    log = read_drive(folder)
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    left = [one for one in frames if one["camera"] == "front"][::EVERY]
    right = {one["t_us"]: one for one in frames if one["use"] == "never-fitted"}
    matcher = cv2.StereoSGBM_create(0, 128, 5, 8 * 25, 32 * 25, 1, 0, 10, 80, 2)
    found = []
    for one in left:
        other = right[one["t_us"]]
        pair = [
            cv2.imread(str(folder / frame["file_path"]), cv2.IMREAD_GRAYSCALE)
            for frame in (one, other)
        ]
        shift = matcher.compute(*pair).astype(np.float64) / 16
        T, base = (
            np.array(one["transform_matrix"]),
            np.linalg.inv(one["transform_matrix"]) @ np.array(other["transform_matrix"]),
        )
        v, u = np.nonzero(shift > NEAREST_PX)
        z = one["fl_x"] * base[0, 3] / shift[v, u]
        local = np.stack(
            [(u + 0.5 - one["cx"]) / one["fl_x"] * z, (v + 0.5 - one["cy"]) / one["fl_y"] * z, z],
            axis=1,
        )[z < FARTHEST_M]
        xyz = local @ T[:3, :3].T + T[:3, 3]
        above = xyz[:, 2] - height_at(log.ground, xyz)
        found.append(
            xyz[
                (above > 0.3)
                & (above < 1.6)
                & (xyz[:, 1] > BESIDE_M[0])
                & (xyz[:, 1] < BESIDE_M[1])
            ]
        )
    return np.concatenate(found)


def main(folder: Path, begin: float, end: float) -> None:
    """Print the table."""
    log, cloud = read_drive(folder), read_points(folder / "points.ply")
    xyz = np.asarray(cloud.means, dtype=np.float64)
    points = Points(xyz, np.zeros((len(xyz), 3)), np.zeros((len(xyz), 3, 3)))
    found = standing_obstacles(
        Reconstruction.load(folder / "model").background,
        points,
        log.ground,
        log.ego_log,
        log.vehicle,
    )
    boxes = np.array(
        [[*one.xyz[:2], one.box.length_m / 2, one.box.width_m / 2] for one in found.obstacles]
    )
    body = bodies(folder)
    for x in np.arange(begin, end, 0.5):
        here = body[(body[:, 0] >= x) & (body[:, 0] < x + 0.5), 1]
        near = boxes[(boxes[:, 0] - boxes[:, 2] < x + 0.5) & (boxes[:, 0] + boxes[:, 2] > x)]
        sides = (near[:, 1] + near[:, 3])[
            (near[:, 1] + near[:, 3] > BESIDE_M[0]) & (near[:, 1] < 0)
        ]
        if len(here) > FEWEST:
            side = np.percentile(here, 97)
            print(
                f"{x:5.1f} {side:6.2f} "
                + (
                    f"{sides.max():6.2f} {sides.max() - side:+.2f}"
                    if len(sides)
                    else "nothing stands there"
                )
            )


if __name__ == "__main__":
    main(Path(sys.argv[1]), float(sys.argv[2]), float(sys.argv[3]))
