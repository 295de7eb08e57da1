"""Health of the camera images in a log. A black image is the renderer's failure; it is counted, and only some presets drop its rollout."""

from __future__ import annotations

import numpy as np

from alpasim_plugin.errors import EvaluatorError
from alpasim_plugin.types import U8, LoggedImage, MetricSeries, RolloutLog, Scene
from evaluators.base import register, series
from evaluators.presets import Preset

BLACK_MAX = 10  # an image is black when no byte is above this


def is_black(pixels: U8) -> bool:
    """Return whether every byte of ``(H, W, 3)`` pixels is at most 10."""
    return bool(pixels.max(initial=0) <= BLACK_MAX)


def decode(image: LoggedImage) -> U8:
    """Decode a logged PNG or JPEG to ``(H, W, 3)`` BGR.

    Raises:
        EvaluatorError: The bytes are no image.
    """
    import cv2  # only rollouts that carry images need it

    raw = np.frombuffer(image.data, dtype=np.uint8)
    pixels = cv2.imdecode(raw, cv2.IMREAD_COLOR) if raw.size else None
    if pixels is None:
        raise EvaluatorError(
            "decoding a logged image",
            f"camera {image.camera!r} at {image.end_us} us",
            f"{raw.size} bytes that are no image",
            "log PNG or JPEG",
        )
    return np.asarray(pixels, dtype=np.uint8)


@register("image_health", "black camera images")
def evaluate_images(rollout: RolloutLog, scene: Scene, preset: Preset) -> list[MetricSeries]:
    """Give ``img_is_black``, one row per image time: 1 if any camera's image of that time is black. No images, no rows."""
    images = [image for image in rollout.images if preset.image_camera in (None, image.camera)]
    if preset.image_rule == "at_or_after_step":
        return _at_or_after_steps(images, rollout)
    black: dict[int, bool] = {}
    for image in images:
        black[image.end_us] = black.get(image.end_us, False) or is_black(decode(image))
    t_us = np.array(sorted(black), dtype=np.int64)
    return [series("img_is_black", t_us, np.array([black[int(t)] for t in t_us], dtype=np.float64))]


def _at_or_after_steps(images: list[LoggedImage], rollout: RolloutLog) -> list[MetricSeries]:
    """Give the first image at or after each ego time; times after the last image have no row. Without images there is no series."""
    if not images:
        return []
    images = sorted(images, key=lambda image: image.end_us)
    black = np.array([is_black(decode(image)) for image in images], dtype=np.float64)
    ends = np.array([image.end_us for image in images], dtype=np.int64)
    t_us = rollout.ego.t_us[rollout.ego.t_us <= ends[-1]]
    return [series("img_is_black", t_us, black[np.searchsorted(ends, t_us, side="left")])]
