"""Rooms, tables and garden paths: the same key gives the same place, light is stopped by blocks,
and the eye never stands in furniture.
"""

from __future__ import annotations

import numpy as np
import pytest

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.lab.interiors.light import Lamp, Light
from alpasim_plugin.lab.interiors.materials import plain, planks
from alpasim_plugin.lab.interiors.objects import OBJECTS
from alpasim_plugin.lab.interiors.places import FAMILIES, build_place
from alpasim_plugin.lab.interiors.shadow_kernels import nearest, reached
from alpasim_plugin.lab.interiors.surfaces import Block, Panel, Turned, block, upright

pytestmark = pytest.mark.slow  # pictures of a study that no drive needs

COARSE = 6.0


def rng(seed: int = 0) -> np.random.Generator:
    return stream("test", seed, "interior")


@pytest.mark.parametrize("family", sorted(FAMILIES))
def test_a_place_is_that_of_its_key_and_fills_the_picture(family: str) -> None:
    first, same, other = (build_place(family, "scene", seed, COARSE) for seed in (5, 5, 6))
    a, b = (
        np.concatenate([node.levels[0].cloud.sh for node in place.graph.background])
        for place in (first, same)
    )
    np.testing.assert_array_equal(a, b)
    assert len(first.graph) != len(other.graph)
    eye, target = first.walk.eye[4], first.walk.target[4]
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0, 0, 1]) / np.linalg.norm(np.cross(z, [0, 0, 1]))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), eye
    out = first.graph.render(PinholeCamera.from_hfov(64, 36, 1.2, T), {}, 1)
    below = out.alpha[20:] if family == "path" else out.alpha  # the sky has none
    assert np.percentile(below, 5) > 0.8
    assert out.rgb.std() > 0.08  # something is there to see


@pytest.mark.parametrize("family", sorted(FAMILIES))
def test_nobody_carries_a_camera_through_furniture(family: str) -> None:
    for seed in range(6):
        plan = FAMILIES[family](rng(seed))
        tall = [b for one in plan.standing for b in one.blocks() if b.T[2, 3] + b.half[2] > 1.0]
        gaps = nearest(plan.walk.eye, *_arrays(tall), 9.0)
        assert gaps.min() > 0.1, seed


@pytest.mark.parametrize("family", ["room", "table"])
def test_furniture_along_the_walls_stands_neither_in_other_furniture_nor_in_the_middle(
    family: str,
) -> None:
    for seed in range(8):
        feet = [
            one.footprint()
            for one in FAMILIES[family](rng(seed)).standing
            if one.name.startswith("wall")
        ]
        assert len(feet) >= 4, seed
        for i, (low, high) in enumerate(feet):
            assert np.any(low > 0.75) or np.any(high < -0.75), seed
            for other_low, other_high in feet[:i]:
                assert np.any(other_low > high - 0.02) or np.any(other_high < low + 0.02), seed


def _arrays(blocks: list[Block]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return (
        np.array([b.T[:3, :3] for b in blocks]),
        np.array([b.T[:3, 3] for b in blocks]),
        np.array([b.half for b in blocks]),
    )


def test_a_block_hides_what_is_behind_it_and_nothing_else() -> None:
    turned = Block(upright(0.0, 0.0, 1.0, np.pi / 4), np.array([0.5, 0.5, 0.1]))
    points = np.array([[0, 0, 0.0], [0.6, 0, 0.0], [0.9, 0, 0.0], [0, 0, 1.5]])
    arrays = _arrays([turned])
    np.testing.assert_array_equal(
        reached(points, np.array([0.0, 0, 9.0]), np.ones(4, dtype=bool), *arrays),
        [False, False, True, True],
    )
    np.testing.assert_array_equal(
        reached(points, np.array([0.0, 0, 9.0]), np.zeros(4, dtype=bool), *arrays), [False] * 4
    )
    np.testing.assert_allclose(
        nearest(points, *arrays, 5.0), [0.9, 0.9, np.hypot(0.9, 0.9 - np.sqrt(0.5)), 0.4], atol=1e-9
    )
    np.testing.assert_array_equal(
        nearest(
            points,
            *_arrays([turned])[:0] or (np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros((0, 3))),
            5.0,
        ),
        5.0,
    )


def test_a_floor_is_darker_in_the_shadow() -> None:
    floor = Panel((-1, -1, 0), (2, 0, 0), (0, 2, 0), plain(rng(), (0.5, 0.5, 0.5), 0.0)).surfels(
        0.1
    )
    light = Light((0.4, 0.4, 0.4), (Lamp(np.array([[0.0, 0.0, 3.0]]), (0.5, 0.5, 0.5)),))
    lit = light.colours(floor, [block((-0.2, -0.2, 0.5), (0.2, 0.2, 0.6))])[:, 0]
    middle = np.hypot(*floor.means[:, :2].T) < 0.15
    edge = np.hypot(*floor.means[:, :2].T) > 0.6
    assert lit[middle].max() < 0.6 * lit[edge].min()


def test_levels_of_detail_show_the_same_picture() -> None:
    panel = Panel((0, 0, 0), (1.2, 0, 0), (0, 0.6, 0), planks(rng(), (0.6, 0.4, 0.3), 0.12, 1.0))
    fine, coarse = panel.surfels(0.01), panel.surfels(0.02)
    assert len(fine.means) == 4 * len(coarse.means)
    assert np.abs(fine.rgb.mean(axis=0) - coarse.rgb.mean(axis=0)).max() < 0.02


def test_a_turned_body_faces_outwards_and_is_closed_around() -> None:
    body = Turned((1, 2, 3), [[0.1, 0], [0.2, 0.1], [0.1, 0.3]], plain(rng(), (1, 1, 1))).surfels(
        0.01
    )
    out = body.means - [1, 2, 3]
    assert (np.einsum("ij,ij->i", out[:, :2], body.normals[:, :2]) > 0).all()
    np.testing.assert_allclose(np.linalg.norm(body.normals, axis=1), 1.0)
    area = float((body.sizes[:, 0] * body.sizes[:, 1]).sum())
    cone = [np.pi * (a + b) * np.hypot(a - b, h) for a, b, h in ((0.1, 0.2, 0.1), (0.2, 0.1, 0.2))]
    assert area == pytest.approx(sum(cone), rel=0.02)


@pytest.mark.parametrize("make", OBJECTS, ids=lambda make: make.__name__)
def test_an_object_stands_on_the_table(make) -> None:  # type: ignore[no-untyped-def]
    surfels = make(rng(3)).surfels(0.01)
    assert -0.005 < surfels.means[:, 2].min() < 0.05
    assert np.isfinite(
        np.concatenate([surfels.means, surfels.normals, surfels.tangents, surfels.rgb], axis=1)
    ).all()
    assert np.abs(surfels.means[:, :2]).max() < 0.4
