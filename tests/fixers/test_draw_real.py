"""The semantic map against the publisher's renders of a recorded clip; see
`tests.fixers.cosmos_agreement` for what is compared.
"""

from __future__ import annotations

import time

import av
import cv2
import numpy as np
import pytest

from alpasim_plugin.core.geometry import se2
from alpasim_plugin.core.types import Box
from alpasim_plugin.fixers.semantic_map.draw import draw_map, kernel_camera
from alpasim_plugin.fixers.semantic_map.prepare import ActorBox, prepare_map
from alpasim_plugin.fixers.semantic_map.style import BOX_COLOURS, COLOURS
from scenarios.ftheta import FRONT_WIDE, orthonormal
from scenarios.recorded import SourceFiles
from tests.examples import first_of
from tests.fixers.cosmos_agreement import AS_PUBLISHED, OPENGL, SOLID, compare, mounts, read_clip
from tests.fixers.cosmos_clip import T_RIG_FRONT_WIDE, read_lenses
from tests.fixers.draw_reference import project_points
from tests.scenarios.ftheta_projection import project_ftheta


@pytest.fixture(scope="module")
def clip(shared_data):
    return read_clip(shared_data / "cosmos-drive-dreams")


@pytest.mark.parametrize("camera", first_of([FRONT_WIDE, "camera_rear_left_70fov"]))
def test_lines_fall_on_the_published_render_and_the_published_lines_on_ours(clip, camera):
    found = compare(clip, camera, mounts()[camera], SOLID, every=28)
    assert found.n_ours > 50_000
    assert found.n_published > 50_000
    assert found.ours >= 0.95
    assert found.published >= 0.95


@pytest.mark.slow
@pytest.mark.parametrize("camera", list(mounts()))
def test_every_camera_and_frame_agrees(clip, camera):
    found = compare(clip, camera, mounts()[camera], AS_PUBLISHED)
    assert min(found.ours, found.published) >= 0.95


@pytest.mark.slow
def test_a_wrong_mount_is_noticed(clip):
    """One degree of yaw is what separates the other car's mount from this one's; it costs
    agreement.
    """
    other = compare(clip, FRONT_WIDE, orthonormal(T_RIG_FRONT_WIDE), SOLID, every=28)
    own = compare(clip, FRONT_WIDE, mounts()[FRONT_WIDE], SOLID, every=28)
    assert other.ours < 0.95 < own.ours
    assert other.published < 0.95 < own.published


def test_projection_equals_the_reader_s(clip, shared_data):
    lenses = read_lenses(SourceFiles(), shared_data / "cosmos-drive-dreams" / "example")
    rays = np.random.Generator(np.random.Philox(3)).normal((0, 0, 2), 1.0, size=(400, 3))
    for name, camera in clip.cameras.items():
        inside = (
            np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
            < lenses[name].lens.max_angle_rad
        )
        expected = project_ftheta(lenses[name], rays[inside]) * (
            1280 / lenses[name].width,
            704 / lenses[name].height,
        )
        np.testing.assert_allclose(project_points(camera, rays[inside]), expected, atol=1e-6)
        lens = kernel_camera(camera)
        theta = np.linspace(0, lenses[name].lens.max_angle_rad, 999)
        table = np.interp(theta * lens.params[7], np.arange(len(lens.table)), lens.table)
        exact = (
            project_points(camera, np.column_stack([np.sin(theta), 0 * theta, np.cos(theta)]))[:, 0]
            - camera.cx
        )
        np.testing.assert_allclose(table * camera.A[0][0], exact, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "front_wide_120fov",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("cross_right_120fov", "rear_left_70fov")
        ),
    ],
)
def test_published_conditioning_videos_hold_our_colours(shared_data, name):
    """Nearly every drawn pixel of renders that a network was trained with is one of the palette's
    colours times a fade.
    """
    flat = [
        rgb
        for key, rgb in COLOURS.items()
        if key not in ("intersection", "road_island", "buffer_zone")
    ]
    steps = np.linspace(0, 1, 25)[:, None]
    palette = np.concatenate(
        [
            np.array(flat, dtype=float),
            *((1 - steps) * a + steps * b for a, b in np.array(list(BOX_COLOURS.values()))),
        ]
    )
    folder = (
        shared_data
        / "cosmos-transfer"
        / "posttrain"
        / "control_input_hdmap_bbox"
        / f"ftheta_camera_{name}"
    )
    with av.open(str(next(folder.glob("av_002b815b*.mp4")))) as video:
        image = next(frame.to_ndarray(format="rgb24") for frame in video.decode(video=0))
    inner = (
        cv2.erode((image.max(axis=2) > 40).astype(np.uint8), np.ones((3, 3))) > 0
    )  # rims mix two colours
    pixels = image[inner]
    assert len(pixels) > 20_000
    pixels = pixels[::4].astype(float)
    fade = np.clip(pixels @ palette.T / (palette**2).sum(axis=1), 0, 1)
    off = np.abs(pixels[:, None] - fade[..., None] * palette).max(axis=2).min(axis=1)
    assert (off <= 14).mean() > 0.94


@pytest.mark.slow
@pytest.mark.parametrize(("size", "limit_ms"), [((256, 144), 4.0), ((960, 544), 20.0)])
def test_frames_are_fast_enough_on_two_cores(clip, size, limit_ms):
    scene = prepare_map(clip.lane_map, clip.extras, OPENGL)
    camera, pose = (
        clip.cameras[FRONT_WIDE].resized(*size),
        clip.T_world_rig[28] @ mounts()[FRONT_WIDE],
    )
    boxes = tuple(
        ActorBox(
            clip.T_world_rig[28] @ se2(5 + 4 * i, (-1) ** i * 4, 0.1, 0.8),
            Box(4.5, 1.9, 1.6),
            "car",
        )
        for i in range(20)
    )
    took = []
    for _ in range(100):
        start = time.perf_counter()
        draw_map(scene, camera, pose, boxes, threads=2)
        took.append(time.perf_counter() - start)
    print(
        f"{size}: {np.median(took[5:]) * 1e3:.2f} ms median, {np.percentile(took[5:], 95) * 1e3:.2f} ms 95 %"
    )
    assert np.median(took[5:]) * 1e3 <= limit_ms
