"""Snow that lies on the ground: thick beside the road, thin on lanes, least in the tracks of wheels."""

import cv2
import numpy as np

from alpasim_plugin.core.geometry import arc_lengths
from alpasim_plugin.core.types import F32, F64, CameraSpec, Scenario
from alpasim_plugin.renderers.view import View, shown_at
from alpasim_plugin.world.ground import height_at
from alpasim_plugin.world.path import polyline_path

ALBEDO = 0.8  # of snow that is not fresh any more
BESIDE = 0.95  # the share of the ground that snow hides beside lanes
LANE = 0.6  # on lanes
TRACK = 0.15  # in the tracks of wheels
STRIPS_M = ((LANE, -1.75, 1.75), (TRACK, -1.05, -0.55), (TRACK, 0.55, 1.05))  # across a lane
STEP_M = 2.0
SIGHT_M = 150.0
NEAREST_M = 0.3
SOFT_WIDTHS = 0.002  # of the edges of tracks, in image widths
SUBPIXEL_BITS = 4  # sixteenths
BENDS = 6  # straight pieces of which a quad's edge is made that a lens bends


class SnowCover:
    """The snow that lies in a scene."""

    def __init__(self, scenario: Scenario) -> None:
        lanes = scenario.lane_map.lanes.values()
        centres = [lane.centre for lane in lanes if lane.kind == "vehicle"]
        paths = [polyline_path(centre) for centre in centres if arc_lengths(centre)[-1] > STEP_M]
        quads = [np.zeros((0, 4, 3))]
        shares = []
        for share, right_m, left_m in STRIPS_M:
            for path in paths:
                along_m = np.linspace(0, path.length_m, int(path.length_m / STEP_M) + 2)
                right = path.at(along_m, right_m)[0]
                left = path.at(along_m, left_m)[0]
                quads.append(np.stack([right[:-1], right[1:], left[1:], left[:-1]], axis=1))
                shares += [share] * (len(along_m) - 1)
        self.shares = np.array(shares)
        self.quads = np.concatenate(quads)
        self.quads[..., 2] = height_at(scenario.ground, self.quads.reshape(-1, 3)).reshape(-1, 4)

    def on(self, view: View) -> F32:
        """Return what share of each pixel's surface snow hides ``(H, W)``."""
        local = (self.quads - view.place) @ view.T_world_camera[:3, :3]
        cover: F32 = np.full(view.ground.shape, BESIDE, dtype=np.float32)
        draw = _draw_straight if view.camera.lens is None else _draw_bent
        draw(cover, view.camera, local, self.shares)
        return view.ground * cv2.GaussianBlur(cover, (0, 0), SOFT_WIDTHS * cover.shape[1])


def _draw_straight(cover: F32, camera: CameraSpec, quads: F64, shares: F64) -> None:
    """Draw quads ``(N, 4, 3)`` in a pinhole's axes, whose edges its image shows straight."""
    depth_m = quads[..., 2]
    is_seen = (depth_m.max(axis=1) > NEAREST_M) & (depth_m.min(axis=1) < SIGHT_M)
    is_whole = depth_m.min(axis=1) > NEAREST_M
    for quad, share, whole in zip(
        quads[is_seen], shares[is_seen].tolist(), is_whole[is_seen].tolist(), strict=True
    ):
        projected = (quad if whole else _cut(quad)) @ camera.K.T
        pixels = projected[:, :2] / projected[:, 2:] - 0.5
        corners = np.rint(16 * np.clip(pixels, -1e5, 1e5)).astype(np.int32)
        cv2.fillConvexPoly(cover, corners, share, cv2.LINE_8, SUBPIXEL_BITS)


def _draw_bent(cover: F32, camera: CameraSpec, quads: F64, shares: F64) -> None:
    """Draw quads ``(N, 4, 3)`` in the axes of a camera whose lens bends their edges; one that the
    lens does not describe as a whole is left out.
    """
    along = np.linspace(0.0, 1.0, BENDS, endpoint=False)[:, None]
    following = np.roll(quads, -1, axis=1)
    edges = quads[:, :, None] + along * (following - quads)[:, :, None]
    outlines = edges.reshape(len(quads), -1, 3)  # (N, 4 BENDS, 3)
    pixels, can_be_seen = shown_at(camera, outlines.reshape(-1, 3))
    pixels = pixels.reshape(len(quads), -1, 2) - 0.5
    is_seen = can_be_seen.reshape(len(quads), -1).all(axis=1)
    is_seen &= np.linalg.norm(outlines, axis=2).min(axis=1, initial=np.inf) < SIGHT_M
    for outline, share in zip(pixels[is_seen], shares[is_seen].tolist(), strict=True):
        corners = np.rint(16 * np.clip(outline, -1e5, 1e5)).astype(np.int32)
        cv2.fillPoly(cover, [corners], share, cv2.LINE_8, SUBPIXEL_BITS)


def _cut(quad: F64) -> F64:
    """Return the corners ``(N, 3)`` of what lies of a quad ``(4, 3)``, in the camera's axes, beyond
    the plane `NEAREST_M` before the camera.
    """
    following = np.roll(quad, -1, axis=0)
    is_front = quad[:, 2] > NEAREST_M
    kept = []
    for first, second, crosses in zip(
        quad, following, is_front != np.roll(is_front, -1), strict=True
    ):
        if first[2] > NEAREST_M:
            kept.append(first)
        if crosses:
            reach = (NEAREST_M - first[2]) / (second[2] - first[2])
            kept.append(first + reach * (second - first))
    return np.array(kept)
