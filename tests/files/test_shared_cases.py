"""Small inputs in the form of public reports, kept beside the data sets: each one is read as its
README says.
"""

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.drives.opening import read_source
from scenarios.lanelet2 import read_street as read_lanelet2
from scenarios.load import load_scenario
from scenarios.opendrive import read_street as read_opendrive
from scenarios.recorded import SourceFiles


@pytest.fixture(scope="module")
def cases(shared_data):
    """Give the folder of the inputs, or skip where it is absent."""
    folder = shared_data.parent / "cases"
    if not folder.is_dir():
        pytest.skip(f"the folder {folder} is absent")
    return folder


def limits_kmh(lanes, *names):
    return [round(lanes[name].speed_limit_mps * 3.6) for name in names]


def test_limits_of_signs_are_applied_and_those_by_location_are_said(cases):
    street = read_lanelet2(SourceFiles(), cases / "t5-01-lanelet2-limits/map.osm")
    assert limits_kmh(street.lanes, "104", "105") == [60, 60]
    assert any("without a speed limit: 3" in note for note in street.notes)


@pytest.mark.parametrize("name", ["view_host_sv.osi", "lanes_ok_gt.osi"])
def test_the_ego_of_a_trace_is_the_host_that_it_names(cases, name):
    scenario = load_scenario(cases / "t5-02-osi" / name)
    assert [actor.actor_id for actor in scenario.actors] == ["3"]


@pytest.mark.parametrize(
    ("name", "kind"), [("detections_sd.osi", "SensorData"), ("update_tu.osi", "TrafficUpdate")]
)
def test_messages_without_ground_truth_are_refused_by_their_kind(cases, name, kind):
    with pytest.raises(InputError, match=kind):
        load_scenario(cases / "t5-02-osi" / name)


def test_a_lens_of_colmap_4_in_text_is_refused_as_a_lens(cases):
    with pytest.raises(InputError, match="SIMPLE_DIVISION: a lens that is not read"):
        read_source(cases / "t5-03-colmap4/text-division", need_files=False)


def test_rectangles_with_and_without_a_shift_of_their_origin_are_one_drive(cases):
    folder = cases / "t5-04-commonroad-origin-shift"
    drives = [load_scenario(folder / name) for name in ("centre.xml", "shift.xml")]
    ahead = [drive.actors[0].track.xyz for drive in drives]
    assert np.allclose(ahead[0], ahead[1], atol=1e-3)
    assert np.allclose(drives[0].ego_log.xyz, drives[1].ego_log.xyz, atol=1e-3)


def test_signals_that_a_map_does_not_name_are_sent_at_their_start_value(cases):
    pytest.importorskip("cantools", reason="the extra [can] is not installed")
    from alpasim_plugin.control.can_codec import load_map, open_codec

    codec = open_codec(*load_map(str(cases / "t5-06-dbc-start-value/map.yaml")))
    (sent, *_) = codec.map.send
    frame = codec.encode(sent, dict.fromkeys(sent.signals.values(), 10.0))
    values = codec.message(sent.message).decode(frame.data, decode_choices=False)
    assert (values["SPEED_VALID"], values["GEAR"], values["TEMP"]) == (1, 4, 20)


def test_lanelets_of_buses_are_no_lanes_of_cars(cases):
    street = read_lanelet2(SourceFiles(), cases / "t5-07-lanelet2-bus-lane/map.osm")
    closed = [name for name, lane in street.lanes.items() if lane.kind != "vehicle"]
    assert (sorted(closed), len(street.lanes)) == (["100", "101", "102"], 12)


def test_both_angles_of_view_give_a_focal_length(cases):
    drive = read_source(cases / "t5-08-transforms-two-angles/transforms.json", need_files=False)
    assert np.diag(drive.photographs[0].lens.K)[:2] == pytest.approx([180.0, 150.0], abs=1e-3)


@pytest.mark.parametrize(("name", "height_m"), [("level", 0.0), ("nolevel", -0.351)])
def test_a_level_lane_is_not_banked(cases, name, height_m):
    street = read_opendrive(SourceFiles(), cases / f"t5-11-odr-level-lane/{name}.xodr")
    (lane,) = street.lanes.values()
    assert lane.right[:, 2] == pytest.approx(height_m, abs=1e-3)
