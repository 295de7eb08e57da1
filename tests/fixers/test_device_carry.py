"""Recorded frames carried by tensors: the same images as the kernels of the CPU."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from alpasim_plugin.core.geometry import se2
from alpasim_plugin.core.types import Box
from alpasim_plugin.fixers import device_carry, ground
from alpasim_plugin.fixers.device_carry import CarriedView, carry_on_device, upload_image
from alpasim_plugin.fixers.ground import carry, with_users
from alpasim_plugin.fixers.warp import WarpTarget
from tests.fixers.ground_cases import K, recorded, rig, street
from tests.fixers.memory import Memory

BOXES = {"car": Box(4.0, 2.0, 1.5), "van": Box(5.0, 2.2, 2.5)}


def actors(x_m):
    return {"car": se2(18.0 + x_m, -1.0, 0.1, 0.75), "van": se2(25.0, 3.0, 0.0, 1.25)}


@pytest.mark.parametrize(
    ("count", "wall_m", "window_rad"),
    [(1, 30.0, 0.075), (3, np.inf, 0.075), (3, 30.0, 0.075), (3, np.inf, 0.7)],
)
def test_images_equal_those_of_the_processor(count, wall_m, window_rad, monkeypatch):
    monkeypatch.setattr(ground, "WINDOW_RAD", window_rad)  # 3 pixels, or 35, of which half count
    T, depth, _ = street(10.013, wall_m)
    depth[22:30, 8:40] = 0
    depth[30:36, 8:40] = 3.0
    view = WarpTarget(K, T, depth, actors(0.0), BOXES)
    images = [
        with_users(replace(recorded(8.937 - i, wall_m), actors=actors(-1.0 * i)), BOXES)
        for i in range(count)
    ]
    images[-1] = replace(images[-1], actors={})
    other = replace(images[0], T_world_camera=se2(0.0, 0.0, 0.5) @ images[0].T_world_camera)
    wanted = carry([replace(images[0], others=(other,)), *images[1:]], view, rig(10.0))
    first, *rest, other = (upload_image(one, torch.device("cpu")) for one in (*images, other))
    uploaded = [replace(first, others=(other,)), *rest]
    on_device = replace(view, depth=torch.from_numpy(depth))
    alone = replace(on_device, actors={"car": view.actors["car"]})
    both = [CarriedView(uploaded, target, rig(10.0)) for target in (alone, on_device)]
    found = carry_on_device(both)[1]
    assert found.dtype == torch.uint8
    for one, other in zip(found.numpy(), wanted, strict=True):
        apart = np.abs(one.astype(int) - other)
        # A window at the first row of the ground ends at another row than the processor's.
        assert (apart.max(axis=-1) > 1).mean() <= (0.02 if wall_m < 99 and count > 1 else 0)


@pytest.mark.parametrize("count", [1, 3])
def test_views_are_carried_together_while_their_memory_holds_them(count, monkeypatch):
    T, depth, _ = street(10.013, 30.0)
    view = WarpTarget(K, T, torch.from_numpy(depth), actors(0.0), BOXES)
    frames = [
        with_users(replace(recorded(8.9 - i), actors=actors(-i)), BOXES) for i in range(count)
    ]
    images = [upload_image(frame, torch.device("cpu")) for frame in frames]
    views = [CarriedView(images, view, rig(10.0 + i)) for i in range(5)]
    together = carry_on_device(views)
    room = 2.5 * count * depth.size * device_carry.PIXEL_BYTES
    monkeypatch.setattr(device_carry, "WORKING_BYTES", int(room))
    with Memory() as memory:
        assert torch.equal(carry_on_device(views), together)
    assert 0.4 * room < memory.most < room + 2 * together.nbytes
