"""Overlays of pages fall where the camera's lens puts them: the page's script against the camera
model's own projection.
"""

import json
import shutil
import subprocess
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import evaluators.pages
from alpasim_plugin.cameras.lens import projected
from alpasim_plugin.core.types import CameraSpec, LensModel
from evaluators.pages.cells import lens_data

TEMPLATES = Path(evaluators.pages.__file__).parent / "templates"
SHOWN_PX = 480  # of the page's image, of a camera that has 960
# Keep what would be drawn: M and L with their pixels, and the middles of dots.
CANVAS = """
const calls = [], ignore = () => {};
const context = {
  beginPath: ignore, stroke: ignore, fill: ignore, setLineDash: ignore,
  moveTo: (x, y) => calls.push(["M", x, y]), lineTo: (x, y) => calls.push(["L", x, y]),
  arc: (x, y) => calls.push(["dot", x, y]),
};
const { lens, points, pose, lines, user } = JSON.parse(require("fs").readFileSync(0, "utf8"));
const overlay = new Overlay(context, lens, 0);
overlay.at(pose);
const pixels = points.map((point) => pixelOf(lens, overlay.camera(...point)));
overlay.plan(lines, "#000", true);
const ends = calls.length;
overlay.box(user, user, "#000");
console.log(JSON.stringify({ pixels, plan: calls.slice(0, ends), box: calls.slice(ends) }));
"""
LENSES = {
    "opencv": (
        600.0,
        LensModel("opencv", (-0.28, 0.08, 1e-3, -7e-4, -0.01, 0.0, 0.0, 0.0, 1e-3, -5e-4)),
    ),
    "rational": (400.0, LensModel("opencv", (0.4, -0.1, 0, 0, 0.02, 0.7, -0.1, 0.02))),
    "fisheye": (290.0, LensModel("fisheye", (0.02, -0.004, 0.001), max_angle_rad=np.deg2rad(95))),
    "ftheta": (1.0, LensModel("ftheta", (0.0, 480.0, 0.0, -7.0), (), (1.01, 0.01, -0.02))),
    "ftheta-backward": (1.0, LensModel("ftheta", (), (0.0, 1 / 480, 0.0, 1e-11))),
    "pinhole": (500.0, None),
}
# x of the rig ahead is z of the camera; 1.5 m up, turned a little to the left and down.
MOUNTING = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
TURN = np.array([[0.98, 0.05, 0.193], [-0.05, 0.9987, -0.0049], [-0.193, -0.0049, 0.981]])


def camera_of(name):
    focal, lens = LENSES[name]
    K = np.array([[focal, 0, 483.25], [0, 1.02 * focal, 301.5], [0, 0, 1.0]])
    T = np.eye(4)
    turn, _ = np.linalg.qr(MOUNTING @ TURN)
    T[:3, :3] = turn * np.sign(np.sum(turn * MOUNTING, axis=0))
    T[:3, 3] = (1.2, 0.1, 1.5)
    return CameraSpec(name, 960, 600, K, T, 0, lens)


def drawn(camera, points, lines=(), size=(450, 180, 150), at=(900, 300)):
    """Run the page's script: rig points ``(N, 3)``, metres, of an ego that stands at the origin."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed")
    script = "".join((TEMPLATES / name).read_text() for name in ("lens.js", "overlay.js"))
    given = {
        "lens": lens_data(camera, SHOWN_PX),
        "points": [[100 * x, 100 * y, z] for x, y, z in points],
        "pose": {"x": 0, "y": 0, "a": 0},
        "lines": [[[100 * x for x, _ in line], [100 * y for _, y in line]] for line in lines]
        or [[[], []]],
        "user": {"size": size, "x": at[0], "y": at[1], "a": 400},
    }
    ran = subprocess.run(
        [node, "-e", script + CANVAS],
        input=json.dumps(given),
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(ran.stdout)


def by_model(camera, rig_points):
    """Return the pixels in the page's image, and which points the lens model describes."""
    local = (rig_points - camera.T_rig_camera[:3, 3]) @ camera.T_rig_camera[:3, :3]
    if camera.lens is None:
        pixel = local[:, :2] / local[:, 2:] * np.diag(camera.K)[:2] + camera.K[:2, 2]
        return pixel * SHOWN_PX / camera.width, local[:, 2] > 0.4
    pixel, is_described = projected(camera, local)
    return pixel * SHOWN_PX / camera.width, is_described


@pytest.mark.parametrize("name", LENSES)
def test_points_all_around_fall_where_the_lens_puts_them(name):
    camera = camera_of(name)
    rng = np.random.default_rng(3)
    points = rng.normal(size=(2000, 3)) * rng.uniform(0.5, 60, (2000, 1))
    points[:400] = camera.T_rig_camera[:3, 3] + camera.T_rig_camera[:3, 2] * 7  # on the axis
    points[1:400] += rng.normal(size=(399, 3)) * np.geomspace(1e-9, 2, 399)[:, None]
    wanted, is_described = by_model(camera, points)
    pixels = drawn(camera, points.tolist())["pixels"]
    assert_array_equal([pixel is not None for pixel in pixels], is_described)
    assert 500 < is_described.sum() < 1990
    shown = np.array([pixel for pixel in pixels if pixel is not None])
    assert_allclose(shown, wanted[is_described], atol=1e-6, rtol=0)


def polylines(calls):
    lines = []
    for kind, x, y in calls:
        if kind == "M":
            lines.append([])
        if kind != "dot":
            lines[-1].append((x, y))
    return [np.array(line) for line in lines if len(line) > 1]


def distance_px(points, lines):
    """Return how far points ``(N, 2)`` lie from the nearest of some polylines."""
    nearest = np.full(len(points), np.inf)
    for line in lines:
        start, way = line[:-1], np.diff(line, axis=0)
        length = np.maximum(np.sum(way**2, axis=1), 1e-12)
        share = np.einsum("nmk,mk->nm", points[:, None] - start, way) / length
        foot = start + np.clip(share, 0, 1)[..., None] * way
        nearest = np.minimum(nearest, np.linalg.norm(points[:, None] - foot, axis=2).min(axis=1))
    return nearest


PLAN = [(2.0, 0.0), (12.0, 0.3), (25.0, -4.0), (-3.0, -30.0)]


@pytest.mark.parametrize("name", LENSES)
def test_a_plan_is_bent_as_the_lens_bends_the_road(name):
    camera = camera_of(name)
    out = drawn(camera, [], [PLAN])
    lines = polylines(out["plan"])
    corners = np.array([(*xy, 0.0) for xy in PLAN])
    steps = np.linspace(0, 1, 4001)[:, None]
    points = np.concatenate([start + steps * (end - start) for start, end in pairwise(corners)])
    pixel, is_described = by_model(camera, points)
    inside = is_described & (pixel > 0).all(axis=1) & (pixel < (480, 300)).all(axis=1)
    assert inside.sum() > 1000
    assert distance_px(pixel[inside], lines).max() < 0.15  # chords of curves
    ends = np.concatenate(lines)
    dense = pixel[is_described]
    on_image = (ends > 0).all(axis=1) & (ends < (480, 300)).all(axis=1)
    gaps = np.linalg.norm(ends[on_image, None] - dense, axis=2).min(axis=1)
    assert gaps.max() < 0.5  # nothing is drawn where the road is not
    dots = np.array([(x, y) for kind, x, y in out["plan"] if kind == "dot"])
    wanted, is_shown = by_model(camera, corners[2::2])
    assert_allclose(dots, wanted[is_shown], atol=1e-6, rtol=0)


@pytest.mark.parametrize("name", LENSES)
def test_a_box_has_its_corners_where_the_lens_puts_them(name):
    camera = camera_of(name)
    out = drawn(camera, [])
    c, s = np.cos(0.4), np.sin(0.4)
    corners = np.array(
        [
            (9 + c * u - s * v, 3 + s * u + c * v, z)
            for u in (-2.25, 2.25)
            for v in (-0.9, 0.9)
            for z in (0.0, 1.5)
        ]
    )
    wanted, is_described = by_model(camera, corners)
    assert is_described.all()
    ends = np.concatenate(polylines(out["box"]))
    assert np.linalg.norm(wanted[:, None] - ends, axis=2).min(axis=1).max() < 1e-6


def test_a_lens_that_a_log_describes_wrongly_has_no_overlay():
    camera = camera_of("ftheta")
    falling = LensModel("ftheta", (0.0, -480.0))
    assert lens_data(CameraSpec("c", 960, 600, camera.K, np.eye(4), 0, falling), 480) is None


# The page's elements and images are stand-ins; what is drawn on the canvas is kept.
CAUSE = """
const calls = [], keep = (name) => (...values) => calls.push([name, ...values.slice(1)]);
const context = new Proxy({}, { get: (_, name) => keep(name), set: () => true });
const canvas = { getContext: () => context };
const byId = () => ({ textContent: "{}" }), createImageBitmap = async () => ({ width: 480, height: 300 });
"""
SHOW = """
why.data = { lens: null, own: "3dgs", ego: {}, users: [], rear: 0 };
why.wanted = new Set(["policy", "plan", "lanes", "route"]);
const query = { seen: { "3dgs": { jpeg: "", t: 0 } }, said: { heat: [], lines: [], boxes: [["a car", 1, 2, 30, 40]] } };
why.draw({ name: "3dgs", canvas, said: null }, query, 0).then(() => console.log(JSON.stringify([calls.map(([name]) => name), canvas.hidden])));
"""


def test_the_images_of_a_failure_are_shown_where_a_lens_projects_nothing():
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed")
    page = (TEMPLATES / "cause.js").read_text().replace("why.start();", "")
    script = CAUSE + (TEMPLATES / "overlay.js").read_text() + page + SHOW
    ran = subprocess.run([node, "-e", script], capture_output=True, text=True, check=True)
    calls, is_hidden = json.loads(ran.stdout)
    assert calls == ["drawImage", "strokeRect", "fillText"]
    assert not is_hidden
    assert "data.lens ?" not in page  # the images do not wait for a lens
