"""What is wrong with a scenario file is said with file, line, column, what was found and what to
do.
"""

import pytest

from alpasim_plugin.core.errors import InputError
from scenarios.load import load_scenario

GOOD = """\
version: 1
road:
  segments:
    - {kind: straight, length_m: 200}
actors:
  - {kind: drive, id: lead, s_m: 60, speeds: [[0, 9]]}
timing: {duration_us: 6000000}
"""


TWICE = GOOD.replace("actors:", "actors:\n  - {kind: oncoming, id: lead, s_m: 90, speed_mps: 5}")
STRAIGHT = "    - {kind: straight, length_m: 200}"
FOLDED = f"    - {{kind: arc, length_m: 90, curvature_per_m: 0.2}}\n{STRAIGHT}"
SWERVE = f"    - {{kind: straight, length_m: 40}}\n    - {{kind: narrow_gap, length_m: 40, shift_m: -2}}\n{STRAIGHT}"
LATE = "kind: crossing_pedestrian, id: p, s_m: 150"


def fails(tmp_path, text):
    path = tmp_path / "scene.yaml"
    path.write_text(text)
    with pytest.raises(InputError) as e:
        load_scenario(path)
    for part in (e.value.message, e.value.hint):
        assert part.strip()
        assert "Traceback" not in part
    return e.value


def swap(old, new):
    assert old in GOOD
    return GOOD.replace(old, new)


@pytest.mark.parametrize(
    ("text", "at"),
    [
        (swap("length_m: 200}", "length_m: 200"), ":5:"),
        (swap("length_m: 200", "lenght_m: 200"), ":4:24"),
        (swap("length_m: 200", "length_m: long"), ":4:24"),
        (swap("version: 1\n", ""), ":1:1"),
        (swap("kind: drive", "kind: drives"), ":6:5"),
        (swap("kind: straight, ", ""), ":4:7"),
        (swap("    - {kind: straight, length_m: 200}", "    []"), ":3:3"),
        (swap("[[0, 9]]", "[[1, 9], [0, 5]]"), ":6:5"),
        (GOOD + "rates: {camera_us: 150000}\n", ":8:9"),
        (swap("6000000", "50000"), ":7:10"),
        (GOOD.replace("6000000}", "600000, warmup_us: 600000}"), ":7:31"),
        (TWICE, ":7:19"),
        (swap("road:", "log: {commonroad: a.xml}\nroad:"), ":1:1"),
        (GOOD + "cameras: []\n", ":8:1"),
        (GOOD + "cameras: [{name: a}, {name: a}]\n", ":8:22"),
        (GOOD + "degradation: {kind: none, share: 0.5}\n", ":8:1"),
        (GOOD + "environment: {sky: claer}\n", ":8:15"),
        (GOOD + "background: {file: none.ply}\n", ":8:14"),
        (GOOD + "scene_id: 'a b/c'\n", ":8:1"),
        (GOOD + "seed: -1\n", ":8:1"),
        ("", ":1:1"),
        ("version: 1\nscenarios: [a.yaml]\n", ":2:1"),
        ("just words\n", ":1:1"),
    ],
)
def test_wrong_content_is_placed(tmp_path, text, at):
    assert f"scene.yaml{at}" in fails(tmp_path, text).message


@pytest.mark.parametrize(
    ("text", "at"),
    [
        (swap("s_m: 60", "s_m: 600"), ":6:5"),
        (swap("s_m: 60", "s_m: 60, lane: 3"), ":6:5"),
        (swap("s_m: 60", "s_m: 60, lane: nowhere"), ":6:5"),
        (swap("length_m: 200", "length_m: 85"), ":3:3"),
        (swap("road:\n", "ego: {lane: 1}\nroad:\n"), ":2:1"),
        (swap(STRAIGHT, FOLDED).replace("road:\n", "road:\n  lanes_backward: 3\n"), ":4:3"),
        (swap("length_m: 200}", "length_m: 200}\n    - {kind: intersection}"), ":3:3"),
        (swap("    - {kind: straight", "    - {kind: merge}\n    - {kind: straight"), ":3:3"),
        (swap("kind: drive, id: lead, s_m: 60, speeds: [[0, 9]]", LATE), ":6:5"),
        (swap("s_m: 60, speeds: [[0, 9]]", "s_m: -15, speeds: [[0, 25]]"), ":6:5"),
        (GOOD + "ego: {lane_changes: [{at_m: 900, to_lane: 0}]}\n", ":8:1"),
    ],
)
def test_scenes_that_cannot_be_built_are_placed(tmp_path, text, at):
    e = fails(
        tmp_path,
        text + "jitter: {length: 0, position_m: 0, speed: 0, lane_width: 0, curvature: 0}\n",
    )
    assert f"scene.yaml{at}" in e.message


def test_ego_that_would_leave_its_lane_is_refused(tmp_path):
    fails(tmp_path, swap(STRAIGHT, SWERVE))


def test_actors_beside_a_recording_are_refused(tmp_path, repo):
    xml = repo / "scenarios" / "data" / "USA_US101-3_3_T-1.xml"
    e = fails(
        tmp_path,
        f"version: 1\nlog: {{commonroad: {xml}}}\nactors:\n  - {{kind: parked, id: a, s_m: 3}}\n",
    )
    assert ":3:1" in e.message


@pytest.mark.parametrize(
    ("log", "at"),
    [
        ("{commonroad: none.xml}", ":2:7"),
        ("{argoverse: nowhere}", ":2:7"),
        ("{commonroad: a.xml, usdz: b}", ":2:1"),
        ("{commonrode: a.xml}", ":2:7"),
    ],
)
def test_bad_log_sections(tmp_path, log, at):
    assert f"scene.yaml{at}" in fails(tmp_path, f"version: 1\nlog: {log}\n").message


def test_a_duration_beyond_the_recording_is_refused(repo):
    with pytest.raises(InputError) as e:
        load_scenario("real/us101", overrides=["timing.duration_us=9000000"])
    assert "--set timing.duration_us=9000000" in e.value.message


def test_missing_file_gives_the_nearest_shipped_names():
    with pytest.raises(InputError) as e:
        load_scenario("smoke/strait")
    assert "smoke/straight" in e.value.hint
    with pytest.raises(InputError, match="simrun list scenarios"):
        load_scenario("qqqqqq.yaml")


def test_usdz_and_unknown_files_are_refused_with_what_can_be_read(tmp_path):
    (tmp_path / "a.usdz").write_bytes(b"PK")
    with pytest.raises(InputError, match="no readable ZIP"):
        load_scenario(tmp_path / "a.usdz")
    (tmp_path / "a.bin").write_bytes(b"?")
    with pytest.raises(InputError) as e:
        load_scenario(tmp_path / "a.bin")
    assert "no reader recognises" in e.value.message
    assert "CommonRoad XML" in e.value.hint
    with pytest.raises(InputError, match="a folder with"):
        load_scenario(tmp_path)


def test_a_map_without_lanes_is_refused(tmp_path):
    path = tmp_path / "empty.xml"
    path.write_text(
        '<commonRoad timeStepSize="0.1" commonRoadVersion="2018b" benchmarkID="X"></commonRoad>'
    )
    with pytest.raises(InputError) as e:
        load_scenario(path)
    assert "empty.xml" in e.value.message
