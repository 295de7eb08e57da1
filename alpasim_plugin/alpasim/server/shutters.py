"""When each pixel of a requested frame is exposed: the shutter of the request's camera, carried
into the pinhole that is rendered.

A rolling shutter exposes the sensor's rows (or columns) one after another, the first at shutter
start and the last at its end: the row i of H is seen from the pose at i / (H - 1) of the way, as
NVIDIA's renderers do it. The row is that of the lens, so its pixels lie on a curve in a pinhole
that covers the lens.
"""

from collections.abc import Mapping

from alpasim_plugin.alpasim.server.lens_cache import lenses
from alpasim_plugin.alpasim.server.views import View, camera_of
from alpasim_plugin.cameras.lens import Lens, lens_shares
from alpasim_plugin.cameras.shutter import Along, rolling
from alpasim_plugin.core.types import F32, F64, Exposure
from alpasim_plugin.log.wire import sensorsim_pb2

ROLLS: Mapping[int, tuple[Along, bool]] = {
    sensorsim_pb2.ROLLING_TOP_TO_BOTTOM: ("rows", False),
    sensorsim_pb2.ROLLING_BOTTOM_TO_TOP: ("rows", True),
    sensorsim_pb2.ROLLING_LEFT_TO_RIGHT: ("columns", False),
    sensorsim_pb2.ROLLING_RIGHT_TO_LEFT: ("columns", True),
}


def exposure_of(
    spec: sensorsim_pb2.CameraSpec, view: View, side: Lens, actors: Mapping[str, F64]
) -> Exposure | None:
    """Return when the pixels of a covering pinhole are exposed; None: all at the shutter's end.

    Args:
        spec: The request's intrinsics; a shutter of which they say nothing does not roll.
        view: The request.
        side: The pinhole, one of those of the request's lens.
        actors: Every road user's box pose at shutter end.
    """
    rolls = ROLLS.get(spec.shutter_type)
    if rolls is None or view.start_us == view.t_us:
        return None
    variant = ("shares", view.width, view.height, side.side, *rolls)
    share = lenses.get(spec, variant, lambda: _shares(spec, view, side, *rolls))
    return Exposure(share, _boxes_at_start(view, actors))


def lens_exposure(
    spec: sensorsim_pb2.CameraSpec, view: View, actors: Mapping[str, F64]
) -> Exposure | None:
    """Return when the rows or columns of a lens's image are exposed; see `exposure_of`."""
    rolls = ROLLS.get(spec.shutter_type)
    if rolls is None or view.start_us == view.t_us:
        return None
    return Exposure(rolling(view.width, view.height, *rolls), _boxes_at_start(view, actors))


def _boxes_at_start(view: View, actors: Mapping[str, F64]) -> dict[str, F64]:
    return {
        name: view.objects[name][0] if name in view.objects else T for name, T in actors.items()
    }


def _shares(
    spec: sensorsim_pb2.CameraSpec, view: View, side: Lens, along: Along, backwards: bool
) -> F32:
    if side.resample is None:
        return rolling(view.width, view.height, along, backwards)
    return lens_shares(camera_of(spec, view.width, view.height), side, along, backwards)
