"""Drives on maps that have none: routes, traffic lights, traffic, and what is refused.

Every map is made here.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from scenarios.load import load_scenario
from tests.files.test_opendrive import lane, road, section


def light(i: str, s: float, more: str = "", kind: str = "1000001", t: float = -5.0) -> str:
    return (
        f'<signal id="{i}" s="{s}" t="{t}" type="{kind}" dynamic="yes" orientation="+" '
        f'zOffset="0" height="3" width="0.4">{more}</signal>'
    )


def with_signals(text: str, *signals: str) -> str:
    return text.replace("</road>", f"<signals>{''.join(signals)}</signals></road>")


STOP = '<signal id="stop" s="90" t="0" type="294" dynamic="no" orientation="+" zOffset="0"/>'
BOTH = (lane(1, 1, 1), lane(-1, -1, -1))


def two_roads(*signals: str) -> tuple[str, ...]:
    """Two straights of 100 m and 300 m, one behind the other."""
    first = road("1", section(0, *BOTH), length=100, after="road:2:start")
    return (
        with_signals(first, *signals),
        road("2", section(0, *BOTH, lane(-2)), x=100, length=300, before="road:1:end"),
    )


def scenario(folder: Path, parts: tuple[str, ...], *overrides: str, seed: int | None = None):
    file = folder / "map.xodr"
    file.write_text(f"<OpenDRIVE>{''.join(parts)}</OpenDRIVE>", encoding="utf-8")
    return load_scenario(file, seed, ("map.vehicles=0", *overrides))


def named(start: str, goal: str) -> tuple[str, str]:
    return f"map.route.from={start}", f"map.route.to={goal}"


def test_a_named_route_is_driven_from_place_to_place(tmp_path):
    made = scenario(tmp_path, two_roads(), *named("1:20", "2:150"))
    assert made.source == "opendrive"
    assert made.route.lane_ids[:2] == ("1.0.-1", "2.0.-1")
    x = made.ego_log.xyz[:, 0] + made.world_origin[0]
    assert x[0] == pytest.approx(20.0, abs=0.2)
    assert x[-1] == pytest.approx(250.0, abs=1.0)
    assert np.allclose(made.ego_log.xyz[:, 1], -1.75, atol=0.05)
    assert made.route.xyz[-1, 0] > made.ego_log.xyz[-1, 0] + 80.0


def test_a_route_against_the_other_one_takes_the_other_side(tmp_path):
    made = scenario(tmp_path, two_roads(), *named("2:150", "1:20"))
    assert made.route.lane_ids[:2] == ("2.0.1", "1.0.1")
    assert np.allclose(made.ego_log.xyz[:, 1], 1.75, atol=0.05)


def test_a_route_changes_lanes_where_it_has_to(tmp_path):
    aside = '<geometry s="0" x="-100" y="-3.5" hdg="0" length="100"><line/></geometry>'
    parts = (
        road("0", section(0, lane(-1, None, -2)), length=100, after="road:1:start", view=aside),
        road("1", section(0, lane(-1, None, -1), lane(-2)), length=200, after="road:2:start"),
        road("2", section(0, lane(-1, -1)), x=200, length=200, before="road:1:end"),
    )
    made = scenario(tmp_path, parts, *named("0:50", "2:100"))
    assert made.route.lane_ids[:4] == ("0.0.-1", "1.0.-2", "1.0.-1", "2.0.-1")
    y = made.ego_log.xyz[:, 1] + made.world_origin[1]
    assert y[[0, -1]] == pytest.approx([-5.25, -1.75], abs=0.01)


def test_the_seed_draws_the_route(tmp_path):
    logs = [scenario(tmp_path, two_roads(), seed=seed).ego_log.xyz[0] for seed in (0, 0, 1)]
    assert np.array_equal(logs[0], logs[1])
    assert not np.array_equal(logs[0], logs[2])


@pytest.mark.parametrize(
    ("route", "value"),
    [
        (named("7:20", "2:150"), "7"),
        (named("1:20", "2:400"), "2:400"),
        (named("1:90", "1:20"), "1:20"),
        (("map.route.from=here",), "here"),
        (("map.route=shortest",), "shortest"),
        ((*named("1:20", "2:150"), "ego.lane=1"), "ego.lane"),
    ],
)
def test_a_route_that_the_map_does_not_have_is_refused(tmp_path, route, value):
    lonely = road("1", section(0, lane(-1, -1, -1)), length=100, after="road:2:start")
    parts = (lonely, road("2", section(0, lane(-1, -1)), x=100, length=300, before="road:1:end"))
    with pytest.raises(InputError) as error:
        scenario(tmp_path, parts, *route)
    assert value in error.value.message


def test_the_expert_waits_at_the_stop_line_and_who_drives_on_is_caught(tmp_path):
    made = scenario(tmp_path, two_roads(light("7", 98), STOP), *named("1:20", "2:150"))
    (signal,) = made.lane_map.signals
    assert signal.name == "7"
    assert signal.lanes == ("1.0.-1",)
    assert signal.stop[:, 0] + made.world_origin[0] == pytest.approx([90.0, 90.0])
    x = made.ego_log.xyz[:, 0] + made.world_origin[0]
    front = x + made.vehicle.rear_axle_to_centre_m + made.vehicle.box.length_m / 2
    stands = np.flatnonzero(np.diff(x) < 1e-6)
    assert 84.0 < front[stands[0]] < 90.0
    assert signal.colour_at(int(made.ego_log.t_us[np.searchsorted(front, 90.0)])) != "red"
    on_free_road_us = round((90.0 - front[0]) / 10.0 * 1e6)
    assert signal.colour_at(on_free_road_us) == "red"
