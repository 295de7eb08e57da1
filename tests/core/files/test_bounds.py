"""Rule 1: every quantity has one bound, and every source is checked against it before anything is
built.
"""

from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.cli.options import parse_seeds
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.escape import MAX_PART
from alpasim_plugin.core.files import limits as bounds
from scenarios.budget import check_scenario, gaussians_of
from scenarios.load import load_scenario
from tests.core.files import past_failures as seen


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -0.3, 0.3])
def test_values_outside_a_bound_are_refused_with_number_range_and_reason(value):
    with pytest.raises(InputError) as error:
        bounds.CURVATURE_PER_M.check(value, "a.xml, road 3")
    assert "-0.2 to 0.2 1/m" in error.value.message
    assert "radius" in error.value.hint


@pytest.mark.parametrize("name", seen.SEEN)
def test_what_once_gave_way_is_refused(tmp_path, name):
    path = seen.SEEN[name](tmp_path)
    with pytest.raises(InputError) as error:
        load_scenario(str(path))
    parts = (error.value.message, error.value.hint)
    assert all(0 < len(part) <= MAX_PART for part in parts)


@pytest.mark.parametrize("text", ["1000000000000", "0", "-3", "nan", "9223372036854775808,1"])
def test_counts_of_seeds_are_bounded(text):
    with pytest.raises(InputError):
        parse_seeds(text)


def test_a_long_map_costs_what_the_drive_can_see(tmp_path):
    short, long = (
        load_scenario(str(seen.xodr(length)(folder(tmp_path, length))))
        for length in ("900", "9000")
    )
    assert long.ground.z.size <= 1.5 * short.ground.z.size
    assert len(long.lane_map.road_edges[0]) > 8 * len(
        short.lane_map.road_edges[0]
    )  # the map itself is whole


def folder(root, name):
    (root / name).mkdir()
    return root / name


def drive_of(length_m, scenario):
    n = len(scenario.ego_log)
    xyz = np.column_stack([np.linspace(0, length_m, n), np.zeros((n, 2))])
    return replace(scenario, ego_log=replace(scenario.ego_log, xyz=xyz))


@pytest.mark.parametrize(("cameras", "counted"), [("[{}]", 647_805), ("{rig: alpasim-4}", 912_395)])
def test_the_gaussians_of_a_built_street_are_known_before_it_is_built(cameras, counted):
    scenario = load_scenario("urban/one_way", overrides=[f"cameras={cameras}"])
    assert counted / 1.5 < gaussians_of(scenario) < 1.5 * counted


def test_the_cost_of_a_recorded_drive_is_refused_before_it_is_built():
    scenario = load_scenario("smoke/straight")
    check_scenario(drive_of(20_000.0, scenario), "a log")
    towers = replace(scenario.environment, buildings=1.0, building_height_m=(100.0, 200.0))
    with pytest.raises(InputError):
        check_scenario(replace(drive_of(1500.0, scenario), environment=towers), "a log")
    with pytest.raises(InputError, match="road users"):
        check_scenario(
            replace(scenario, actors=load_scenario("smoke/lead_car").actors * 1001), "a log"
        )
