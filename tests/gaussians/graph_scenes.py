"""Scene graphs of few blobs."""

import numpy as np

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.scene.scene_graph import Level, SceneNode
from alpasim_plugin.gaussians.scene.sky import make_sky
from alpasim_plugin.gaussians.sh import dc_from_rgb
from tests.gaussians.scene_maps import camera_spec

SKY = make_sky("clear", stream("t", 0, "sky"))


def camera(width=64, height=48, T_world_rig=None):
    spec = camera_spec(width, height)
    return PinholeCamera.from_pose(
        width,
        height,
        spec.K,
        (np.eye(4) if T_world_rig is None else T_world_rig) @ spec.T_rig_camera,
    )


def blobs(centre, n=40, seed=0, sheen=False):
    rng = np.random.default_rng(seed)
    sh = np.zeros((n, 4, 3)) if sheen else np.zeros((n, 1, 3))
    sh[:, 0] = dc_from_rgb(rng.random((n, 3)))
    if sheen:
        sh[:, 1:] = rng.normal(0, 0.3, (n, 3, 3))
    means = np.array(centre) + rng.normal(0, 0.8, (n, 3))
    quats = rng.normal(size=(n, 4))
    return GaussianCloud(means, quats, 0.3 * rng.random((n, 3)), np.full(n, 0.8), sh)


def node(name, cloud, kind="background", far_m=1e9):
    return SceneNode(name, kind, (Level(0.1, cloud),), far_m)
