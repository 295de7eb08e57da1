"""The pinholes that cover the lenses of cameras: what is asked of them, and what a lens shows of
their frames.
"""

from collections.abc import Sequence
from dataclasses import replace

from alpasim_plugin.cameras.lens import (
    blind_of,
    check_lens,
    joined,
    lens_shares,
    part_of,
    sides_of,
)
from alpasim_plugin.core.types import F32, CameraSpec, Frame, RenderRequest, Scenario


class LensCover:
    """The lenses of some cameras; a camera without a lens is its own pinhole.

    Args:
        cameras: Of a scenario.

    Attributes:
        sides: The pinholes of each camera with a lens, by its name.
        blind: See `blind_of`, likewise.

    Raises:
        InputError: See `check_lens`.
    """

    def __init__(self, cameras: Sequence[CameraSpec] = ()) -> None:
        for camera in cameras:
            check_lens(camera)
        self.sides = {
            camera.name: sides_of(camera) for camera in cameras if camera.lens is not None
        }
        self.blind = {name: blind_of(sides) for name, sides in self.sides.items()}
        self._shares: dict[tuple[str, str], F32] = {}

    def drawn(self, scenario: Scenario) -> Scenario:
        """Return a scenario with the pinholes in place of its cameras."""
        pinholes = [one for camera in scenario.cameras for one in self.pinholes(camera)]
        return replace(scenario, cameras=tuple(pinholes))

    def pinholes(self, camera: CameraSpec) -> list[CameraSpec]:
        """Return the pinholes of a camera."""
        if camera.lens is None:
            return [camera]
        mounted = camera.name, camera.T_rig_camera, camera.shutter_us
        return [side.spec(*mounted) for side in self.sides[camera.name]]

    def requests(self, request: RenderRequest) -> list[RenderRequest]:
        """Return the requests of the pinholes of a request's camera."""
        camera = request.camera
        if camera.lens is None:
            return [request]
        sides = self.sides[camera.name]
        if request.exposure is None:
            return [part_of(request, side) for side in sides]
        for side in sides:
            key = camera.name, side.side
            if key not in self._shares:
                self._shares[key] = lens_shares(camera, side, "rows", backwards=False)
        return [part_of(request, side, self._shares[camera.name, side.side]) for side in sides]

    def frame(self, camera: str, frames: Sequence[Frame]) -> Frame:
        """Return a camera's frame of those of its pinholes."""
        return joined(camera, self.sides[camera], frames) if camera in self.sides else frames[0]
