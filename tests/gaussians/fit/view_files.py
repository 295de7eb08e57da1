"""Write views in the form that `read_views` reads."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from alpasim_plugin.core.atomic import write_json
from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.gaussians.fit.photographs import FILE
from alpasim_plugin.gaussians.fit.views import PosedView


def write_views(folder: Path, views: Sequence[PosedView]) -> None:
    """Write views in the form that `read_views` reads: images as PNG, axes of OpenCV; depth and
    actors are not written.
    """
    frames = []
    for i, view in enumerate(views):
        camera = view.camera
        frame: dict[str, Any] = {
            "file_path": f"images/{i:04d}.png",
            "transform_matrix": inverse(camera.T_camera_world).tolist(),
            "w": camera.width,
            "h": camera.height,
            "fl_x": camera.fx,
            "fl_y": camera.fy,
            "cx": camera.cx,
            "cy": camera.cy,
        }
        _write_image(folder / frame["file_path"], view.rgb[..., ::-1])
        for key, image in (("sky", view.sky), ("mask", view.mask)):
            if image is not None:
                frame[f"{key}_path"] = f"{key}/{i:04d}.png"
                _write_image(folder / frame[f"{key}_path"], image.astype(np.uint8) * 255)
        frames.append(frame)
    write_json(folder / FILE, {"axes": "opencv", "frames": frames})


def _write_image(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)
