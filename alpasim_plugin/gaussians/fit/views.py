"""Hold posed views, and take them from a scene along a log."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from alpasim_plugin.cameras.lens import resized as resized_camera
from alpasim_plugin.core.geometry import interpolate, shifted
from alpasim_plugin.core.types import F32, F64, U8, Bool, Scenario
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.lens_camera import LensCamera
from alpasim_plugin.gaussians.scene.log_views import log_actors
from alpasim_plugin.gaussians.scene.scene_graph import SceneGraph

AREA: F32 = np.array([0.25, 0.5, 0.25], dtype=np.float32)  # of a pixel of half the size, in pixels


@dataclass(frozen=True, eq=False)
class PosedView:
    """One image of which it is known from where it was taken.

    Attributes:
        camera: From where, through a lens where the image has its distortion.
        rgb: ``(H, W, 3)`` uint8 sRGB.
        name: For messages and file names; up to the last ``-`` it names the camera.
        sky: ``(H, W)`` bool, where the image shows sky; None where that is unknown.
        mask: ``(H, W)`` bool, which pixels count (not the bonnet, say); None counts all.
        depth: ``(H, W)`` float32, metres along the optical axis, of a lens from the camera's centre,
            0 where unknown; a start is drawn from it, and a fit may be held to it.
        actors: Actor id to ``T_world_box (4, 4)`` of the actors present.
        gain: Of red, green and blue over the model's colours: the photograph's exposure and white
            balance.
        t_us: When it was taken, where that is known.
    """

    camera: PinholeCamera | LensCamera
    rgb: U8
    name: str = "view"
    sky: Bool | None = None
    mask: Bool | None = None
    depth: F32 | None = None
    actors: Mapping[str, F64] = field(default_factory=dict)
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)
    t_us: int = 0

    @property
    def camera_name(self) -> str:
        """Return the name of the camera that took it."""
        return camera_of(self.name)

    @property
    def pinhole(self) -> PinholeCamera:
        """Return the camera of a view without distortion."""
        assert isinstance(self.camera, PinholeCamera), "a view through a lens"
        return self.camera


def camera_of(view: str) -> str:
    """Return the name of the camera that took a view, by the view's name."""
    return view.rpartition("-")[0]


def logged_views(
    scenario: Scenario,
    scene: SceneGraph,
    count: int,
    width: int,
    *,
    lateral_m: float = 0.0,
    threads: int | None = None,
) -> list[PosedView]:
    """Render what the scenario's cameras see along its log.

    Args:
        scenario: The log, the cameras and the actors' tracks.
        scene: What is there to see: the scene as built, or another model of it.
        count: Views in all; several cameras share them.
        width: Pixels across of an image of 16:9; others have as many in all.
        lateral_m: Moves the rig to its left (paper, App. A, cycle render); 0 stays on the log.
        threads: Of the rasteriser.

    Returns:
        Views with sky, depth and actors; in order of time, the cameras of an instant together.
        Where the scene's opacity is below one half the view shows sky, in place of the segmentation
        that recorded images need.
    """
    shift = shifted(0.0, lateral_m)
    views = []
    log = scenario.ego_log.t_us
    instants = max(1, count // max(1, len(scenario.cameras)))
    times = np.unique(np.linspace(log[0], log[-1], instants).round().astype(np.int64))
    for t_us in times.tolist():
        T_world_rig = interpolate(scenario.ego_log, t_us) @ shift
        actors = log_actors(scenario, t_us)
        for spec in scenario.cameras:
            scale = min(1.0, width / np.sqrt(spec.width * spec.height * 16 / 9))
            w = max(1, round(spec.width * scale))
            h = max(1, round(spec.height * scale))
            K = spec.K.copy()
            K[0] *= w / spec.width
            K[1] *= h / spec.height
            camera = PinholeCamera.from_pose(w, h, K, T_world_rig @ spec.T_rig_camera)
            name = f"{spec.name}-{t_us}"
            view = seen_from(camera, scene, actors, name, threads, float(spec.K[0, 0]))
            views.append(replace(view, t_us=t_us))
    return views


def seen_from(
    camera: PinholeCamera | LensCamera,
    scene: SceneGraph,
    actors: Mapping[str, F64],
    name: str,
    threads: int | None = None,
    px_per_rad: float | None = None,
) -> PosedView:
    """Render one view with its sky and depth; see `SceneGraph.render`."""
    out = scene.render(camera, actors, threads, px_per_rad=px_per_rad)
    return PosedView(
        camera,
        out.to_uint8(),
        name,
        sky=out.alpha <= 0.5,
        depth=np.where(out.alpha > 0.5, out.depth, 0),
        actors=dict(actors),
    )


def halved(view: PosedView) -> PosedView:
    """Return a view of half the width and height, whose pixels have their middles where every second
    pixel of the view has them, in rows and columns: so the depth is that of those pixels.

    A pixel shows the mean of an area of two by two pixels about its middle; it is sky, or counts,
    where all that the area touches do.
    """
    h = view.camera.height // 2
    w = view.camera.width // 2
    every_second = slice(0, 2 * h, 2), slice(0, 2 * w, 2)
    # Half of a pixel's neighbours lies in the area.
    rgb = cv2.sepFilter2D(view.rgb, -1, AREA, AREA, borderType=cv2.BORDER_REPLICATE)

    def touched(flags: Bool | None) -> Bool | None:
        if flags is None:
            return None
        whole = cv2.erode(flags.astype(np.uint8), np.ones((3, 3), dtype=np.uint8))
        return np.asarray(whole[every_second] > 0, dtype=np.bool_)

    return replace(
        view,
        camera=_half_camera(view.camera),
        rgb=np.ascontiguousarray(rgb[every_second]),
        sky=touched(view.sky),
        mask=touched(view.mask),
        depth=None if view.depth is None else np.ascontiguousarray(view.depth[every_second]),
    )


def _half_camera(camera: PinholeCamera | LensCamera) -> PinholeCamera | LensCamera:
    """Return the camera of `halved`: the first pixel's middle is at 0.5 in both images."""
    h = camera.height // 2
    w = camera.width // 2
    if isinstance(camera, LensCamera):
        even = replace(camera.spec, width=2 * w, height=2 * h)
        small = resized_camera(even, w, h)
        K = small.K + np.array([[0, 0, 0.25], [0, 0, 0.25], [0, 0, 0]])
        return replace(camera, spec=replace(small, K=K))
    K = camera.K.copy()
    K[:2] /= 2
    K[:2, 2] += 0.25
    return PinholeCamera(w, h, K, camera.T_camera_world)
