"""Compare the GPU rasteriser with the float64 reference, its kernels interpreted on the CPU, and
compile them for two generations of cards.
"""

import os
import subprocess
import sys
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch

from alpasim_plugin.core.errors import InfrastructureError, InputError, RendererError
from alpasim_plugin.gaussians import GaussianCloud, prepare, rasterize, rasterize_prepared
from alpasim_plugin.gaussians.constants import MIP_PX2
from alpasim_plugin.gaussians.raster.rasterize_reference import rasterize_reference
from tests.examples import first_of
from tests.gaussians.gaussian_scenes import (
    HARD,
    LSB,
    assert_same_image,
    camera,
    random_cloud,
    random_rigid,
    splats,
)
from tests.gaussians.gradient_scenes import assert_close, kernel_gradients, numeric_gradients
from tests.gaussians.hard_gradients import HARD as HARD_GRADIENTS
from tests.gaussians.hard_gradients import TOLERANCE

pytest.importorskip("triton", reason="Triton is not installed")

import triton
import triton.language as tl

from alpasim_plugin.gaussians.raster.rasterize_triton import (
    BLOCK,
    MOST_PAIRS,
    DrawnCloud,
    ProjectedSplats,
    TileCompositor,
    UploadedClouds,
)
from alpasim_plugin.gaussians.raster.triton_functions import slots_of
from alpasim_plugin.gaussians.raster.triton_kernels import RECORD


def interpreted(cloud, cam, behind=(0.0, 0.0, 0.0)):
    return drawn(UploadedClouds([cloud], "cpu"), [(0, None)], cam, behind)


def drawn(clouds, nodes, cam, behind=(0.0, 0.0, 0.0)):
    return clouds.draw([(cam, [DrawnCloud(*node) for node in nodes])], torch.tensor(behind), 0.1)[
        0
    ].on_host()


def moved(cloud, offset):
    return GaussianCloud(
        cloud.means + np.asarray(offset), cloud.quats, cloud.scales, cloud.opacities, cloud.sh
    )


# The kernels are interpreted: of cases that take the same branches one is tried in every run.
QUICK = {
    (name, 0.0)
    for name in (
        "no Gaussian",
        "saturated layers",
        "kilometre splats",
        "centre behind",
        "far off axis",
    )
} | {(name, MIP_PX2) for name in ("all shapes", "zero scale", "needle of 1,000 pixels")}


@pytest.mark.parametrize(
    ("name", "antialias_px2"),
    [
        pytest.param(*case, marks=[] if case in QUICK else [pytest.mark.slow])
        for case in product(HARD, (0.0, MIP_PX2))
    ],
)
def test_every_pixel_of_a_hard_case_is_within_one_grey_level(name, antialias_px2):
    cloud = replace(HARD[name], antialias_px2=antialias_px2)
    behind = (0.2, 0.3, 0.4)
    found = interpreted(cloud, camera(), behind)
    wanted = rasterize_reference(cloud, camera(), behind, brute=True)
    assert_same_image(found, wanted, LSB)
    assert np.mean(np.abs(found.rgb - wanted.rgb)) < 1e-4


def test_a_wall_at_the_near_plane_is_drawn_beyond_it_only():
    for z in (0.095, 0.105):
        wall = splats([[0, 0, z], [0.01, 0, z]], 0.1, 0.9)
        wanted = rasterize_reference(wall, camera())
        assert_same_image(interpreted(wall, camera()), wanted, LSB)
        assert wanted.alpha.any() == (z > 0.1)


def test_coordinates_of_utm_size_cost_no_precision():
    cloud = random_cloud(20, 8)
    offset = np.array([691_600.0, 5_334_760.0, 520.0])
    T = np.eye(4)
    T[:3, 3] = -offset
    far = camera(48, 32, 40.0, T)
    near = camera(48, 32, 40.0)
    assert_same_image(interpreted(moved(cloud, offset), far), interpreted(cloud, near), LSB)


def test_nodes_at_poses_in_two_views_at_once_equal_the_processor():
    clouds = [random_cloud(60, 1), *(random_cloud(20, seed, degree=1) for seed in (2, 3))]
    clouds[1] = replace(clouds[1], antialias_px2=MIP_PX2)
    poses = [None, *(random_rigid(seed, 1.0) for seed in (2, 3))]
    behind = np.random.default_rng(1).random((40, 60, 3)).astype(np.float32)
    nodes = [DrawnCloud(*pair) for pair in enumerate(poses)]
    placed = list(zip(map(prepare, clouds), poses, strict=True))
    T_shifted = np.eye(4)
    T_shifted[0, 3] = 0.7
    cameras = camera(60, 40, 50.0), camera(60, 40, 50.0, T_camera_world=T_shifted)
    views = list(zip(cameras, (nodes, nodes[1:]), strict=True))
    both = UploadedClouds(clouds, "cpu").draw(views, torch.tensor(behind))
    for found, cam, mine in zip(both, cameras, (placed, placed[1:]), strict=True):
        assert_same_image(found.on_host(), rasterize_prepared(mine, cam, behind), LSB)


def test_equal_depths_are_drawn_in_the_order_of_the_nodes():
    red, green = (splats([0, 0, 4.0], 3.0, 0.9, rgb) for rgb in ((1, 0, 0), (0, 1, 0)))
    clouds = UploadedClouds([red, green], "cpu")
    first = drawn(clouds, [(0, None), (1, np.eye(4))], camera()).rgb[32, 48]
    second = drawn(clouds, [(1, np.eye(4)), (0, None)], camera()).rgb[32, 48]
    assert first == pytest.approx([0.9, 0.09, 0], abs=2e-3)
    assert second == pytest.approx([0.09, 0.9, 0], abs=2e-3)


def test_lists_that_outgrow_their_room_are_drawn_again():
    cloud = random_cloud(60, 9)
    small = UploadedClouds([cloud], "cpu")
    small.capacity = 10
    found = drawn(small, [(0, None)], camera(48, 32, 40.0))
    assert small.capacity > 10
    assert_same_image(found, interpreted(cloud, camera(48, 32, 40.0)), 0.0)


def test_more_pairs_than_int32_counts_are_neither_cut_nor_taken_for_few():
    """At 8192 x 8192 pixels there are 262,144 tiles: so many splats that meet all of them."""
    nothing = torch.zeros(0)
    counts = torch.full((8193,), 262_144, dtype=torch.int32)
    count = int(ProjectedSplats(nothing, nothing, nothing, counts).pairs)
    assert count == 8193 * 262_144 > MOST_PAIRS
    lists = TileCompositor("cpu")
    capacity = lists.capacity
    assert not lists.had_room(capacity, count, views=2)  # each is drawn alone
    assert lists.capacity == capacity
    with pytest.raises(RendererError, match=str(count)):
        lists.had_room(capacity, count)
    assert not lists.had_room(capacity, MOST_PAIRS)
    assert lists.capacity == MOST_PAIRS
    assert lists.had_room(MOST_PAIRS, MOST_PAIRS)


@triton.jit
def write_first_numbers(out, blocks, BLOCK: tl.constexpr, RECORD: tl.constexpr):
    slot = slots_of(tl.load(blocks), BLOCK)
    tl.store(out + tl.arange(0, BLOCK), slot * RECORD)


def test_records_beyond_two_billion_numbers_have_places_of_their_own():
    first = 1_500_000  # of 128 Gaussians: 2.3e9 numbers stand before its records
    out = torch.zeros(BLOCK, dtype=torch.int64)
    blocks = torch.tensor([first], dtype=torch.int32)
    write_first_numbers[(1,)](out, blocks, BLOCK=BLOCK, RECORD=RECORD)
    assert torch.equal(out, (first * BLOCK + torch.arange(BLOCK)) * RECORD)


def test_a_window_shows_what_the_whole_image_does():
    cloud = random_cloud(60, 10)
    part = interpreted(cloud, camera().window(slice(8, 40), slice(16, 80)))
    whole = interpreted(cloud, camera())
    np.testing.assert_allclose(part.rgb, whole.rgb[8:40, 16:80], atol=1e-4)


@pytest.mark.parametrize("make", first_of(HARD_GRADIENTS))
def test_the_gradient_of_a_hard_case_is_that_of_the_reference(make):
    found, _ = kernel_gradients(make(), TileCompositor("cpu"))
    assert_close(found, numeric_gradients(make()), TOLERANCE)


def test_bad_devices_are_refused():
    with pytest.raises(InputError):
        UploadedClouds([], "gpu")
    if not torch.cuda.is_available():
        with pytest.raises(InfrastructureError):
            rasterize(random_cloud(1), camera(), backend="triton")


COMPILE = Path(__file__).parents[2] / "docs" / "scripts" / "compile_gpu_kernels.py"


@pytest.mark.slow
@pytest.mark.parametrize("capability", [90, 80])
def test_kernels_compile_without_spilling(capability):
    environment = {key: value for key, value in os.environ.items() if key != "TRITON_INTERPRET"}
    done = subprocess.run(
        [sys.executable, str(COMPILE), str(capability)],
        capture_output=True,
        text=True,
        env=environment,
        check=True,
    )
    lines = done.stdout.splitlines()
    names = "project list_tiles composite composite_backward project_lens composite_lens draw_tiles"
    assert [line.split()[0] for line in lines] == names.split()
    assert all("stack 0 " in line for line in lines), lines


@pytest.mark.gpu
def test_a_card_draws_what_the_reference_does():
    cloud = random_cloud(2000, 11)
    found = rasterize(cloud, camera(960, 544, 700.0), backend="triton")
    assert_same_image(found, rasterize_reference(cloud, camera(960, 544, 700.0)), LSB, 1e-4)
