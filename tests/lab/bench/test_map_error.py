"""A map that is off by a constant is the map seen from a camera that is off the other way."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from alpasim_plugin.block_fixers.settings import OneFixerSettings
from alpasim_plugin.core.geometry import interpolate
from alpasim_plugin.core.types import F64, U8, Scenario
from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.fixers.semantic_map.draw import draw_map
from alpasim_plugin.fixers.semantic_map.prepare import actor_boxes, prepare_map
from alpasim_plugin.gaussians.scene.degrade import log_actors
from alpasim_plugin.lab.bench.map_error import CONFIGURATIONS, MapShift, shifted_maps
from alpasim_plugin.lab.bench.paper import black_map, grouped, shifted
from alpasim_plugin.lab.paper import wrong_map
from alpasim_plugin.lab.paper.measured import Measured
from tests.gaussians.scene_maps import parked, straight, with_camera


@pytest.fixture(scope="module")
def street() -> Scenario:
    return with_camera(straight(actors=(parked("car", 22.0, -1.8),)), 64, 36)


def poses(street: Scenario) -> tuple[F64, np.ndarray]:
    t_us = np.array([street.start_us, street.start_us + 300_000])
    return np.stack(
        [interpolate(street.ego_log, int(t)) @ street.cameras[0].T_rig_camera for t in t_us]
    ), t_us


def drawn(street: Scenario, T: F64, t_us: int) -> U8:
    boxes = actor_boxes(log_actors(street, t_us), street.actors)
    return draw_map(prepare_map(street.lane_map), street.cameras[0], T, boxes)


def maps(street: Scenario, shift: MapShift) -> U8:
    return shifted_maps(street, street.cameras[0], *poses(street), shift)


def test_no_shift_is_the_map_itself(street: Scenario) -> None:
    T, t_us = poses(street)
    assert np.array_equal(
        maps(street, MapShift()),
        np.stack([drawn(street, p, int(t)) for p, t in zip(T, t_us, strict=True)]),
    )


@pytest.mark.parametrize("left_m", [0.5, -0.25])
def test_road_and_boxes_moved_alike_are_a_camera_moved_the_other_way(
    street: Scenario, left_m: float
) -> None:
    T, t_us = poses(street)
    rig = interpolate(street.ego_log, int(t_us[0]))
    moved = T[0].copy()
    moved[:3, 3] -= left_m * rig[:3, 1]
    assert np.array_equal(
        maps(street, MapShift(left_m, 0.0, left_m))[0], drawn(street, moved, int(t_us[0]))
    )


def test_lanes_and_boxes_move_alone(street: Scenario) -> None:
    plain = maps(street, MapShift())
    lanes = maps(street, MapShift(0.5))
    boxes = maps(street, MapShift(0, 0, 0.25))
    changed = [(a != plain).any(axis=-1)[0] for a in (lanes, boxes)]
    assert changed[0].any()
    assert changed[1].any()
    assert changed[1].sum() < changed[0].sum() / 2  # one car against the whole road


def test_a_box_is_over_configurations_and_its_dot_is_the_true_map(tmp_path: Path) -> None:
    found_at = {
        shift.label: {"lane_f1_syn": 0.9 - abs(shift.lanes_left_m), "psnr_db": 20.0}
        for shift in CONFIGURATIONS
    }
    values = {f"V9 {label}": {clip: found for clip in "ab"} for label, found in found_at.items()}
    raw = Measured({**values, "V5": {clip: {"lane_f1_syn": 0.3} for clip in "ab"}})
    measured, shifts = shifted(raw)
    assert len(shifts) == 45
    lines = wrong_map.ranges(measured, shifts).splitlines()
    assert "| lanes 0.25 m | 18 | 0.650 (0.650 to 0.650) | 20.000 (20.000 to 20.000) |" in lines
    assert "| boxes 0.00 m | 5 | 0.650 (0.400 to 0.900) | 20.000 (20.000 to 20.000) |" in lines
    wrong_map.plot(measured, shifts, tmp_path / "boxes.png")
    assert (tmp_path / "boxes.png").stat().st_size > 10_000


def test_a_black_map_is_the_bundles_own_fixer_with_another_input() -> None:
    bundle = fixer_settings("onefixer-dit-tiny").weights.bundle
    assert bundle is not None
    arm = black_map(Path(bundle))
    assert arm.spec is not None
    settings = arm.spec.settings
    assert isinstance(settings, OneFixerSettings)
    assert (settings.uses_map, settings.no_map, arm.spec.trained) == (False, "black", True)
    assert arm.label == "weights, black map"


def test_the_papers_configurations_are_grouped_by_distance() -> None:
    assert len(CONFIGURATIONS) == len({shift.label for shift in CONFIGURATIONS}) == 45
    values = {
        f"V9 {shift.label}": {"a": {"psnr_db": abs(shift.lanes_left_m)}} for shift in CONFIGURATIONS
    }
    found = grouped(Measured({**values, "V5": {"a": {"psnr_db": 7.0}}})).values
    assert found["V5"] == {"a": {"psnr_db": 7.0}}
    assert [found[f"V9, lanes {m} m aside"]["a"]["psnr_db"] for m in ("0.00", "0.25", "0.50")] == [
        0.0,
        0.25,
        0.5,
    ]
    groups = {name for name in found if "boxes" in name}
    assert groups == {f"V9, boxes {m} m aside" for m in ("0.00", "0.25", "0.35")}
    assert found["V9, boxes 0.35 m aside"]["a"]["psnr_db"] == pytest.approx(
        0.3
    )  # the mean over 20 of 45
