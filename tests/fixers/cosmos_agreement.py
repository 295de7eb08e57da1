"""Compare the semantic map with the publisher's own renders of a recorded clip, camera by camera.

The copy of the clip at hand has no camera extrinsics. The mounts in ``cosmos_mounts.json`` were
estimated from the renders themselves (`fit_mount`): six numbers a camera that make our lines,
boundaries and poles fall on the published ones in five frames; all 57 frames are compared.

    python -m tests.fixers.cosmos_agreement FOLDER            prints the table
    python -m tests.fixers.cosmos_agreement FOLDER --pictures docs/img   makes its pictures
    python -m tests.fixers.cosmos_agreement FOLDER --fit      estimates the mounts anew (minutes)

FOLDER holds ``example`` and ``example_outputs`` of Cosmos-Drive-Dreams (CC-BY-4.0, (c) NVIDIA).
"""

from __future__ import annotations

import argparse
import itertools
import json
from dataclasses import dataclass, replace
from pathlib import Path

import av
import cv2
import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from alpasim_plugin.core.geometry import se2, se3
from alpasim_plugin.core.types import F64, U8, Bool, Box, LaneMap
from alpasim_plugin.fixers.semantic_map.draw import FThetaCamera, draw_map
from alpasim_plugin.fixers.semantic_map.prepare import (
    ActorBox,
    Area,
    MapExtras,
    PreparedMap,
    prepare_map,
)
from alpasim_plugin.fixers.semantic_map.style import COLOURS, LUDUS, OPENGL, MapStyle
from scenarios.ftheta import FRONT_WIDE, orthonormal
from scenarios.recorded import SourceFiles
from tests.fixers.cosmos_clip import T_RIG_FRONT_WIDE, read_cosmos, read_layer, read_lenses

SIZE = (1280, 704)
N_FRAMES = 57
LIT = 40  # brightest channel above this: drawn; below lies the noise of the video's compression
WITHIN_PX = 3.0
MOUNTS = Path(__file__).with_name(
    "cosmos_mounts.json"
)  # camera -> x, y, z metres, rotation vector (camera to rig)

# As the sheet says, but every line solid and of one colour, as published.
SOLID = replace(OPENGL, name="opengl, untyped", typed_lines=False)
# As published: lines of one thickness that fade out at about 115 m and lose no width.
AS_PUBLISHED = replace(
    SOLID,
    name="as published",
    line_px=9.5,
    pole_px=9.5,
    ndc_widths=False,
    line_width_gain=1e3,
    depth_max_m=115.0,
    colours={
        **COLOURS,
        "road_boundary": (200, 36, 35),
        "pole": (66, 40, 144),
        "sign": (131, 175, 155),
    },
)


@dataclass(frozen=True)
class Agreement:
    """Shares of pixels, 0..1, over all frames of one camera."""

    ours: float  # of our lane and boundary pixels, those near a lit published pixel
    published: float  # of published lane and boundary pixels, those near one of our lit pixels
    published_all: float  # the same of all lit published pixels, actors included
    n_ours: int
    n_published: int


@dataclass(frozen=True)
class Clip:
    """What is compared: the map in the world, the drive, the lenses, the renders' folder."""

    lane_map: LaneMap
    extras: MapExtras
    T_world_rig: F64  # (T, 4, 4)
    cameras: dict[str, FThetaCamera]
    renders: Path

    def video(self, camera: str) -> list[U8]:
        """Decode the published render of a camera."""
        with av.open(str(next((self.renders / f"ftheta_{camera}").glob("*.mp4")))) as video:
            return [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]


def read_clip(folder: Path) -> Clip:
    """Read the clip and its renders' lenses, resized to the renders' size."""
    log = read_cosmos(folder / "example")
    files = SourceFiles()
    lenses = read_lenses(files, folder / "example")
    waits = read_layer(files, folder / "example", "3d_wait_lines")
    lane_map = replace(
        log.lane_map, stop_lines=tuple(label.lines[0] for label in waits)
    )  # published: implicit ones as well
    extras = MapExtras(
        areas=tuple(
            Area(label.lines[0])
            for label in read_layer(files, folder / "example", "3d_road_markings")
        )
    )
    renders = folder / "example_outputs" / "hdmap"
    names = sorted(p.name.removeprefix("ftheta_") for p in renders.iterdir())
    cameras = {
        name: FThetaCamera(
            name,
            k.width,
            k.height,
            k.cx,
            k.cy,
            k.lens,
            "pixel_to_angle" if k.backward_given else "angle_to_pixel",
        ).resized(*SIZE)
        for name, k in ((name, lenses[name]) for name in names)
    }
    return Clip(lane_map, extras, se3(log.ego_log.xyz, log.ego_log.quat), cameras, renders)


def mounts() -> dict[str, F64]:
    """Return the estimated mounts, camera to rig."""
    return {name: mount(np.array(six)) for name, six in json.loads(MOUNTS.read_text()).items()}


def mount(six: F64) -> F64:
    """Return the transform of a position and a rotation vector."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(six[3:]).as_matrix(), six[:3]
    return T


def only_lines(clip: Clip, style: MapStyle) -> PreparedMap:
    """Prepare lane lines and road boundaries alone."""
    bare = replace(clip.lane_map, crosswalks=(), stop_lines=(), poles=(), signs=())
    return prepare_map(bare, style=style)


def published_layers(image: U8) -> tuple[Bool, Bool, Bool]:
    """Tell lane lines, road boundaries and poles of the published palette apart, each ``(H, W)``.

    Layers were added up there: a lane line behind a red box is pink. Boundaries are (200, 36, 35),
    boxes pure red, poles violet, signs grey green. The video's coarser colours tint the outlines of
    boxes like boundaries: what is thinner than 5 px is no line, for lines have 9.
    """
    r, g, b = (image[..., k].astype(int) for k in range(3))
    lane = (b > 50) & (g > 0.45 * b) & (g < 0.88 * b)
    boundary = (r > 50) & (g > 0.11 * r) & (g < 0.35 * r) & (b < 0.35 * r)
    pole = (b > 22) & (b > 1.6 * r) & (g < 0.45 * b)
    block = np.ones((5, 5), np.uint8)
    lane, boundary = (
        cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, block) > 0
        for mask in (lane, boundary)
    )
    return lane, boundary, pole


def near(points: Bool, others: Bool) -> int:
    """Count the points that lie within `WITHIN_PX` of another mask."""
    if not others.any():
        return 0
    distance = cv2.distanceTransform((~others).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return int((distance[points] <= WITHIN_PX).sum())


def compare(
    clip: Clip, camera: str, T_rig_camera: F64, style: MapStyle, every: int = 1
) -> Agreement:
    """Compare one camera's frames."""
    lines, everything = only_lines(clip, style), prepare_map(clip.lane_map, clip.extras, style)
    hit = np.zeros(3)
    total = np.zeros(3)
    for i, image in enumerate(clip.video(camera)[:N_FRAMES]):
        if i % every:
            continue
        pose = clip.T_world_rig[i] @ T_rig_camera
        ours = draw_map(lines, clip.cameras[camera], pose).max(axis=2) > LIT
        ours_all = draw_map(everything, clip.cameras[camera], pose).max(axis=2) > LIT
        lane, boundary, _ = published_layers(image)
        lit = image.max(axis=2) > LIT
        theirs = (lane | boundary) & lit
        hit += near(ours, lit), near(theirs, ours_all), near(lit, ours_all)
        total += ours.sum(), theirs.sum(), lit.sum()
    share = hit / np.maximum(total, 1)
    return Agreement(
        float(share[0]), float(share[1]), float(share[2]), int(total[0]), int(total[1])
    )


# --- estimating mounts

# Plausible mounts to start from: yaw degrees, x, y, z metres.
NOMINAL = {
    "camera_cross_left_120fov": (60.0, 2.3, 0.95, 1.0),
    "camera_cross_right_120fov": (-60.0, 2.3, -0.95, 1.0),
    "camera_rear_left_70fov": (153.0, 1.9, 0.95, 1.0),
    "camera_rear_right_70fov": (-153.0, 1.9, -0.95, 1.0),
    "camera_rear_tele_30fov": (180.0, -0.5, 0.0, 1.5),
}
_FIT = replace(
    AS_PUBLISHED,
    samples=1,
    colours={
        **COLOURS,
        "line_untyped": (0, 0, 255),
        "road_boundary": (255, 0, 0),
        "pole": (0, 255, 0),
    },
)


def nominal(yaw_deg: float, x: float, y: float, z: float, pitch_deg: float = 0.0) -> F64:
    """Return a mount that looks along the yaw, level or pitched up."""
    forward = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("zy", [yaw_deg, -pitch_deg], degrees=True).as_matrix() @ forward
    T[:3, 3] = x, y, z
    return T


class _Misfit:
    """Squared difference between blurred masks of our layers and the published ones, as a function
    of six corrections of a mount.
    """

    def __init__(self, clip: Clip, camera: str, frames: tuple[int, ...], scale: float) -> None:
        self.scene = prepare_map(
            replace(clip.lane_map, crosswalks=(), stop_lines=(), signs=()), style=_FIT
        )
        self.lens = clip.cameras[camera].resized(int(SIZE[0] * scale), int(SIZE[1] * scale))
        self.poses, self.scale = clip.T_world_rig[list(frames)], scale
        video = clip.video(camera)
        size = (self.lens.width, self.lens.height)
        masks = [
            np.stack(published_layers(video[i]), axis=2)[..., [1, 2, 0]].astype(np.float32)
            for i in frames
        ]
        self.masks = [cv2.resize(mask, size, interpolation=cv2.INTER_AREA) for mask in masks]

    def corrected(self, T: F64, p: F64) -> F64:
        out = T.copy()
        out[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(p[:3]).as_matrix()
        out[:3, 3] += p[3:]
        return out

    def __call__(self, p: F64, T: F64, blur_px: float) -> float:
        mount_ = self.corrected(T, p)
        error = 0.0
        norm = 0.0
        for pose, mask in zip(self.poses, self.masks, strict=True):
            ours = np.minimum(
                draw_map(self.scene, self.lens, pose @ mount_).astype(np.float32) / 100, 1
            )
            soft = [cv2.GaussianBlur(image, (0, 0), blur_px * self.scale) for image in (ours, mask)]
            error += float((np.square(soft[0] - soft[1]) * np.array([1, 3, 1])).sum())
            norm += float(np.square(soft[1]).sum())
        return error / norm + 0.002 * float(
            np.square(p[3:]).sum()
        )  # what the lines do not fix stays near the nominal place

    def refine(self, T: F64, blurs_px: tuple[float, ...], budget: int = 300) -> tuple[F64, float]:
        p, value = np.zeros(6), np.inf
        for blur_px in blurs_px:
            step = np.array([0.02] * 3 + [0.15] * 3) * blur_px / 8
            simplex = np.vstack([p, p + np.diag(step)])
            options = {"initial_simplex": simplex, "maxfev": budget, "xatol": 1e-4, "fatol": 1e-5}
            found = minimize(self, p, args=(T, blur_px), method="Nelder-Mead", options=options)
            p, value = found.x, float(found.fun)
        return self.corrected(T, p), value


def fit_mount(clip: Clip, camera: str) -> F64:
    """Estimate a mount: a coarse grid around the nominal one, then three blurs from wide to
    narrow.
    """
    if camera == FRONT_WIDE:
        start = orthonormal(T_RIG_FRONT_WIDE)
    else:
        coarse = _Misfit(clip, camera, (0, 28, 56), 0.25)
        yaw, x, y, _ = NOMINAL[camera]
        places = itertools.product(range(-12, 13, 3), range(-6, 7, 2), (0.8, 1.2, 1.6))
        grid = [nominal(yaw + turn, x, y, z, pitch) for turn, pitch, z in places]
        best = sorted((coarse(np.zeros(6), T, 24.0), k) for k, T in enumerate(grid))[:3]
        start = min((coarse.refine(grid[k], (24.0, 12.0)) for _, k in best), key=lambda r: r[1])[0]
    return _Misfit(clip, camera, (0, 14, 28, 42, 56), 0.5).refine(start, (12.0, 6.0, 3.0))[0]


# --- picture and table


def overlay(clip: Clip, camera: str, frame: int) -> U8:
    """Show a published frame with the middles of our lane lines and boundaries over it in green."""
    thin = only_lines(clip, replace(AS_PUBLISHED, line_px=2.0))
    ours = draw_map(thin, clip.cameras[camera], clip.T_world_rig[frame] @ mounts()[camera]).max(
        axis=2
    )
    out = clip.video(camera)[frame].copy()
    out[ours > LIT] = (0, 255, 0)
    return out


def picture(clip: Clip, frame: int = 28) -> U8:
    """Return the six overlays of one frame, two a row, without the empty sky."""
    tiles = []
    for camera in clip.cameras:
        tile = cv2.resize(
            overlay(clip, camera, frame)[144:], (960, 420), interpolation=cv2.INTER_AREA
        )
        cv2.putText(
            tile, camera, (12, 28), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (255, 255, 0), 1, cv2.LINE_AA
        )
        tiles.append(np.pad(tile, ((2, 2), (2, 2), (0, 0)), constant_values=90))
    return np.concatenate(
        [np.concatenate(tiles[k : k + 2], axis=1) for k in range(0, len(tiles), 2)]
    )


def example(clip: Clip, frame: int = 28) -> U8:
    """Return the front camera in both styles, one above the other, with road users put there by
    hand.
    """
    rig = clip.T_world_rig[frame]
    places = [
        (12, -4, 0.1, Box(4.5, 1.9, 1.6), "car"),
        (25, 4, 3.1, Box(9, 2.5, 3.2), "truck"),
        (40, 0, 0.0, Box(1, 1, 1), "other"),
    ]
    places += [
        (14, 7, 1.0, Box(0.6, 0.6, 1.8), "pedestrian"),
        (9, 2.2, 0.0, Box(1.8, 0.7, 1.7), "cyclist"),
    ]
    boxes = tuple(
        ActorBox(rig @ se2(x, y, yaw, box.height_m / 2), box, label)
        for x, y, yaw, box, label in places
    )
    pose, camera = rig @ mounts()[FRONT_WIDE], clip.cameras[FRONT_WIDE]
    scenes = [prepare_map(clip.lane_map, clip.extras, style) for style in (OPENGL, LUDUS)]
    return np.concatenate([draw_map(scene, camera, pose, boxes)[330:] for scene in scenes])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--fit", action="store_true")
    parser.add_argument("--pictures", type=Path)
    options = parser.parse_args()
    clip = read_clip(options.folder)
    if options.fit:
        six = {}
        for camera in clip.cameras:
            T = fit_mount(clip, camera)
            six[camera] = [
                round(float(v), 5)
                for v in (*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_rotvec())
            ]
            print(camera, six[camera], flush=True)
        MOUNTS.write_text(json.dumps(six, indent=1) + "\n")
    if options.pictures:
        cv2.imwrite(
            str(options.pictures / "conditioning-overlay.jpg"),
            picture(clip)[..., ::-1],
            [cv2.IMWRITE_JPEG_QUALITY, 92],
        )
        cv2.imwrite(str(options.pictures / "conditioning-styles.png"), example(clip)[..., ::-1])
        return
    rows = [
        (camera, T, style)
        for camera, T in mounts().items()
        for style in (AS_PUBLISHED, SOLID, OPENGL)
    ]
    rows.insert(0, (FRONT_WIDE, orthonormal(T_RIG_FRONT_WIDE), SOLID))
    for camera, T, style in rows:
        a = compare(clip, camera, T, style)
        print(
            f"{camera:28s} {style.name:16s} ours {a.ours:7.2%}  published {a.published:7.2%}  all lit {a.published_all:7.2%}",
            flush=True,
        )


if __name__ == "__main__":
    main()
