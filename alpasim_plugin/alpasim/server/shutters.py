"""When each pixel of a requested frame is exposed: the shutter of the request's camera, carried
into the pinhole that is rendered.

A rolling shutter exposes the sensor's rows (or columns) one after another, the first at shutter
start and the last at its end: the row i of H is seen from the pose at i / (H - 1) of the way, as
NVIDIA's renderers do it. The row is that of the lens, so its pixels lie on a curve in the pinhole
that covers the lens.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np
from scipy import ndimage

from alpasim_plugin.alpasim.server.views import Lens, View, read_lens, sought
from alpasim_plugin.core.shutter import Along, rolling
from alpasim_plugin.core.types import F32, F64, Exposure
from alpasim_plugin.log.wire import sensorsim_pb2

Shutter = Literal["asked", "rolling", "global"]
ROLLS: Mapping[int, tuple[Along, bool]] = {
    sensorsim_pb2.ROLLING_TOP_TO_BOTTOM: ("rows", False),
    sensorsim_pb2.ROLLING_BOTTOM_TO_TOP: ("rows", True),
    sensorsim_pb2.ROLLING_LEFT_TO_RIGHT: ("columns", False),
    sensorsim_pb2.ROLLING_RIGHT_TO_LEFT: ("columns", True),
}
MARGIN_PX = 24
GRID_PX = 8  # the lens is inverted this often in the covering pinhole, and in between it is linear


def exposure_of(
    spec: sensorsim_pb2.CameraSpec, view: View, actors: Mapping[str, F64], shutter: Shutter
) -> Exposure | None:
    """Return when the pixels of the covering pinhole are exposed; None: all at the shutter's end.

    Args:
        spec: The request's intrinsics.
        view: The request.
        actors: Every road user's box pose at shutter end.
        shutter: ``asked``: as the intrinsics say, and what says nothing does not roll; ``rolling``:
            whatever does not roll does so from top to bottom; ``global``: nothing rolls.
    """
    rolls = ROLLS.get(
        spec.shutter_type,
        ROLLS[sensorsim_pb2.ROLLING_TOP_TO_BOTTOM] if shutter == "rolling" else None,
    )
    if shutter == "global" or rolls is None or view.start_us == view.t_us:
        return None
    share = _shares(spec.SerializeToString(deterministic=True), view.width, view.height, *rolls)
    return Exposure(
        share,
        {name: view.objects[name][0] if name in view.objects else T for name, T in actors.items()},
    )


@lru_cache(maxsize=32)
def _shares(data: bytes, width: int, height: int, along: Along, backwards: bool) -> F32:
    lens = read_lens(sensorsim_pb2.CameraSpec.FromString(data), width, height)
    plain = rolling(width, height, along, backwards)
    if lens.resample is None:
        return plain
    place, sees = place_in_lens(lens)
    count, at = (height, place[..., 1]) if along == "rows" else (width, place[..., 0])
    share = np.clip(at / max(count - 1, 1), 0, 1) if count > 1 else np.ones_like(at)
    return np.where(sees, 1 - share if backwards else share, np.float32(np.nan)).astype(np.float32)


def place_in_lens(lens: Lens) -> tuple[F32, np.ndarray]:
    """Return where the lens's picture shows each pixel of the covering pinhole, and which of them
    it shows.

    Returns:
        ``(h, w, 2)`` column and row, counted from the centre of the first pixel; far outside of the
        lens's picture some place beyond it. ``(h, w)`` true where the lens looks, and somewhat
        beyond, so that resampling finds its neighbours.
    """
    assert lens.resample is not None, "a lens that is its pinhole needs no inverse"
    size = np.array(lens.cover)
    nodes = [np.arange(-(-n // GRID_PX) + 1, dtype=np.float32) * GRID_PX for n in lens.cover]
    wanted = np.stack(np.meshgrid(*nodes), axis=-1)
    start = (
        (wanted * ([lens.width, lens.height] / size))
        .clip(0, [lens.width - 1, lens.height - 1])
        .astype(np.float32)
    )
    # Beyond its edges the lens goes on as it ends, so that pixels between an edge and the next node
    # are found as well.
    beyond = np.pad(
        lens.resample,
        ((MARGIN_PX, MARGIN_PX), (MARGIN_PX, MARGIN_PX), (0, 0)),
        mode="reflect",
        reflect_type="odd",
    )
    found = sought(beyond, wanted, start + MARGIN_PX) - np.float32(MARGIN_PX)
    inside = found[..., 0] >= -MARGIN_PX
    nearest = ndimage.distance_transform_edt(~inside, return_distances=False, return_indices=True)
    found = found[tuple(nearest)]
    columns, rows = (
        np.broadcast_to(part, size[::-1])
        for part in np.meshgrid(*(np.arange(n, dtype=np.float32) / GRID_PX for n in lens.cover))
    )
    place = cv2.remap(
        found, np.ascontiguousarray(columns), np.ascontiguousarray(rows), cv2.INTER_LINEAR
    )
    near = cv2.dilate(inside.astype(np.uint8), np.ones((3, 3), np.uint8))
    sees = cv2.remap(
        near, np.ascontiguousarray(columns), np.ascontiguousarray(rows), cv2.INTER_NEAREST
    )
    return place, sees.astype(bool)
