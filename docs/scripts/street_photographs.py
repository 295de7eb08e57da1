"""Write photographs of a street with their poses: what a camera sees on the recorded drive of a
shipped scene, as a folder that `simrun import drive` reads.

Usage: python docs/scripts/street_photographs.py FOLDER COUNT
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np

import simrun
from alpasim_plugin.core.geometry import interpolate
from alpasim_plugin.gaussians.scene.log_views import log_actors

SCENE = "urban/s_bend"


def write_photographs(folder: Path, count: int) -> None:
    """Write evenly spaced photographs, and `transforms.json`."""
    scenario = simrun.load_scenario(SCENE)
    renderer = simrun.make_renderer("clean", scenario)
    camera = scenario.cameras[0]
    (folder / "images").mkdir(parents=True)
    frames = []
    times_us = np.linspace(scenario.start_us, scenario.ego_log.t_us[-1], count).astype(np.int64)
    for index, t_us in enumerate(times_us):
        T_world_camera = interpolate(scenario.ego_log, int(t_us)) @ camera.T_rig_camera
        request = simrun.RenderRequest(
            int(t_us), camera, np.stack([T_world_camera] * 2), log_actors(scenario, int(t_us))
        )
        path = f"images/{index:04d}.png"
        cv2.imwrite(str(folder / path), renderer.render(request).rgb[..., ::-1])
        frames.append(
            {"file_path": path, "transform_matrix": T_world_camera.tolist(), "t_us": int(t_us)}
        )
    focal_x, focal_y = float(camera.K[0, 0]), float(camera.K[1, 1])
    lens = {"fl_x": focal_x, "fl_y": focal_y, "cx": camera.K[0, 2], "cy": camera.K[1, 2]}
    size = {"w": camera.width, "h": camera.height}
    document = {"axes": "opencv", "unit": "m", **size, **lens, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(document))


if __name__ == "__main__":
    write_photographs(Path(sys.argv[1]), int(sys.argv[2]))
