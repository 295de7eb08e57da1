"""Build road users as rigid clouds in the frame of their box: origin at the box centre, x length, y
width, z height.

A vehicle is lofted: stations along its length give the height of the belt line and the roof and the
half widths there; strips between stations become body, glass and lights. People are a handful of
ellipsoids. Everything is scaled to the actor's box, so that what is seen and what is hit are the
same size. Colours come from the stream of the actor's id.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.detail import halvings
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F64, Actor, Box, Scenario
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.files.ply import read_ply
from alpasim_plugin.gaussians.scene.scene_graph import Level, SceneNode
from alpasim_plugin.gaussians.sh import C0
from alpasim_plugin.streets.actor_shapes import STATIONS, Loft
from alpasim_plugin.streets.surfels import (
    IDENTITY,
    cloud_of,
    quad_surfels,
    rods,
    with_sheen,
)

OUTSIDE_M = 0.1  # how far an appearance may leave the box
SPILL = 0.05  # the share of it that may
CELLS_M = (0.09, 0.22, 0.6)
BODY_RGB = np.array(
    [
        [0.78, 0.78, 0.78],
        [0.16, 0.16, 0.17],
        [0.55, 0.56, 0.58],
        [0.90, 0.90, 0.88],
        [0.50, 0.10, 0.10],
        [0.13, 0.23, 0.45],
        [0.32, 0.34, 0.36],
        [0.20, 0.30, 0.24],
        [0.62, 0.55, 0.42],
    ]
)
TRUCK_RGB = np.array([[0.85, 0.85, 0.83], [0.70, 0.45, 0.18], [0.35, 0.45, 0.55]])
BUS_RGB = np.array([[0.72, 0.16, 0.13], [0.20, 0.36, 0.60], [0.82, 0.80, 0.74]])
CLOTHES_RGB = np.array(
    [
        [0.15, 0.17, 0.25],
        [0.45, 0.12, 0.12],
        [0.20, 0.36, 0.24],
        [0.60, 0.58, 0.52],
        [0.10, 0.10, 0.11],
        [0.70, 0.52, 0.16],
        [0.26, 0.40, 0.62],
    ]
)
SKIN_RGB = np.array([[0.80, 0.62, 0.50], [0.55, 0.38, 0.28], [0.36, 0.25, 0.19]])
SKY_RGB = (0.72, 0.82, 0.92)
GLASS_RGB = np.array([0.10, 0.12, 0.14])
TYRE_RGB = np.array([0.07, 0.07, 0.075])
HUB_RGB = np.array([0.50, 0.51, 0.53])
RGB = tuple[float, float, float]
HEAD_RGB = (0.96, 0.96, 0.88)
TAIL_RGB = (0.80, 0.06, 0.05)
PLATE_RGB = (0.88, 0.88, 0.86)
STEP = 1.9  # how far a foot is ahead of the body, in strides
TOE = 0.08  # how far a foot reaches beyond that, as a share of the height
SEEN_SIGMA = 1.2  # deviations at which the edge of a dense Gaussian is seen


def build_actors(scenario: Scenario) -> list[SceneNode]:
    """Return one node per actor, named by the actor's id."""
    return [build_actor(actor, scenario) for actor in scenario.actors]


def build_actor(actor: Actor, scenario: Scenario) -> SceneNode:
    """Return the node of one actor of a scenario at three levels of detail, and more for sharp
    cameras; an appearance of its own has one.
    """
    if actor.appearance is not None:
        cloud = read_ply(Path(actor.appearance))
        largest = cloud.scales.max(axis=1, keepdims=True, initial=0.0)
        reach = np.maximum(np.abs(cloud.means), largest)
        if not len(reach):
            raise InputError(
                f"{actor.appearance}: no Gaussians", "give a file that shows the actor"
            )
        box = actor.box
        half = np.array(box.size_m) / 2 + OUTSIDE_M
        if (reach > half).any(axis=1).mean() > SPILL:
            extent = " x ".join(
                f"{2 * reach_m:.2f}" for reach_m in np.quantile(reach, 1 - SPILL, axis=0)
            )
            raise InputError(
                f"{actor.appearance}: Gaussians of {extent} m outside of the box of {actor.actor_id}, {box.length_m:g} x {box.width_m:g} x {box.height_m:g} m",
                "give the actor this size_m, in a file whose origin is the middle of the box",
            )
        parts = GaussianCloud.concatenate([cloud, _shadow(actor.box, actor.label)])
        return SceneNode(actor.actor_id, "actor", (Level(0.0, parts),))
    rng = stream(scenario.scene_id, scenario.seed, f"scene/actor/{actor.actor_id}")
    draw = rng.random(8)
    noise = rng.standard_normal(4096)
    shape = _SHAPES.get(actor.label, _other)
    levels = []
    coarser = float(np.clip(actor.box.length_m / 5.0, 1.0, 2.0))
    finer = [CELLS_M[0] / 2] if halvings(scenario) else []  # a quarter would be 60,000 a car
    for cell_m in np.array([*finer, *CELLS_M]) * coarser:
        cloud = GaussianCloud.concatenate(
            [shape(actor.box, draw, noise, float(cell_m)), _shadow(actor.box, actor.label)]
        )
        levels.append(Level(float(cell_m), cloud))
    usual_cell_m = float(CELLS_M[0] * coarser)
    return SceneNode(actor.actor_id, "actor", tuple(levels), usual_cell_m=usual_cell_m)


def _shadow(box: Box, label: str) -> GaussianCloud:
    """Place a soft contact shadow on the ground below."""
    wheels = label in ("car", "truck", "bus")
    n = max(1, round(box.length_m / 1.2)) if wheels else 1
    x = ((np.arange(n) + 0.5) / n - 0.5) * box.length_m
    means = np.column_stack([x, np.zeros(n), np.full(n, 0.03 - box.height_m / 2)])
    scales = (0.5 * box.length_m / n, 0.42 * box.width_m, 0.01)
    return cloud_of(means, IDENTITY, scales, (0.05, 0.05, 0.05), 0.75 if wheels else 0.45)


def _wheels(box: Box, loft: Loft, cell_m: float) -> GaussianCloud:
    """Draw wheels as dark discs with a pale hub, just proud of the flanks."""
    radius = loft.wheel_m
    x = np.repeat(np.array(loft.axles) * box.length_m, 2)
    n = len(x)
    y = np.tile([1.0, -1.0], n // 2) * (box.width_m / 2 - 0.02)
    centre = np.column_stack([x, y, np.full(n, radius - box.height_m / 2)])
    disc = _blobs(centre, (0.52 * radius, 0.05, 0.52 * radius), TYRE_RGB)
    if cell_m > 0.3:
        return disc
    angle = np.linspace(0, 2 * np.pi, 10, endpoint=False)
    rim = np.column_stack([np.cos(angle), np.zeros(10), np.sin(angle)]) * 0.74 * radius
    tyre = _blobs(
        (centre[:, None] + rim[None]).reshape(-1, 3), (0.19 * radius, 0.05, 0.19 * radius), TYRE_RGB
    )
    outward = np.column_stack([np.zeros(n), 0.05 * np.sign(y), np.zeros(n)])
    hub = _blobs(centre + outward, (0.26 * radius, 0.02, 0.26 * radius), HUB_RGB)
    return GaussianCloud.concatenate([disc, tyre, hub])


def _blobs(
    means: npt.ArrayLike, scales: tuple[float, float, float], rgb: npt.ArrayLike
) -> GaussianCloud:
    """Return Gaussians of one size, colour and orientation along the box's axes."""
    return cloud_of(means, IDENTITY, scales, rgb)


def _lights(box: Box, loft: Loft, cell_m: float) -> GaussianCloud:
    """Draw head lamps, tail lamps and number plates on the two ends."""
    half = box.length_m / 2
    z = loft.lamp_z * box.height_m - box.height_m / 2
    y = 0.36 * box.width_m
    plate_z = loft.lamp_z * 0.62 * box.height_m - box.height_m / 2
    end = half + 0.02
    if cell_m < CELLS_M[0]:
        plates = [
            (end, y, z, 0.15, 0.08, HEAD_RGB),
            (end, -y, z, 0.15, 0.08, HEAD_RGB),
            (-end, y, z, 0.16, 0.09, TAIL_RGB),
            (-end, -y, z, 0.16, 0.09, TAIL_RGB),
            (end, 0.0, 1.05 * plate_z, 0.22, 0.06, PLATE_RGB),
            (-end, 0.0, plate_z, 0.22, 0.06, PLATE_RGB),
        ]
        xs, ys, zs, half_width, half_height = np.array([plate[:5] for plate in plates]).T
        across = np.sign(xs) * half_width
        corners = [
            np.column_stack([xs, ys + u * across, zs + v * half_height])
            for u, v in ((-1, -1), (1, -1), (1, 1), (-1, 1))
        ]
        rgb = np.array([plate[5] for plate in plates])
        return quad_surfels(np.stack(corners, axis=1), rgb, 0.5 * cell_m)[0]
    parts = [
        _blobs([[end, y, z], [end, -y, z]], (0.02, 0.10, 0.055), HEAD_RGB),
        _blobs([[-end, y, z], [-end, -y, z]], (0.02, 0.11, 0.065), TAIL_RGB),
    ]
    if cell_m < 0.3:
        parts.append(
            _blobs(
                [[-end, 0, plate_z], [end, 0, 1.05 * plate_z]],
                (0.02, 0.14, 0.045),
                PLATE_RGB,
            )
        )
    return GaussianCloud.concatenate(parts)


def _vehicle(box: Box, draw: F64, noise: F64, cell_m: float, label: str) -> GaussianCloud:
    kind = label
    colours = {"truck": TRUCK_RGB, "bus": BUS_RGB}.get(label, BODY_RGB)
    if label == "truck" and box.length_m < 6.0 and box.height_m < 2.3:
        kind = "pickup"
        colours = BODY_RGB
    if label == "car":
        kind = "hatch" if draw[1] < 0.4 else "sedan"
        if box.height_m > 1.65:
            kind = "van" if box.height_m > 1.95 else "suv"
    loft = STATIONS[kind]
    corners, rgb, gloss = loft.quads(_drawn(colours, draw[0]), GLASS_RGB)
    quads = corners * box.size_m - np.array([0.0, 0.0, box.height_m / 2])
    cloud, owner, normals = quad_surfels(quads, rgb, cell_m, noise, 0.72)
    # Light from above: roofs bright, flanks in between, undersides dark.
    shade = (0.80 + 0.24 * normals[:, 2])[owner][:, None, None]
    sh = ((cloud.sh * C0 + 0.5) * shade - 0.5) / C0
    cloud = replace(cloud, sh=sh.astype(np.float32))
    parts = [
        with_sheen(cloud, normals[owner], gloss[owner], SKY_RGB),
        _wheels(box, loft, cell_m),
        _lights(box, loft, cell_m),
    ]
    return GaussianCloud.concatenate(parts)


def _drawn(colours: F64, draw: float) -> F64:
    """Return the colour that a number 0..1 chooses."""
    return colours[int(draw * len(colours))]


def _person(
    height_m: float,
    width_m: float,
    draw: F64,
    stride: float,
    z0: float,
    x0: float = 0.0,
    lean: float = 0.0,
) -> GaussianCloud:
    """Return a standing or riding figure with its feet at ``(x0, 0, z0)``; ``lean`` and ``stride``
    are shares of its height.
    """
    h = height_m
    w = min(max(width_m, 0.45), 0.75)
    coat = _drawn(CLOTHES_RGB, draw[2])
    legs = _drawn(CLOTHES_RGB, draw[3]) * 0.8
    skin = _drawn(SKIN_RGB, draw[4])
    # x, y, z as shares of height, then sigma x, y, z as shares, then colour
    body = [
        (0.5 * lean, 0.0, 0.92, 0.040, 0.036, 0.048, skin),
        (0.5 * lean - 0.01, 0.0, 0.955, 0.042, 0.038, 0.026, np.array([0.16, 0.12, 0.09])),
        (0.3 * lean, 0.0, 0.75, 0.050, 0.075, 0.062, coat),
        (0.2 * lean, 0.0, 0.62, 0.048, 0.066, 0.068, coat * 0.95),
        (0.0, 0.0, 0.51, 0.050, 0.064, 0.045, legs),
        (stride, 0.04, 0.36, 0.036, 0.034, 0.085, legs),
        (-stride, -0.04, 0.36, 0.036, 0.034, 0.085, legs * 0.92),
        (1.7 * stride, 0.04, 0.15, 0.030, 0.028, 0.085, legs * 0.9),
        (-1.7 * stride, -0.04, 0.15, 0.030, 0.028, 0.085, legs * 0.85),
        (STEP * stride + 0.03, 0.04, 0.02, 0.050, 0.025, 0.015, np.array([0.12, 0.11, 0.10])),
        (-STEP * stride + 0.03, -0.04, 0.02, 0.050, 0.025, 0.015, np.array([0.12, 0.11, 0.10])),
        (0.3 * lean - stride, 0.115, 0.66, 0.026, 0.024, 0.085, coat * 0.88),
        (0.3 * lean + stride, -0.115, 0.66, 0.026, 0.024, 0.085, coat * 0.88),
        (0.6 * lean - 1.5 * stride, 0.12, 0.50, 0.022, 0.020, 0.040, skin),
        (0.6 * lean + 1.5 * stride, -0.12, 0.50, 0.022, 0.020, 0.040, skin),
    ]
    rows = np.array([[*part[:6], *part[6]] for part in body])
    means = rows[:, :3] * [h, w / 0.33, h] + [x0, 0.0, z0]
    scales = rows[:, 3:6] * [h, w / 0.33 * 0.9, h]
    return cloud_of(means, IDENTITY, scales, rows[:, 6:], 0.97)


def _pedestrian(box: Box, draw: F64, noise: F64, cell_m: float) -> GaussianCloud:
    """Draw somebody who walks with strides as long as the box."""
    longest = (box.length_m / box.height_m / 2 - TOE) / STEP
    stride = min(0.05 + 0.06 * draw[5], max(longest, 0.0))
    return _person(box.height_m, box.width_m, draw, stride, -box.height_m / 2)


def _two_wheeler(box: Box, draw: F64, noise: F64, cell_m: float, heavy: bool) -> GaussianCloud:
    """Put a rider on two wheels and a frame."""
    length = box.length_m
    height = box.height_m
    radius = min(0.34, 0.21 * length)
    bottom = -height / 2
    wheel_x = np.array([1.0, -1.0]) * (length / 2 - radius)
    angle = np.linspace(0, 2 * np.pi, 20 if cell_m < 0.3 else 8, endpoint=False)
    thick = (0.05 if heavy else 0.022) * (20 / len(angle)) ** 0.5
    tyre_m = 2.2 * thick
    ring = np.column_stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)])
    ring *= radius - SEEN_SIGMA * tyre_m
    centres = np.array([[x, 0.0, bottom + radius] for x in wheel_x])
    rim = (centres[:, None] + ring[None]).reshape(-1, 3)
    tyres = _blobs(rim, (tyre_m, 1.2 * thick, tyre_m), TYRE_RGB)
    body = _drawn(BODY_RGB, draw[0])
    seat = np.array([-0.12 * length, 0, bottom + 0.52 * height])
    bar = np.array([0.26 * length, 0, bottom + 0.60 * height])
    pedal = np.array([-0.02 * length, 0, bottom + radius])
    grip = np.array([0.0, 0.25, 0.0])
    pairs = [
        (seat, centres[1]),
        (seat, pedal),
        (bar, pedal),
        (bar, centres[0]),
        (seat, bar),
        (bar + grip, bar - grip),
    ]
    start, end = np.swapaxes(pairs, 0, 1)
    frame = rods(start, end, 0.10 if heavy else 0.03, body, max(cell_m, 0.12))
    rider = _person(0.80 * height, 0.55, draw, 0.06, bottom + 0.22 * height, -0.06 * length, 0.30)
    return GaussianCloud.concatenate([tyres, frame, rider])


def _other(box: Box, draw: F64, noise: F64, cell_m: float) -> GaussianCloud:
    """Draw a traffic cone where the box is small and slim, else a crate with warning stripes."""
    length, width, height = box.size_m
    if max(length, width) < 1.0:
        n = 8 if cell_m < 0.3 else 4
        up = (np.arange(n) + 0.5) / n
        radius = 0.30 * min(length, width) * (1.05 - 0.8 * up)
        rgb = np.where(((up > 0.4) & (up < 0.62))[:, None], [0.92, 0.92, 0.90], [0.90, 0.36, 0.08])
        means = np.column_stack([np.zeros(n), np.zeros(n), (up - 0.5) * height])
        return cloud_of(
            means, IDENTITY, np.column_stack([radius, radius, np.full(n, 0.55 * height / n)]), rgb
        )
    x, y, z = length / 2, width / 2, height / 2
    faces = []
    colours = []
    for turn in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        middle = np.array([*turn, 0]) * [x, y, 0]
        side = np.array([-turn[1] * x, turn[0] * y, 0.0])
        for k in range(4):
            low = np.array([0, 0, -z + z * k / 2])
            high = np.array([0, 0, -z + z * (k + 1) / 2])
            ring = (
                middle - side + low,
                middle + side + low,
                middle + side + high,
                middle - side + high,
            )
            faces.append(np.stack(ring))
            colours.append([0.86, 0.84, 0.80] if k % 2 else [0.80, 0.42, 0.14])
    faces.append(np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]]) * [x, y, z])
    colours.append([0.80, 0.60, 0.40])
    return quad_surfels(np.array(faces), np.array(colours), cell_m, noise)[0]


_SHAPES: dict[str, Callable[[Box, F64, F64, float], GaussianCloud]] = {
    **{label: partial(_vehicle, label=label) for label in ("car", "truck", "bus")},
    "pedestrian": _pedestrian,
    "cyclist": partial(_two_wheeler, heavy=False),
    "motorcycle": partial(_two_wheeler, heavy=True),
    "other": _other,
}
