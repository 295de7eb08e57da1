"""Cuboid F1 on boxes whose outlines are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.lab.learned_metrics.cuboids import cuboid_areas, cuboid_f1, union_mask
from alpasim_plugin.lab.learned_metrics.types import Cuboid, cuboid_corners, hull_pixels

K = np.array([[100.0, 0.0, 128.0], [0.0, 100.0, 72.0], [0.0, 0.0, 1.0]])
SIZE = (144, 256)
# Seen from behind at yaw -90 degrees: the length lies along z. Its nearest face is 4 m wide and 2 m
# high, 10 m away.
FRONTAL = Cuboid("car", 0.8, 0.0, 0.0, 12.0, 4.0, 2.0, 4.0, -np.pi / 2)


def shifted(box: Cuboid, x_m: float) -> Cuboid:
    return replace(box, x_m=box.x_m + x_m)


def test_the_outline_of_a_box_seen_head_on_is_its_nearest_face() -> None:
    hull = hull_pixels(FRONTAL, K)
    assert hull is not None
    assert hull.min(axis=0) == pytest.approx([108.0, 62.0], abs=1e-4)
    assert hull.max(axis=0) == pytest.approx([148.0, 82.0], abs=1e-4)
    assert (
        abs(int(union_mask([FRONTAL], K, SIZE).sum()) - 40 * 20) <= 61
    )  # a pixel of border on each side


def test_yaw_turns_about_the_cameras_y_axis() -> None:
    ahead = cuboid_corners(replace(FRONTAL, yaw_rad=-np.pi / 2))
    assert np.ptp(ahead[:, 2]) == pytest.approx(4.0)
    assert np.ptp(ahead[:, 0]) == pytest.approx(4.0)
    aside = cuboid_corners(replace(FRONTAL, length_m=6.0, yaw_rad=0.0))
    assert np.ptp(aside[:, 0]) == pytest.approx(6.0)
    assert np.ptp(aside[:, 1]) == pytest.approx(2.0)


def test_equal_boxes_score_one_and_disjoint_ones_zero() -> None:
    assert cuboid_f1([[FRONTAL]], [[FRONTAL]], K, SIZE) == 1.0
    assert cuboid_f1([[FRONTAL]], [[shifted(FRONTAL, 8.0)]], K, SIZE) == 0.0


def test_half_a_width_aside_scores_a_half() -> None:
    flat = replace(FRONTAL, length_m=0.01, z_m=10.0)
    assert cuboid_f1([[flat]], [[shifted(flat, 2.0)]], K, SIZE) == pytest.approx(0.5, abs=0.03)


def test_areas_are_pooled_over_the_clip() -> None:
    other = shifted(FRONTAL, 8.0)
    both, made, reference = cuboid_areas(
        [[FRONTAL], [], [FRONTAL]], [[FRONTAL], [FRONTAL], [other]], K, SIZE
    )
    assert cuboid_f1(
        [[FRONTAL], [], [FRONTAL]], [[FRONTAL], [FRONTAL], [other]], K, SIZE
    ) == pytest.approx(2 * both / (made + reference))
    assert both < made < reference


def test_boxes_that_overlap_count_once() -> None:
    assert cuboid_f1([[FRONTAL, FRONTAL]], [[FRONTAL]], K, SIZE) == 1.0


def test_unsure_near_and_other_boxes_do_not_count() -> None:
    for box in (
        replace(FRONTAL, score=0.09),
        replace(FRONTAL, z_m=2.4),
        replace(FRONTAL, label="pedestrian"),
        replace(FRONTAL, z_m=-20.0),
    ):
        assert not union_mask([box], K, SIZE).any()
    assert union_mask([replace(FRONTAL, score=0.10)], K, SIZE).any()


def test_a_clip_without_boxes_has_no_value_and_with_boxes_on_one_side_zero() -> None:
    assert cuboid_f1([[], []], [[], []], K, SIZE) is None
    assert cuboid_f1([[FRONTAL]], [[]], K, SIZE) == 0.0
