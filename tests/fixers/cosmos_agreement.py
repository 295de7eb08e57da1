"""Compare the semantic map with the publisher's own renders of a recorded clip, camera by camera.

The renders are f-theta images; they are looked up through a pinhole inside the lens, which is what
we draw. The copy of the clip at hand has no camera extrinsics. The mounts in ``cosmos_mounts.json``
were estimated from five frames of the renders: six numbers a camera that make our lines, boundaries
and poles fall on the published ones; all 57 frames are compared. Published lines are solid and of
one colour, so that ours are drawn solid for the comparison.

The clip is of Cosmos-Drive-Dreams (CC-BY-4.0, (c) NVIDIA).
"""

import json
import re
from dataclasses import dataclass, replace
from pathlib import Path

import av
import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from alpasim_plugin.core.types import F64, CameraSpec, LaneMap
from alpasim_plugin.fixers.semantic_map.draw import draw_map
from alpasim_plugin.fixers.semantic_map.prepare import prepare_map
from tests.fixers.cosmos_clip import read_lenses, read_map, read_poses
from tests.scenarios.ftheta_projection import RecordedLens, project_ftheta

WIDTH = 1280
HEIGHT = 704
N_FRAMES = 57
LIT = 40  # brightest channel above this: drawn; below lies the noise of the video's compression
NEARER = 255 * (1 - 115 / 200)  # our lines are brighter up to 115 m; published ones end there
WITHIN_PX = 3.0
WIDEST_DEG = 90.0
MOUNTS = Path(__file__).with_name(
    "cosmos_mounts.json"
)  # camera -> x, y, z metres, rotation vector (camera to rig)


@dataclass(frozen=True)
class Agreement:
    """Shares of pixels, 0..1, over all frames of one camera."""

    ours: float  # of our lane and boundary pixels, those near a lit published pixel
    published: float  # of published lane and boundary pixels, those near one of our lit pixels
    n_ours: int
    n_published: int


@dataclass(frozen=True)
class Clip:
    """What is compared: the map in the world, the drive, the lenses, the renders' folder."""

    lane_map: LaneMap
    T_world_rig: F64  # (T, 4, 4)
    lenses: dict[str, RecordedLens]
    renders: Path

    def video(self, name):
        """Decode the published render of a camera, as its pinhole shows it; and where it does."""
        camera = pinhole(name)
        v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
        rays = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3)
        lens = self.lenses[name]
        pixels = project_ftheta(lens, rays @ np.linalg.inv(camera.K).T)
        pixels *= (WIDTH / lens.width, HEIGHT / lens.height)
        x, y = np.nan_to_num(pixels - 0.5, nan=-9.0).astype(np.float32).T.reshape(2, HEIGHT, WIDTH)
        shown = (x >= 0) & (x <= WIDTH - 1) & (y >= 0) & (y <= HEIGHT - 1)
        with av.open(str(next((self.renders / f"ftheta_{name}").glob("*.mp4")))) as video:
            images = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
        return [cv2.remap(image, x, y, cv2.INTER_LINEAR) for image in images], shown


def pinhole(name):
    """Return the pinhole inside the lens of a camera whose name ends in its angle."""
    found = re.search(r"(\d+)fov", name)
    assert found
    half = np.deg2rad(min(float(found[1]), WIDEST_DEG) / 2 - 1)
    focal = WIDTH / 2 / np.tan(half)
    K = np.array([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1.0]])
    return CameraSpec(name, WIDTH, HEIGHT, K, np.eye(4))


def read_clip(folder):
    """Read the clip and its lenses."""
    source = folder / "example"
    renders = folder / "example_outputs" / "hdmap"
    return Clip(read_map(source), read_poses(source), read_lenses(source), renders)


def mounts():
    """Return the estimated mounts, camera to rig."""
    out = {}
    for name, six in json.loads(MOUNTS.read_text()).items():
        out[name] = np.eye(4)
        out[name][:3, :3] = Rotation.from_rotvec(six[3:]).as_matrix()
        out[name][:3, 3] = six[:3]
    return out


def published_layers(image):
    """Tell lane lines, road boundaries and poles of the published palette apart, each ``(H, W)``.

    Layers were added up there: a lane line behind a red box is pink. Boundaries are (200, 36, 35),
    boxes pure red, poles violet, signs grey green. The video's coarser colours tint the outlines of
    boxes like boundaries: what is thinner than 5 px is no line, for lines have 9.
    """
    r, g, b = (image[..., k].astype(int) for k in range(3))
    lane = (b > 50) & (g > 0.45 * b) & (g < 0.88 * b)
    boundary = (r > 50) & (g > 0.11 * r) & (g < 0.35 * r) & (b < 0.35 * r)
    pole = (b > 22) & (b > 1.6 * r) & (g < 0.45 * b)
    block = np.ones((5, 5), dtype=np.uint8)
    lane, boundary = (
        cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, block) > 0
        for mask in (lane, boundary)
    )
    return lane, boundary, pole


def near(points, others):
    """Count the points that lie within `WITHIN_PX` of another mask."""
    if not others.any():
        return 0
    distance = cv2.distanceTransform((~others).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return int((distance[points] <= WITHIN_PX).sum())


def compare(clip, name, T_rig_camera, every=1):
    """Compare one camera's frames."""
    bare = replace(clip.lane_map, crosswalks=(), stop_lines=(), poles=(), signs=())
    lines = prepare_map(bare)
    everything = prepare_map(clip.lane_map)
    camera = pinhole(name)
    hit = np.zeros(2)
    total = np.zeros(2)
    images, shown = clip.video(name)
    for i, image in enumerate(images[:N_FRAMES]):
        if i % every:
            continue
        pose = clip.T_world_rig[i] @ T_rig_camera
        ours = (draw_map(lines, camera, pose).max(axis=2) > NEARER) & shown
        ours_all = draw_map(everything, camera, pose).max(axis=2) > LIT
        lane, boundary, _ = published_layers(image)
        lit = image.max(axis=2) > LIT
        theirs = (lane | boundary) & lit
        hit += near(ours, lit), near(theirs, ours_all)
        total += ours.sum(), theirs.sum()
    share = hit / np.maximum(total, 1)
    return Agreement(float(share[0]), float(share[1]), int(total[0]), int(total[1]))
