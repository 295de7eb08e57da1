"""The newest frame of a policy's camera, checked."""

from __future__ import annotations

from alpasim_plugin.core.errors import PolicyError
from alpasim_plugin.core.types import CameraSpec, Frame, Observation


def camera_frame(observation: Observation, camera: CameraSpec, policy: str) -> Frame:
    """Return the newest frame of a camera.

    Args:
        observation: What the policy is given.
        camera: Which camera, and at which size.
        policy: Name of the policy, for the error.

    Raises:
        PolicyError: The observation has no frame of the camera, or one of another size.
    """
    frame = observation.frames.get(camera.name)
    expected = (camera.height, camera.width, 3)
    if frame is None or frame.rgb.shape != expected:
        found = f"frames of {sorted(observation.frames)}" if frame is None else f"a frame of shape {frame.rgb.shape}"
        raise PolicyError(
            "planning by camera",
            f"policy {policy!r} at {observation.t_us} us",
            f"{found}; needed is {camera.name!r} of shape {expected}",
            "render the cameras that the policy names in `sensors`, at the scenario's size",
        )
    return frame
