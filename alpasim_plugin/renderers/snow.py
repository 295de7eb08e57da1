"""Snow that lies on the ground: thick beside the road, thin on lanes, least in the tracks of wheels."""

from __future__ import annotations

import cv2
import numpy as np

from alpasim_plugin.core.geometry import arc_lengths, resample
from alpasim_plugin.core.types import F32, F64, Scenario
from alpasim_plugin.renderers.view import View
from alpasim_plugin.world.ground import height_at

ALBEDO = 0.8  # of snow that is not fresh any more
# The share of a surface that snow hides.
BESIDE, LANE, TRACK = 0.95, 0.6, 0.15
TRACK_M, TRACK_HALF_M = 0.8, 0.25  # from a lane's middle; half the width
STEP_M, SIGHT_M, NEAREST_M = 2.0, 150.0, 0.3
SOFT_WIDTHS = 0.002  # of the edges of tracks, in image widths
SUBPIXEL_BITS = 4  # sixteenths


class SnowCover:
    """The snow that lies in a scene; a lane without edges is covered as what is beside the road."""

    def __init__(self, scenario: Scenario) -> None:
        none = np.zeros((0, 4, 3))
        lanes, tracks = [none], [none]
        for lane in scenario.lane_map.lanes.values():
            if lane.kind != "vehicle" or lane.left is None or lane.right is None:
                continue
            lengths = arc_lengths(lane.left)[-1], arc_lengths(lane.right)[-1]
            count = int(max(lengths) / STEP_M) + 2
            left = resample(lane.left, np.linspace(0, lengths[0], count))
            right = resample(lane.right, np.linspace(0, lengths[1], count))
            lanes.append(_quadrilaterals(left, right))
            across = right - left
            across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 0.1)
            for middle_m in (-TRACK_M, TRACK_M):
                track = (left + right) / 2 + middle_m * across
                half = TRACK_HALF_M * across
                tracks.append(_quadrilaterals(track - half, track + half))
        quads = np.concatenate(lanes + tracks)
        quads[..., 2] = height_at(scenario.ground, quads.reshape(-1, 3)).reshape(-1, 4)
        self.quads = quads
        self.shares = np.full(len(quads), TRACK)
        self.shares[: sum(map(len, lanes))] = LANE

    def on(self, view: View) -> F32:
        """Return what share of each pixel's surface snow hides ``(H, W)``."""
        local = (self.quads - view.place) @ view.T_world_camera[:3, :3]
        depth = local[..., 2]
        is_seen = (depth.min(axis=1) > NEAREST_M) & (depth.min(axis=1) < SIGHT_M)
        pixels = (local[is_seen] @ view.K.T)[..., :2] / depth[is_seen][..., None] - 0.5
        corners = np.rint(16 * np.clip(pixels, -1e5, 1e5)).astype(np.int32)
        cover = np.full(view.ground.shape, BESIDE, np.float32)
        for quad, share in zip(corners, self.shares[is_seen].tolist(), strict=True):
            cv2.fillConvexPoly(cover, quad, share, cv2.LINE_8, SUBPIXEL_BITS)
        cover = cv2.GaussianBlur(cover, (0, 0), SOFT_WIDTHS * cover.shape[1])
        return view.ground * cover


def _quadrilaterals(left: F64, right: F64) -> F64:
    """Return what lies between two lines ``(N, 3)``, ``(N - 1, 4, 3)``."""
    return np.stack([left[:-1], left[1:], right[1:], right[:-1]], axis=1)
