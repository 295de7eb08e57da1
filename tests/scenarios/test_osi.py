"""OSI traces: drive, traffic and lanes, both kinds of messages, and what is refused.

Small traces are made here. The real ones are compared with facts and with a table that another tool
made of one of them.
"""

import csv

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import Vehicle
from scenarios.load import load_scenario
from scenarios.osi_messages import message_classes

CLASSES = message_classes()
TRUTH, VIEW = CLASSES["GroundTruth"], CLASSES["SensorView"]


def moving(message, key, x, y, yaw=0.0, kind=2):
    one = message.moving_object.add(type=kind)
    one.id.value = key
    size = one.base.dimension
    place = one.base.position
    size.length, size.width, size.height = (4.0, 1.8, 1.5) if kind == 2 else (0.5, 0.5, 1.8)
    place.x, place.y, place.z = x, y, size.height / 2
    one.base.orientation.yaw = yaw


def lane(message, key, y, forward):
    """Add a lane 3 m wide from x = 0 to 200 m, with borders of its own."""
    one = message.lane.add()
    one.id.value = key
    facts = one.classification
    facts.type, facts.subtype, facts.centerline_is_driving_direction = 2, 2, forward
    for x in (0.0, 200.0):
        facts.centerline.add(x=x, y=y)
    for ids, side in ((facts.left_lane_boundary_id, 1), (facts.right_lane_boundary_id, -1)):
        border = message.lane_boundary.add()
        border.id.value = 10 * key + side + 1
        ids.add(value=border.id.value)
        border.classification.type, border.classification.color = (3, 4) if side > 0 else (2, 0)
        for x in (200.0, 0.0, 100.0):
            border.boundary_line.add().position.x = x
            border.boundary_line[-1].position.y = y + 1.5 * side


def messages(host=7, lanes=True):
    out = []
    for step in range(30):
        message = TRUTH()
        message.timestamp.seconds, message.timestamp.nanos = divmod(step * 100_000_000, 10**9)
        if host is not None:
            message.host_vehicle_id.value = host
        if lanes and step == 0:
            lane(message, 1, -1.5, True)
            lane(message, 2, 1.5, False)
        moving(message, 3, 100.0 - step, 1.5, np.pi)
        moving(message, 7, 10.0 + step, -1.5)
        if 5 <= step < 20:
            moving(message, 9, 60.0, -8.0 + 0.1 * step, np.pi / 2, kind=3)
        out.append(message)
    return out


def written(folder, parts, name="trace.osi"):
    blocks = [part.SerializeToString() for part in parts]
    file = folder / name
    file.write_bytes(b"".join(len(b).to_bytes(4, "little") + b for b in blocks))
    return file


def test_the_host_vehicle_is_the_ego_among_recorded_traffic(tmp_path):
    made = load_scenario(written(tmp_path, messages()))
    assert made.source == "osi"
    x = made.ego_log.xyz[:, 0] + made.world_origin[0] + made.vehicle.rear_axle_to_centre_m
    assert x[[0, -1]] == pytest.approx([10.0, 39.0])
    by = {actor.actor_id: actor for actor in made.actors}
    assert {key: actor.label for key, actor in by.items()} == {"3": "car", "9": "pedestrian"}
    assert by["9"].track.t_us[[0, -1]].tolist() == [500_000, 1_900_000]
    one = made.lane_map.lanes["1"]
    other = made.lane_map.lanes["2"]
    assert one.centre[-1, 0] > one.centre[0, 0]
    assert other.centre[-1, 0] < other.centre[0, 0]
    assert (one.left_mark_type, one.right_mark_type) == ("solid_yellow", "none")
    assert len(one.left) == 3
    assert made.route.lane_ids == ("1",)


def test_a_trace_of_sensor_views_is_the_same_drive(tmp_path):
    views = []
    for message in messages():
        view = VIEW()
        view.global_ground_truth.CopyFrom(message)
        views.append(view)
    one = load_scenario(written(tmp_path, messages()))
    other = load_scenario(written(tmp_path, views, "views.osi"))
    assert np.array_equal(one.ego_log.xyz, other.ego_log.xyz)
    assert list(one.lane_map.lanes) == list(other.lane_map.lanes)


def views_of(parts, host=None):
    views = []
    for message in parts:
        view = VIEW()
        view.global_ground_truth.CopyFrom(message)
        if host is not None:
            view.host_vehicle_id.value = host
        views.append(view)
    return views


@pytest.mark.parametrize("inside", [None, 3])
def test_the_host_of_a_view_is_the_ego(tmp_path, inside):
    made = load_scenario(written(tmp_path, views_of(messages(host=inside), host=7)))
    assert made.ego_log.xyz[-1, 0] > made.ego_log.xyz[0, 0]
    assert {actor.actor_id for actor in made.actors} == {"3", "9"}


def test_messages_without_ground_truth_are_refused_by_their_kind(tmp_path):
    update = CLASSES["TrafficUpdate"]()
    update.update.add().CopyFrom(messages()[0].moving_object[0])
    data = CLASSES["SensorData"]()
    data.moving_object.add().base.position.x = 1.0
    views = CLASSES["SensorData"]()
    views.sensor_view.add().CopyFrom(views_of(messages()[:1])[0])
    for part, name in ((update, "TrafficUpdate"), (data, "SensorData"), (views, "SensorData")):
        with pytest.raises(InputError, match=name):
            load_scenario(written(tmp_path, [part]))


def in_mcap(file, parts, schema="osi3.GroundTruth", compression=None):
    writer = pytest.importorskip("mcap.writer")
    with file.open("wb") as stream:
        made = writer.Writer(stream, compression=compression or writer.CompressionType.ZSTD)
        made.start()
        kind = made.register_schema(name=schema, encoding="protobuf", data=b"")
        channel = made.register_channel(topic="truth", message_encoding="protobuf", schema_id=kind)
        for number, part in enumerate(parts):
            made.add_message(channel, number, part.SerializeToString(), number)
        made.finish()
    return file


def test_an_mcap_file_holds_the_same_trace(tmp_path):
    one = load_scenario(written(tmp_path, messages()))
    other = load_scenario(in_mcap(tmp_path / "trace.mcap", messages()))
    views = views_of(messages(), host=7)
    third = load_scenario(in_mcap(tmp_path / "view.mcap", views, "osi3.SensorView"))
    assert np.array_equal(one.ego_log.xyz, other.ego_log.xyz)
    assert np.array_equal(one.ego_log.xyz, third.ego_log.xyz)
    with pytest.raises(InputError, match=r"truth \(foxglove.CompressedImage\)"):
        load_scenario(in_mcap(tmp_path / "none.mcap", messages(), "foxglove.CompressedImage"))


def axles(rear=None, front=None):
    parts = messages()
    for part in parts:
        for one in part.moving_object:
            if rear is not None:
                one.vehicle_attributes.bbcenter_to_rear.x = rear
            if front is not None:
                one.vehicle_attributes.bbcenter_to_front.x = front
    return parts


@pytest.mark.parametrize(
    ("rear", "front", "behind_m", "noted"),
    [
        (-1.2, 1.3, 1.2, False),
        (1.2, 1.3, 1.2, True),  # esmini's sign
        (-2.5, 1.3, None, True),
        (-2.0, None, None, True),  # at the bumper
        (-1.2, 2.9, None, True),
        (0.0, 0.0, None, True),
        (None, None, None, False),
    ],
)
def test_axles_that_cannot_be_are_put_right_and_noted(tmp_path, rear, front, behind_m, noted):
    made = load_scenario(written(tmp_path, axles(rear, front)))
    usual_m = Vehicle().rear_axle_to_centre_m * 4.0 / Vehicle().box.length_m
    assert made.vehicle.rear_axle_to_centre_m == pytest.approx(behind_m or usual_m)
    assert any("axle" in note for note in made.notes) == noted


@pytest.mark.parametrize(
    ("raised_m", "rig_m", "ground_m", "noted"),
    [(0.1, 0.1, 0.0, False), (0.75, 0.75, 0.75, True), (-0.75, 0.0, 0.0, True)],
)
def test_lanes_and_wheels_are_brought_to_one_height(tmp_path, raised_m, rig_m, ground_m, noted):
    parts = messages()
    for part in parts:
        for one in part.moving_object:
            one.base.position.z += raised_m
    made = load_scenario(written(tmp_path, parts))
    assert made.ego_log.xyz[:, 2] == pytest.approx(rig_m)
    assert made.lane_map.lanes["1"].left[:, 2] == pytest.approx(ground_m)
    assert any("wheels of the ego" in note or "in the road" in note for note in made.notes) == noted


def test_a_drive_that_climbs_above_its_lanes_is_refused(tmp_path):
    parts = messages()
    for step, part in enumerate(parts):
        part.moving_object[1].base.position.z += 0.1 * step
    with pytest.raises(InputError, match="above the lanes"):
        load_scenario(written(tmp_path, parts))


def test_without_host_and_lanes_the_first_vehicle_drives_on_its_own_path(tmp_path):
    made = load_scenario(written(tmp_path, messages(host=None, lanes=False)))
    assert [actor.actor_id for actor in made.actors] == ["7", "9"]
    assert list(made.lane_map.lanes) == ["corridor"]
    assert made.lane_map.road_edges


def broken(change):
    parts = messages()
    change(parts)
    return parts


BROKEN = {
    "object 7": broken(lambda parts: setattr(parts[3].moving_object[1].base.position, "x", np.nan)),
    "no moving object '8'": messages(host=8),
    "0 moving objects": [TRUTH(timestamp={"seconds": 1})],
    "object 3: a time": broken(lambda parts: parts.append(parts[0])),
    "1 pose": messages()[:1],
    "lane 1": broken(
        lambda parts: setattr(parts[0].lane[0].classification.centerline[0], "y", 1e9)
    ),
}


@pytest.mark.parametrize("named", BROKEN)
def test_a_broken_trace_is_refused_by_what_is_wrong(tmp_path, named):
    with pytest.raises(InputError) as error:
        load_scenario(written(tmp_path, BROKEN[named]))
    assert named in error.value.message


@pytest.mark.parametrize("change", [lambda b: b[:-3], lambda b: b + b"\0\0\0\0", lambda b: b[1:]])
def test_a_trace_that_ends_early_or_is_none_is_refused_by_its_message(tmp_path, change):
    file = written(tmp_path, messages())
    file.write_bytes(change(file.read_bytes()))
    with pytest.raises(InputError) as error:
        load_scenario(file)
    assert "message" in error.value.message


def test_esmini_s_traces_have_the_poses_and_roads_of_their_facts(shared_data):
    folder = shared_data / "opendrive-esmini" / "osi"
    made = load_scenario(folder / "pedestrian.osi")
    with (folder / "example.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    (walker,) = made.actors
    assert walker.label == "pedestrian"
    truth = np.array([[float(r["x"]), float(r["y"])] for r in rows if r["idx"] == "1"])
    assert walker.track.xyz[:, :2] + made.world_origin[:2] == pytest.approx(truth, abs=1e-6)
    inside = [lane for lane in made.lane_map.lanes.values() if lane.is_intersection]
    assert len(inside) == 12
    assert all(lane.successors[0] in made.lane_map.lanes for lane in inside)
    cut_in = load_scenario(folder / "alks_cut-in.osi")
    centre = (
        cut_in.ego_log.xyz[:, 0] + cut_in.world_origin[0] + cut_in.vehicle.rear_axle_to_centre_m
    )
    assert centre[[0, -1]] == pytest.approx([31.4, 153.503], abs=1e-3)
    other = cut_in.actors[0].track.xyz[[0, -1], :2] + cut_in.world_origin[:2]
    assert other == pytest.approx(np.array([[51.45, 1.535], [221.911, -1.535]]), abs=1e-3)


def test_lanes_that_cannot_be_driven_are_counted_by_the_reason(tmp_path):
    parts = messages()
    for key in (3, 4, 5):
        lane(parts[0], key, 4.5, True)
    *_, without_line, without_border, sidewalk = (one.classification for one in parts[0].lane)
    del without_line.centerline[:]
    del without_border.left_lane_boundary_id[:]
    sidewalk.type, sidewalk.subtype = 3, 0
    made = load_scenario(written(tmp_path, parts))
    assert list(made.lane_map.lanes) == ["1", "2"]
    assert [note for note in made.notes if note.startswith("lanes ")] == [
        "lanes that are not driven left out: 1",
        "lanes without a boundary on both sides left out: 1",
        "lanes without a centre line left out: 1",
    ]


def test_lanes_that_only_later_messages_have_are_said(tmp_path):
    parts = messages()
    lane(parts[5], 1, -1.5, True)
    lane(parts[6], 8, 4.5, True)
    made = load_scenario(written(tmp_path, parts))
    assert list(made.lane_map.lanes) == ["1", "2"]
    assert "1 lanes of later ones left out" in str(made.notes)
    assert "of later ones" not in str(load_scenario(written(tmp_path, messages())).notes)


def test_fields_that_are_not_read_are_named(tmp_path):
    parts = messages()
    # Field 12, environmental_conditions, and field 99, which OSI 3.8 does not have, with two bytes.
    parts[0].MergeFromString(b"\x62\x02ab\x9a\x06\x02ab")
    (note,) = [note for note in load_scenario(written(tmp_path, parts)).notes if "not read" in note]
    assert "GroundTruth/environmental_conditions (1)" in note
    assert "GroundTruth/field 99 (1)" in note
