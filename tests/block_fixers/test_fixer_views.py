"""Frames to tensors and back."""

from dataclasses import replace

import numpy as np
import torch

from alpasim_plugin.block_fixers.clips import to_clip, to_images
from alpasim_plugin.core.types import Frame
from alpasim_plugin.fixers.views import group_views
from tests.fixers.clip_cases import maps_of, moving_picture


def test_every_grey_level_survives_the_way_to_tensors_and_back():
    levels = np.arange(256, dtype=np.uint8).reshape(16, 16, 1).repeat(3, axis=2)
    (views,) = group_views([Frame(0, "front", levels)], [], 1)
    clip = to_clip(views, 1)
    assert np.array_equal(to_images(clip.rgb, views.size)[0, 0], levels)
    assert float(clip.rgb.min()) == -1
    assert float(clip.rgb.max()) == 1


def test_filling_up_repeats_edges_and_the_last_frame():
    frames = moving_picture(2, size=(17, 30))
    (views,) = group_views(frames, maps_of(frames), 5)
    clip = to_clip(views, 5)
    assert clip.maps is not None
    for video, images in ((clip.rgb, [f.rgb for f in frames]), (clip.maps, maps_of(frames))):
        assert tuple(video.shape) == (1, 3, 5, 32, 32)
        expected = np.pad(images[1], ((0, 15), (0, 2), (0, 0)), mode="edge") / np.float32(127.5) - 1
        for t in (1, 2, 4):
            assert np.allclose(video[0, :, t].permute(1, 2, 0).numpy(), expected, atol=1e-6)
    assert np.array_equal(
        clip.alpha[0, 0, 4].numpy(), np.pad(frames[1].alpha, ((0, 15), (0, 2)), mode="edge")
    )
    assert to_images(clip.rgb, views.size).shape == (1, 2, 17, 30, 3)


def test_an_opacity_of_one_everywhere_is_none():
    opaque = moving_picture(2, holes=False)
    (views,) = group_views(opaque, [], 5)
    assert views.alpha is None
    (views,) = group_views([opaque[0], replace(opaque[1], alpha=None)], [], 5)
    assert views.alpha is None
    hole = np.ones((32, 48), dtype=np.float32)
    hole[0, 0] = 0.999
    (views,) = group_views([opaque[0], replace(opaque[1], alpha=hole)], [], 5)
    assert views.alpha[0, 0].min() == 1
    assert views.alpha[0, 1, 0, 0] == np.float32(0.999)


def test_equal_blocks_are_told_from_others():
    frames = moving_picture(3)
    maps = maps_of(frames)
    (views,) = group_views(frames, maps, 5)
    copies = [replace(f, rgb=f.rgb.copy(), alpha=f.alpha.copy()) for f in frames]
    assert views.equals(group_views(copies, [m.copy() for m in maps], 5)[0])
    assert not views.equals(None)
    assert not views.equals(group_views(frames, [], 5)[0])
    assert not views.equals(group_views(frames[:2], maps[:2], 5)[0])
    copies[1].rgb[0, 0, 0] ^= 1
    assert not views.equals(group_views(copies, maps, 5)[0])
    assert not views.equals(group_views([replace(f, t_us=f.t_us + 1) for f in frames], maps, 5)[0])


def test_pixels_are_copied_so_that_a_renderer_may_reuse_its_buffers():
    frames = moving_picture(2)
    (views,) = group_views(frames, [], 5)
    before = views.rgb.copy()
    frames[0].rgb[:] = 0
    assert np.array_equal(views.rgb, before)


def test_values_beyond_the_range_are_cut():
    video = torch.tensor([-3.0, 3.0]).view(1, 1, 1, 1, 2).expand(1, 3, 1, 1, 2)
    (views,) = group_views([Frame(0, "front", np.zeros((1, 2, 3), dtype=np.uint8))], [], 1)
    assert to_images(video, views.size)[0, 0, 0, :, 0].tolist() == [0, 255]


def test_rounding_beyond_one_is_cut():
    alpha = np.full((32, 48), 1.0005, dtype=np.float32)
    alpha[0] = -0.0005
    (views,) = group_views([replace(moving_picture(1)[0], alpha=alpha)], [], 5)
    assert views.alpha is not None
    assert (views.alpha.min(), views.alpha.max()) == (0, 1)
