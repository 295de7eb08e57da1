"""The semantic map against the publisher's renders of a recorded clip; see
`tests.fixers.cosmos_agreement` for what is compared.
"""

import av
import cv2
import numpy as np
import pytest

from alpasim_plugin.fixers.semantic_map.style import BOX_COLOURS, COLOURS
from scenarios.ftheta import FRONT_WIDE, orthonormal
from tests.examples import first_of
from tests.fixers.cosmos_agreement import compare, mounts, read_clip
from tests.fixers.cosmos_clip import T_RIG_FRONT_WIDE


@pytest.fixture(scope="module")
def clip(shared_data):
    return read_clip(shared_data / "cosmos-drive-dreams")


@pytest.mark.slow
@pytest.mark.parametrize("camera", first_of([FRONT_WIDE, "camera_rear_left_70fov"]))
def test_lines_fall_on_the_published_render_and_the_published_lines_on_ours(clip, camera):
    found = compare(clip, camera, mounts()[camera], every=28)
    assert found.n_ours > 50_000
    assert found.n_published > 50_000
    assert found.ours >= 0.95
    assert found.published >= 0.95


@pytest.mark.slow
@pytest.mark.parametrize("camera", list(mounts()))
def test_every_camera_and_frame_agrees(clip, camera):
    found = compare(clip, camera, mounts()[camera])
    assert min(found.ours, found.published) >= 0.95


@pytest.mark.slow
def test_a_wrong_mount_is_noticed(clip):
    """One degree of yaw is what separates the other car's mount from this one's; it costs
    agreement.
    """
    other = compare(clip, FRONT_WIDE, orthonormal(T_RIG_FRONT_WIDE), every=28)
    own = compare(clip, FRONT_WIDE, mounts()[FRONT_WIDE], every=28)
    assert other.ours < 0.95 < own.ours
    assert other.published < 0.95 < own.published


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
