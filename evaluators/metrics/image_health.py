"""Health of the camera images in a log: black ones, and ones that stand still while the car moves.

Both are the renderer's failure. They are counted; only some presets drop the rollout of a black
image.
"""

import numpy as np

from alpasim_plugin.core.image_metrics import is_black
from alpasim_plugin.core.types import U8, LoggedImage, MetricSeries, RolloutLog, Scene
from evaluators.metrics.presets import Preset
from evaluators.metrics.score import series, with_preset

FROZEN_MOVE_M = 0.1  # the ego's way between two images after which they cannot be equal


def decode(image: LoggedImage) -> U8:
    """Decode a logged PNG or JPEG to ``(H, W, 3)`` BGR.

    Raises:
        InputError: The bytes are no image, or one larger than the bounds.
    """
    from alpasim_plugin.core.files.images import decode_image

    location = f"camera {image.camera!r} at {image.end_us} us"
    return decode_image(image.data, location, "log PNG or JPEG")


def evaluate_images(rollout: RolloutLog, scene: Scene, preset: Preset) -> list[MetricSeries]:
    """Give ``img_is_black`` and ``img_is_frozen``, one row per image time: 1 if any camera's image
    of that time is. No images, no rows.
    """
    images = [image for image in rollout.images if preset.image_camera in (None, image.camera)]
    if preset.image_rule == "at_or_after_step":
        if not images:
            return []
        # The first image at or after each ego time; times after the last image have no row.
        images = sorted(images, key=lambda image: image.end_us)
        ends = np.array([image.end_us for image in images], dtype=np.int64)
        is_dark = np.array([is_black(decode(image)) for image in images], dtype=np.float64)
        times = rollout.ego.t_us[rollout.ego.t_us <= ends[-1]]
        return [series("img_is_black", times, is_dark[np.searchsorted(ends, times, side="left")])]
    black: dict[int, bool] = {}
    for image in images:
        black[image.end_us] = black.get(image.end_us, False) or is_black(decode(image))
    t_us = np.array(sorted(black), dtype=np.int64)
    before: dict[str, LoggedImage] = {}
    stuck: set[int] = set()
    for image in sorted(images, key=lambda image: image.end_us):
        last = before.get(image.camera)
        if last is None or last.data != image.data:
            before[image.camera] = image
            continue
        # Counted from the first of the equal images, so that a creeping car leaves it behind as
        # well.
        moved = [
            np.interp([last.end_us, image.end_us], rollout.ego.t_us, rollout.ego.xyz[:, k])
            for k in (0, 1)
        ]
        if float(np.hypot(*(np.diff(e)[0] for e in moved))) > FROZEN_MOVE_M:
            stuck.add(image.end_us)
    return [
        series("img_is_black", t_us, np.array([black[int(t)] for t in t_us], dtype=np.float64)),
        series("img_is_frozen", t_us, np.array([int(t) in stuck for t in t_us], dtype=np.float64)),
    ]


FACTORY = with_preset(evaluate_images)
