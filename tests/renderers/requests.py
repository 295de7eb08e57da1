"""Requests to a renderer and the distance of its pictures."""

import numpy as np

from alpasim_plugin.core.geometry import se3
from alpasim_plugin.core.types import RenderRequest


def request(scenario, index=8, left_m=0.0, t_us=None):
    T = se3(scenario.ego_log.xyz[index], scenario.ego_log.quat[index])
    T[:3, 3] += left_m * T[:3, 1]
    camera = scenario.cameras[0]
    pose = T @ camera.T_rig_camera
    actors = {a.actor_id: se3(a.track.xyz[0], a.track.quat[0]) for a in scenario.actors}
    return RenderRequest(
        int(scenario.ego_log.t_us[index]) if t_us is None else t_us,
        camera,
        np.stack([pose, pose]),
        actors,
    )


def psnr(a, b):
    return float(10 * np.log10(255.0**2 / np.mean((a.rgb.astype(float) - b.rgb) ** 2)))
