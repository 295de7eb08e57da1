"""Render prepared nodes: rigid poses, colour frames, culling, order, threads."""

import multiprocessing
import pickle

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.gaussians import GaussianCloud, prepare, rasterize, rasterize_prepared
from alpasim_plugin.gaussians.constants import BLOCK_REACH, RADIUS_X, RADIUS_Y, RECORD
from alpasim_plugin.gaussians.raster import rasterize_cpu as cpu
from alpasim_plugin.gaussians.raster.raster_kernels import (
    composite_tiles,
)
from alpasim_plugin.gaussians.raster.rasterize_reference import rasterize_reference
from tests.gaussians.driving_scene import driving_camera, driving_like_scene
from tests.gaussians.gaussian_scenes import (
    assert_same_image,
    camera,
    random_cloud,
    random_rigid,
    splats,
)


def small_object(seed, n=150):
    cloud = random_cloud(n, seed)
    return GaussianCloud(
        (cloud.means - [0, 0, 6]) * 0.2, cloud.quats, cloud.scales * 0.3, cloud.opacities, cloud.sh
    )


def test_nodes_at_poses_equal_one_cloud_moved_there():
    background = random_cloud(200, 1)
    nodes = [(prepare(background), None)]
    clouds = [background]
    for seed in range(4):
        T = random_rigid(seed, 1.5)
        T[2, 3] += 5.0
        nodes.append((prepare(small_object(seed)), T))
        clouds.append(small_object(seed).transformed(T))
    found = rasterize_prepared(nodes, camera(), (0.2, 0.3, 0.4))
    assert_same_image(
        found,
        rasterize_reference(GaussianCloud.concatenate(clouds), camera(), (0.2, 0.3, 0.4)),
        3e-5,
        odd_share=5e-4,
    )


def test_equal_depths_are_drawn_in_node_order():
    red = prepare(splats([0, 0, 4.0], 3.0, 0.9, (1, 0, 0)))
    green = prepare(splats([0, 0, 4.0], 3.0, 0.9, (0, 1, 0)))
    first = rasterize_prepared([(red, None), (green, np.eye(4))], camera()).rgb[32, 48]
    second = rasterize_prepared([(green, np.eye(4)), (red, None)], camera()).rgb[32, 48]
    assert first == pytest.approx([0.9, 0.09, 0], abs=2e-3)
    assert second == pytest.approx([0.09, 0.9, 0], abs=2e-3)


def test_culling_never_changes_the_image():
    """Nothing that the per-splat rule would draw is lost, from any direction."""
    scene = driving_like_scene(3000, seed=4)
    parts = [prepare(scene.take(np.flatnonzero(np.arange(3000) % 7 == k))) for k in range(7)]
    for seed in range(6):
        T = random_rigid(seed, 3.0)
        T[:3, 3] += [20.0, 0, 3.0]
        cam = camera(T_camera_world=np.linalg.inv(T))
        out = rasterize_prepared([(part, None) for part in parts], cam)
        whole = rasterize_reference(scene, cam)
        assert_same_image(out, whole, 5e-5, odd_share=1e-3)


def test_many_parts_of_all_kinds_in_one_call_equal_the_reference_and_their_copies_from_another_process():
    """Empty ones, single splats, several bundles, every degree of colours, both colour frames, at
    rest and moved, in view and behind.
    """
    rng = np.random.default_rng(5)
    nodes = []
    clouds = []
    for i in range(90):
        n = int(rng.choice([0, 1, 17, 40, 300]))
        degree = int(rng.integers(0, 4))
        cloud = small_object(i, n) if n else GaussianCloud.empty()
        cloud = GaussianCloud(
            cloud.means,
            cloud.quats,
            cloud.scales,
            cloud.opacities * rng.uniform(),
            cloud.sh[:, : (degree + 1) ** 2],
        )
        T = None if i % 3 == 0 else random_rigid(i, 3.0)
        if T is not None:
            T[2, 3] += 4.0
        nodes.append((prepare(cloud), T))
        clouds.append(cloud if T is None else cloud.transformed(T))
    found = rasterize_prepared(nodes, camera(), threads=1)
    size = max(cloud.sh.shape[1] for cloud in clouds)
    whole = GaussianCloud.concatenate(
        [
            GaussianCloud(
                c.means,
                c.quats,
                c.scales,
                c.opacities,
                np.pad(c.sh, ((0, 0), (0, size - c.sh.shape[1]), (0, 0))),
            )
            for c in clouds
        ]
    )
    assert_same_image(found, rasterize_reference(whole, camera()), 3e-5, odd_share=5e-4)
    sent = pickle.loads(pickle.dumps(nodes))
    for again in (
        rasterize_prepared(nodes, camera(), threads=3),
        rasterize_prepared(sent, camera(), threads=1),
    ):
        assert np.array_equal(found.rgb, again.rgb)
        assert np.array_equal(found.depth, again.depth)


@pytest.mark.parametrize("fault", ["mirror", "scale", "nan", "shape"])
def test_a_pose_that_is_not_rigid_is_an_error(fault):
    T = np.eye(4)
    if fault == "mirror":
        T[0, 0] = -1
    elif fault == "scale":
        T[:3, :3] *= 1.01
    elif fault == "nan":
        T[1, 3] = np.nan
    else:
        T = np.eye(3)
    with pytest.raises(InputError):
        rasterize_prepared([(prepare(splats([0, 0, 3.0])), T)], camera())


@pytest.mark.parametrize("n", [2_000, 30_000])
def test_any_number_of_threads_gives_the_same_bits(n):
    scene = prepare(driving_like_scene(n))
    cam = driving_camera(200, 120)
    one = rasterize_prepared([(scene, None)], cam, threads=1)
    for threads in (2, 3, 7):
        for _ in range(3):
            other = rasterize_prepared([(scene, None)], cam, threads=threads)
            assert np.array_equal(one.rgb, other.rgb)
            assert np.array_equal(one.alpha, other.alpha)
            assert np.array_equal(one.depth, other.depth)


def _render_in_child(queue):
    scene = prepare(driving_like_scene(9_000))
    cam = driving_camera(64, 36)
    queue.put(float(rasterize_prepared([(scene, None)], cam, threads=2).rgb.sum()))


def test_a_forked_process_renders_after_its_parent_used_threads():
    scene = prepare(driving_like_scene(9_000))
    cam = driving_camera(64, 36)
    want = float(rasterize_prepared([(scene, None)], cam, threads=2).rgb.sum())
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=_render_in_child, args=(queue,))
    child.start()
    assert queue.get(timeout=60) == want
    child.join(timeout=60)
    assert child.exitcode == 0


def test_read_only_and_strided_inputs_meet_the_kernels_that_are_already_compiled():
    image = np.broadcast_to(np.float32([0.1, 0.2, 0.3]), (64, 96, 3))
    cloud = random_cloud(50)
    rasterize(cloud, camera())
    compiled = len(composite_tiles.signatures)
    locked = GaussianCloud(
        cloud.means[::2], cloud.quats[::2], cloud.scales[::2], cloud.opacities[::2], cloud.sh[::2]
    )
    assert_same_image(
        rasterize(locked, camera(), image), rasterize_reference(locked, camera(), image)
    )
    assert_same_image(
        rasterize(locked, camera(), np.asfortranarray(image)),
        rasterize_reference(locked, camera(), image),
    )
    assert len(composite_tiles.signatures) == compiled


@pytest.mark.parametrize("bits", [1, 8, 11, 12, 23, 31])
def test_the_order_by_depth_is_that_of_a_sort_by_depth_and_identity(bits):
    """Few bits give many equal depths, many bits several passes of the sort."""
    rng = np.random.default_rng(bits)
    keys = rng.integers(0, min(2**bits, 0x7F000000), 5000).astype(np.int32)
    depths = keys.view(np.float32)
    ids = rng.permutation(5000) * 7
    expected = np.lexsort((ids, keys))
    np.testing.assert_array_equal(cpu.depth_order(depths, ids), expected)


def test_one_splat_and_none_have_an_order():
    none = cpu.depth_order(np.zeros(0, dtype=np.float32), np.zeros(0, dtype=np.int64))
    assert none.shape == (0,)
    single = cpu.depth_order(np.float32([3.5]), np.array([9]))
    assert single.tolist() == [0]


def test_a_background_is_blended_as_array_arithmetic_does(monkeypatch):
    """The kernel that blends it rounds as a multiplication, an addition and a division each do."""
    scene = prepare(driving_like_scene(2500, seed=5))
    cam = driving_camera(90, 50)
    behind = np.random.default_rng(1).random((50, 90, 3), dtype=np.float32)
    sums = []

    def without(tiles, records, kept, behind, camera, threads):
        sums.append(composite(tiles, records, kept, None, camera, threads))
        return composite(tiles, records, kept, behind, camera, threads)

    composite = cpu.composite
    monkeypatch.setattr(cpu, "composite", without)
    for background in (behind, (0.2, 0.9, 1.5)):
        out = rasterize_prepared([(scene, None)], cam, background, threads=1)
        colour, alpha, depth_sum = sums.pop()
        blended = colour + (1 - alpha[..., None]) * np.float32(background)
        depth = np.divide(depth_sum, alpha, out=np.zeros_like(alpha), where=alpha > 0)
        np.testing.assert_array_equal(out.rgb, np.clip(blended, 0, 1))
        np.testing.assert_array_equal(out.alpha, alpha)
        np.testing.assert_array_equal(out.depth, depth)


def test_tiles_and_blocks_change_no_bit_against_every_splat_on_every_pixel(monkeypatch):
    """Same arithmetic with all culling switched off: what the tiles and blocks skip is exactly what
    the alpha cut would skip.
    """
    scene = prepare(driving_like_scene(2500, seed=3))
    cam = driving_camera(90, 50)
    tiled = rasterize_prepared([(scene, None)], cam, threads=1)
    seen = {}

    def everywhere(cursor, tiles_x, starts, lists, records, *images):
        count = len(seen["order"])
        table = records[: count * RECORD].reshape(count, RECORD).copy()
        table[:, [RADIUS_X, RADIUS_Y, BLOCK_REACH]] = 1e30
        n_tiles = len(starts) - 1
        full = np.tile(seen["order"].astype(np.int32), n_tiles)
        starts = np.arange(n_tiles + 1) * count
        composite_tiles(cursor, tiles_x, starts, full, table.reshape(-1), *images)

    def ordered(*args):
        seen["order"] = depth_order(*args)
        return seen["order"]

    depth_order = cpu.depth_order
    monkeypatch.setattr(cpu, "depth_order", ordered)
    monkeypatch.setattr(cpu, "composite_tiles", everywhere)
    brute = rasterize_prepared([(scene, None)], cam, threads=1)
    assert len(seen["order"]) > 1000
    assert np.array_equal(tiled.rgb, brute.rgb)
    assert np.array_equal(tiled.depth, brute.depth)
