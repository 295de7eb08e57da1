"""An imported drive made by hand: a road of grey Gaussians under a bright sky, with photographs of
it in files.
"""

from dataclasses import replace

import cv2
import numpy as np

from alpasim_plugin.core.geometry import interpolate
from alpasim_plugin.core.types import Photograph
from alpasim_plugin.gaussians import GaussianCloud
from alpasim_plugin.gaussians.fit.reconstruction import Reconstruction
from alpasim_plugin.gaussians.scene.sky import HEIGHT, WIDTH, Sky
from alpasim_plugin.gaussians.sh import dc_from_rgb
from tests.gaussians.scene_maps import parked, straight, with_camera

SKY_LEVEL = 200
EXPOSURE = 1.2  # of the fitted photographs
WIDE = 64
HIGH = 48


def recorded_drive(folder, count=9, long_m=60.0):
    """Write a model and photographs every 0.2 s, the fourth held out, and of a right camera 0.5 m
    beside; return the scenario.
    """
    x, y = (
        axis.ravel()
        for axis in np.meshgrid(np.arange(-5.0, long_m, 0.5), np.arange(-10.0, 10.0, 0.5))
    )
    n = len(x)
    means = np.column_stack([x, y, np.zeros(n)])
    flat = np.tile([0.3, 0.3, 0.02], (n, 1))
    colours = dc_from_rgb(np.full((n, 3), 0.4))[:, None, :]
    cloud = GaussianCloud(means, np.tile([1.0, 0, 0, 0], (n, 1)), flat, np.full(n, 0.99), colours)
    model = Reconstruction(
        cloud, {}, Sky(np.full((HEIGHT, WIDTH, 3), SKY_LEVEL / 255, dtype=np.float32))
    )
    model.save(folder / "model", {})
    scenario = with_camera(straight(actors=(parked("obstacle-001", 19.0, -1.8),)), WIDE, HIGH)
    shots = tuple(
        _photograph(scenario, folder, camera, i, lateral_m)
        for camera, lateral_m in (("front", 0.0), ("right", -0.5))
        for i in range(count)
    )
    return replace(scenario, model=str(folder / "model"), recording=shots)


def _photograph(scenario, folder, camera, i, aside_m):
    spec = scenario.cameras[0]
    t_us = int(scenario.ego_log.t_us[0]) + 200_000 * i
    shift = np.eye(4)
    shift[1, 3] = aside_m
    picture = np.full(
        (2 * HIGH, 2 * WIDE, 3), 122, dtype=np.uint8
    )  # the road, 0.4, in the photographs' exposure
    picture[:HIGH] = min(255, round(SKY_LEVEL * EXPOSURE))
    path = folder / f"{camera}-{i}.png"
    cv2.imwrite(str(path), picture)
    use = "never-fitted" if camera == "right" else "held-out" if i == 4 else "fitted"
    T = interpolate(scenario.ego_log, t_us) @ shift @ spec.T_rig_camera
    K = np.diag([2.0, 2.0, 1.0]) @ spec.K
    return Photograph(
        t_us,
        camera,
        2 * WIDE,
        2 * HIGH,
        K,
        T,
        str(path),
        use,
        (EXPOSURE,) * 3 if use == "fitted" else (1.0,) * 3,
    )  # type: ignore[arg-type]
