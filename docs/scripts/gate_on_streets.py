"""How often is the truth gate of `simrun serve` wrong on real streets, with the right map and with
wrong ones?

python docs/scripts/gate_on_streets.py drives STREET/scenario.yaml[:OFFSET,...] ...   imported drives: photographs, and renders of `3dgs`
python docs/scripts/gate_on_streets.py clips COSMOS_TRANSFER/posttrain                recorded clips with their own pictures of the map

OFFSET: where the street has a painted line, metres to the left of the driven path. Every 10 m the
    line is then put where every second
photograph shows it; the other photographs are judged. Without offsets the street has no paint, and
its map claims a line on both sides.
"""

from __future__ import annotations

import io
import sys
import tarfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from served_frames import verdict

from alpasim_plugin.alpasim.server import map_gate
from alpasim_plugin.core.geometry import interpolate, se2
from alpasim_plugin.core.interfaces import Renderer
from alpasim_plugin.core.types import (
    F64,
    U8,
    Bool,
    CameraSpec,
    LaneMap,
    Marking,
    Photograph,
    RenderRequest,
    Scenario,
)
from alpasim_plugin.fixers.semantic_map.prepare import PreparedMap, prepare_map
from alpasim_plugin.renderers.reconstruction import ImportedRenderer
from alpasim_plugin.renderers.recorded import posed_photograph
from scenarios.cosmos_camera import RecordedLens, lens_of
from scenarios.load import load_scenario

OTHERS = ("smoke/curve", "urban/avenue_traffic", "highway/ramp")  # other streets
EDGE_M = 1.75
STATION_M = 10.0
NEAR_M = 0.6
HEIGHT_M = 1.4  # of the clips' cameras above the road, about
Found = tuple[
    str, str, str
]  # what shows the street, what is wrong with the map, what the gate says


def stations(scenario: Scenario) -> F64:
    """Return the rig's pose ``(N, 4, 4)`` every metre of the driven path."""
    poses = np.stack(
        [
            interpolate(scenario.ego_log, int(t))
            for t in np.linspace(*scenario.ego_log.t_us[[0, -1]], 3000)
        ]
    )
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)))
    return np.asarray(poses[np.searchsorted(way, np.arange(0.0, way[-1], 1.0))])


def line_beside(path: F64, offset_m: F64 | float) -> F64:
    """Return the line ``(N, 3)`` some metres to the left of a path ``(N, 4, 4)``."""
    return np.asarray(path[:, :3, 3] + np.reshape(offset_m, (-1, 1)) * path[:, :3, 1])


def seen_at(path: F64, offset_m: float, photographs: list[Photograph]) -> F64:
    """Return how far to the left of each station ``(N,)`` the photographs show a line of about that
    offset.
    """
    aside = np.arange(offset_m - NEAR_M, offset_m + NEAR_M, 0.05)
    points = np.stack([line_beside(path, one) for one in aside], axis=1)
    paint = np.zeros(points.shape[:2])
    for one in photographs:
        camera, rgb = posed_photograph(one, 960)
        p = points @ camera.T_camera_world[:3, :3].T + camera.T_camera_world[:3, 3]
        ahead = (p[..., 2] > 6) & (p[..., 2] < 25)
        z = np.where(ahead, p[..., 2], 1.0)
        u, v = camera.fx * p[..., 0] / z + camera.cx, camera.fy * p[..., 1] / z + camera.cy
        inside = ahead & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
        paint[inside] += map_gate.top_hat(rgb)[v[inside].astype(int), u[inside].astype(int)]
    near = np.abs(np.arange(len(path))[:, None] - np.arange(len(path))) <= STATION_M
    bright = near @ np.maximum(paint - np.median(paint, axis=1, keepdims=True), 0)
    return np.asarray((bright @ aside) / np.maximum(bright.sum(axis=1), 1e-9))


def street_map(
    scenario: Scenario, offsets: list[float], photographs: list[Photograph]
) -> PreparedMap:
    """Return the map of a street: its painted lines, or without any a line on both sides of the
    driven path.
    """
    path = stations(scenario)
    shown = [line_beside(path, seen_at(path, one, photographs)) for one in offsets]
    lines = shown or [line_beside(path, side) for side in (-EDGE_M, EDGE_M)]
    return prepare_map(LaneMap({}, markings=tuple(Marking(line, "solid_white") for line in lines)))


def drives(streets: list[str]) -> Iterator[Found]:
    """Yield what the gate says of imported drives."""
    others = [load_scenario(name) for name in OTHERS]
    for street in streets:
        name, _, offsets = street.partition(":")
        scenario = load_scenario(name)
        front = [one for one in scenario.recording if one.camera == scenario.cameras[0].name]
        scene_map = street_map(
            scenario, [float(one) for one in offsets.split(",")] if offsets else [], front[::2]
        )
        wrong = [
            (prepare_map(one.lane_map), interpolate(one.ego_log, one.start_us + 2_000_000))
            for one in others
        ]
        right = "right" if offsets else "with lines that the street has not"
        for one in front[1::2]:
            yield from judged(
                scenario, ImportedRenderer(scenario, "cpu", 1), one, {right: scene_map}, wrong
            )


def judged(
    scenario: Scenario,
    renderer: Renderer,
    one: Photograph,
    maps: dict[str, PreparedMap],
    wrong: list[tuple[PreparedMap, F64]],
) -> Iterator[Found]:
    """Yield what the gate says of a photograph, and of renders at its place and a metre to its
    left.
    """
    camera, rgb = posed_photograph(one, map_gate.WIDTH_PX)
    mount, T = scenario.cameras[0].T_rig_camera, np.linalg.inv(camera.T_camera_world)
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    spec = CameraSpec(one.camera, camera.width, camera.height, K, mount)
    pictures = {"photographs": (T, rgb, 0.0)}
    for aside_m in (0.0, 1.0):
        at = T @ np.linalg.inv(mount) @ se2(0, aside_m, 0) @ mount
        render = renderer.render(RenderRequest(one.t_us, spec, np.stack([at] * 2), {})).rgb
        pictures[f"`3dgs`, {aside_m:g} m aside"] = at, render, aside_m
    ((label, scene_map),) = maps.items()
    wrong_m = {label: 0.0} | (
        {"half a lane to the right": 1.75, "half a lane to the left": -1.75, "0.9 m aside": 0.9}
        if label == "right"
        else {}
    )
    for shown, (at, picture, beside_m) in pictures.items():
        for case, aside_m in wrong_m.items():
            moved = at.copy()
            moved[:3, 3] += aside_m * map_gate.leftwards(at)
            yield (
                f"{scenario.scene_id}, {shown}",
                case,
                verdict(scene_map, spec, moved, [], picture, beside_m),
            )
        for other, rig in wrong:
            yield (
                f"{scenario.scene_id}, {shown}",
                "of another street",
                verdict(other, spec, rig @ mount, [], picture, beside_m),
            )


def clips(folder: Path) -> Iterator[Found]:
    """Yield what the gate says of recorded clips; their pictures of the map are moved as a flat
    road's would.
    """
    lenses = {}
    with tarfile.open(folder.parent / "default_ftheta_intrinsic.tar") as tar:
        for member in tar.getmembers():
            file = tar.extractfile(member)
            assert file is not None, "a tar of plain files"
            lenses[member.name.rsplit(".", 2)[-2]] = lens_of(
                np.asarray(np.load(io.BytesIO(file.read())), np.float64)
            )
    before: list[Bool] = []
    for path in sorted((folder / "videos").rglob("*.mp4")):
        lens = lenses[path.parent.name.removeprefix("ftheta_")]
        there = folder / "control_input_hdmap_bbox" / path.parent.name / path.name
        drawn = [
            map_gate.line_pixels(pinhole(one, lens, cv2.INTER_NEAREST))
            for one in every_fifth(there)
        ]
        for i, picture in enumerate(every_fifth(path)):
            paint = map_gate.top_hat(pinhole(picture, lens, cv2.INTER_AREA))
            cases = {
                "right": (drawn[i], 0.0),
                "half a lane to the right": (drawn[i], 1.75),
                "half a lane to the left": (drawn[i], -1.75),
            }
            cases |= {"of another camera": (before[i], 0.0)} if before else {}
            for case, (lines, wrong_m) in cases.items():
                yield "clips", case, said(partial(agreed, lines, paint, wrong_m))
        before = drawn


def every_fifth(path: Path) -> list[U8]:
    """Return pictures of a video, RGB."""
    video, out = cv2.VideoCapture(str(path)), []
    while True:
        ok, bgr = video.read()
        if not ok:
            return out[::5]
        out.append(np.ascontiguousarray(bgr[..., ::-1]))


def pinhole(picture: U8, lens: RecordedLens, how: int) -> U8:
    """Return a picture as a pinhole within its lens sees it, 480 x 270; the optical axis is in the
    middle.
    """
    reach = min(
        lens.lens.max_angle_rad,
        float(np.polynomial.polynomial.polyval(lens.width / 2, lens.lens.pixel_to_angle)),
        0.75,
    )
    focal = 240 / np.tan(0.95 * reach)
    v, u = np.mgrid[0:270, 0:480] + 0.5
    x, y = (u - 240) / focal, (v - 135) / focal
    flat = np.hypot(x, y)
    radius = np.polynomial.polynomial.polyval(
        np.arctan(flat), lens.lens.angle_to_pixel
    ) / np.maximum(flat, 1e-9)
    scale = picture.shape[1] / lens.width, picture.shape[0] / lens.height
    at = [
        (scale[i] * (centre + radius * one) - 0.5).astype(np.float32)
        for i, (centre, one) in enumerate(((lens.cx, x), (lens.cy, y)))
    ]
    blurred = (
        picture
        if how == cv2.INTER_NEAREST
        else cv2.GaussianBlur(picture, (0, 0), picture.shape[1] / 480 / 3)
    )
    return np.asarray(
        cv2.remap(blurred, at[0], at[1], cv2.INTER_LINEAR if how != cv2.INTER_NEAREST else how)
    )


def agreed(lines: Bool, paint: U8, wrong_m: float, aside_m: float) -> float | None:
    """Return the agreement of lines that a flat road would show some metres further to the left."""
    aside_m += wrong_m
    move = np.float32([[1, -aside_m / HEIGHT_M, aside_m / HEIGHT_M * 135], [0, 1, 0]])
    moved = cv2.warpAffine(lines.astype(np.uint8), move, (480, 270), flags=cv2.INTER_NEAREST) > 0
    moved[:135] = False
    return map_gate.agreement(map_gate.pieces_of(moved), paint)


def said(found: Callable[[float], float | None]) -> str:
    """Return the verdict of the gate: ``few`` lines, ``on``, ``off``, or ``unsure``."""
    here = found(0.0)
    return (
        "few"
        if here is None
        else "on"
        if here >= map_gate.DOUBT
        else "off"
        if map_gate.decided(found, 0.0)
        else "unsure"
    )


if __name__ == "__main__":
    counts: dict[tuple[str, str], list[str]] = {}
    for shown, case, what in (
        drives(sys.argv[2:]) if sys.argv[1] == "drives" else clips(Path(sys.argv[2]))
    ):
        counts.setdefault((shown, case), []).append(what)
    for (shown, case), found in sorted(counts.items()):
        print(
            f"| {shown} | {case} | {len(found)} | "
            + " | ".join(f"{found.count(one) / len(found):.0%}" for one in ("off", "unsure", "few"))
            + " |"
        )
