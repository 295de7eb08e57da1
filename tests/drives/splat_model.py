"""A trained model of the street, and the poses of its drive in the model's frame."""

import json

import numpy as np

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.gaussians.cloud import GaussianCloud
from tests.drives.street import Street, write_transforms

UNIT = 0.2  # of the model, metres


def street_cloud(scale=UNIT, turn=None):
    """Return the street's road and walls as Gaussians, in a unit and a frame of their own."""
    rng = stream("splat", 0, "street")
    road = rng.uniform([-2.0, -4.0, 0.0], [40.0, 4.0, 0.0], (12_000, 3))
    wall = rng.uniform([-2.0, -5.0, 0.0], [40.0, 5.0, 4.0], (6_000, 3))
    wall[:, 1] = np.where(wall[:, 1] > 0, 5.0, -5.0)
    points = np.concatenate([road, wall])
    points[:, 2] += Street().ground(points[:, 0])
    points = scale * (points if turn is None else points @ turn.T)
    n = len(points)
    return GaussianCloud(
        points,
        np.tile([1.0, 0, 0, 0], (n, 1)),
        np.full((n, 3), 0.08 * scale),
        np.full(n, 0.9),
        np.zeros((n, 1, 3)),
    )


def poses_of(folder, scale=UNIT, turn=None, photographs=False):
    """Write the poses of the drive in the model's frame."""
    path = write_transforms(folder) / "transforms.json"
    document = json.loads(path.read_text())
    for frame in document["frames"]:
        T = np.array(frame["transform_matrix"])
        if turn is not None:
            T[:3] = turn @ T[:3]
        T[:3, 3] *= scale
        frame["transform_matrix"] = T.tolist()
    path.write_text(json.dumps(document))
    if not photographs:
        for picture in (folder / "images").iterdir():
            picture.unlink()
    return path
