"""Seeds: the same file and seed give the same bits; another seed gives another scene inside the
declared ranges.
"""

import dataclasses

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from scenarios.load import load_scenario

pytestmark = pytest.mark.slow

BASE = """
version: 1
road:
  lane_width_m: 3.5
  segments:
    - {kind: straight, length_m: 100}
    - {kind: clothoid, length_m: 30, end_curvature_per_m: 0.01}
    - {kind: arc, length_m: 120, curvature_per_m: 0.01}
ego: {speed_mps: 10, cruise_mps: 10}
actors:
  - {kind: drive, id: lead, s_m: 40, speeds: [[0, 10]]}
  - {kind: parked, id: parked, s_m: 30, clearance_m: 0.5}
"""


def write(folder, more=""):
    path = folder / "scene.yaml"
    path.write_text(BASE + more)
    return path


def bits(value):
    """Return plain data in which every array is its bytes."""
    if isinstance(value, np.ndarray):
        return (value.dtype.str, value.shape, value.tobytes())
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: bits(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {k: bits(v) for k, v in value.items()}
    return [bits(v) for v in value] if isinstance(value, tuple | list) else value


@pytest.mark.parametrize(
    "name", ["smoke/lead_car", "hard/occluded_pedestrian", "urban/junction_left", "real/us101"]
)
def test_same_file_and_seed_give_a_bit_identical_scenario(name):
    assert bits(load_scenario(name, seed=5)) == bits(load_scenario(name, seed=5))


def test_other_seeds_change_road_actors_and_hash_and_name_the_scene(tmp_path):
    path = write(tmp_path)
    scenes = [load_scenario(path, seed=seed) for seed in range(5)]
    assert len({s.content_hash for s in scenes}) == 5
    assert len({s.scene_id for s in scenes}) == 5
    assert len({float(s.lane_map.lanes["s2_f0"].centre[-1, 0]) for s in scenes}) == 5
    assert len({float(s.actors[0].track.xyz[0, 0]) for s in scenes}) == 5
    assert len({s.ego_log.xyz.tobytes() for s in scenes}) == 5


def measures(s):
    centre = s.lane_map.lanes["s0_f0"].centre
    left = s.lane_map.lanes["s0_f0"].left
    right = s.lane_map.lanes["s0_f0"].right
    return {
        "length": float(centre[-1, 0]),
        "width": float(left[0, 1] - right[0, 1]),
        "place": float(s.actors[0].track.xyz[0, 0]) - 20,
    }


def test_jitter_stays_inside_its_ranges(tmp_path):
    path = write(tmp_path)
    seen = [measures(load_scenario(path, seed=seed)) for seed in range(8)]
    for key, nominal, reach in (("length", 100, 5.0), ("width", 3.5, 0.07), ("place", 40, 1.5)):
        values = np.array([m[key] for m in seen])
        assert (np.abs(values - nominal) <= reach + 1e-6).all(), key
        assert np.ptp(values) > 0.3 * reach, key


def test_seed_0_is_the_file_as_written_and_others_say_what_they_changed(tmp_path):
    scene = load_scenario(write(tmp_path))
    assert measures(scene) == pytest.approx(
        {"length": 100.0, "width": 3.5, "place": 40.0}, abs=1e-9
    )
    assert scene.varied == {}
    other = load_scenario(tmp_path / "scene.yaml", seed=3)
    assert other.varied["road.lane_width_m"] == (3.5, pytest.approx(measures(other)["width"]))
    assert other.varied["actors.lead.s_m"] == (40, pytest.approx(measures(other)["place"]))
    assert "actors.parked.clearance_m" not in other.varied


def test_ranges_and_choices_are_drawn_with_the_seed(tmp_path):
    more = "variations:\n  actors.lead.s_m: {low: 50, high: 60}\n  environment.sky: {choice: [dusk, overcast]}\n"
    path = write(tmp_path, more)
    scenes = [load_scenario(path, seed=seed) for seed in range(10)]
    places = [measures(s)["place"] for s in scenes]
    assert all(50 <= p <= 60 for p in places), "a declared range is not jittered on top"
    assert len(set(places)) == 10
    assert {s.environment.sky for s in scenes} == {"dusk", "overcast"}


def test_an_override_wins_over_variation_and_jitter(tmp_path):
    path = write(tmp_path, "variations: {actors.lead.s_m: {low: 50, high: 60}}\n")
    s = load_scenario(
        path,
        seed=3,
        overrides=["actors.lead.s_m=44", "road.lane_width_m=3.25", "actors.1.clearance_m=0.9"],
    )
    assert measures(s)["place"] == pytest.approx(44.0)
    assert measures(s)["width"] == pytest.approx(3.25)
    assert s.content_hash != load_scenario(path, seed=3).content_hash


def test_words_for_people_and_places_of_files_do_not_change_the_hash(tmp_path):
    plain = load_scenario(write(tmp_path))
    assert (
        load_scenario(
            write(tmp_path, "description: Something else.\ntags: [x]\ncatches: [blind]\n")
        ).content_hash
        == plain.content_hash
    )
    assert (
        load_scenario(write(tmp_path, "environment: {sky: dusk}\n")).content_hash
        != plain.content_hash
    )
    (tmp_path / "one.ply").write_bytes(b"ply")
    (tmp_path / "two.ply").write_bytes(b"ply")
    one = load_scenario(write(tmp_path, "background: {file: one.ply}\n"))
    assert (
        load_scenario(write(tmp_path, "background: {file: two.ply}\n")).content_hash
        == one.content_hash
    )


def test_hash_depends_on_the_bytes_of_data_files(tmp_path):
    (tmp_path / "bg.ply").write_bytes(b"ply one")
    path = write(tmp_path, "background: {file: bg.ply}\n")
    first = load_scenario(path)
    assert first.background.path == str(tmp_path / "bg.ply")
    (tmp_path / "bg.ply").write_bytes(b"ply two")
    assert load_scenario(path).content_hash != first.content_hash


def test_a_variations_block_asks_for_it_at_seed_0_too(tmp_path):
    scene = load_scenario(write(tmp_path, "variations: {actors.lead.s_m: {low: 50, high: 60}}\n"))
    assert list(scene.varied) == ["actors.lead.s_m"]
    assert scene.varied["actors.lead.s_m"] == (40, pytest.approx(measures(scene)["place"]))


def test_adding_an_actor_does_not_change_the_others(tmp_path):
    one = load_scenario(write(tmp_path), seed=2)
    path = tmp_path / "scene.yaml"
    path.write_text(
        BASE.replace(
            "actors:\n", "actors:\n  - {kind: oncoming, id: new, s_m: 100, speed_mps: 8}\n"
        )
    )
    two = load_scenario(path, seed=2)
    assert (
        one.lane_map.lanes["s0_f0"].centre.tobytes() == two.lane_map.lanes["s0_f0"].centre.tobytes()
    )
    by_id = {a.actor_id: a for a in two.actors}
    assert one.actors[0].track.xyz.tobytes() == by_id["lead"].track.xyz.tobytes()


def test_a_leader_that_brakes_a_little_never_speeds_up_by_jitter(tmp_path):
    text = (
        "version: 1\nroad: {segments: [{kind: straight, length_m: 240}]}\n"
        "ego: {speed_mps: 12, cruise_mps: 12}\nactors:\n"
        "  - {kind: hard_brake, id: leader, s_m: 28, speed_mps: 12, end_speed_mps: 11.5, "
        "brake_at_us: 2500000}\ntiming: {duration_us: 2000000}\njitter: {speed: 0.2}\n"
    )
    (tmp_path / "gentle.yaml").write_text(text)
    for seed in range(1, 5):
        varied = load_scenario(tmp_path / "gentle.yaml", seed=seed).varied
        speed_mps = varied["actors.leader.speed_mps"][1]
        end_mps = varied["actors.leader.end_speed_mps"][1]
        assert end_mps / speed_mps == pytest.approx(11.5 / 12)


def refusal(path, seed):
    """Return the message of the error with which a seed is refused; empty where it is not."""
    try:
        load_scenario(path, seed=seed)
    except InputError as error:
        return error.message
    return ""


def test_jitter_out_of_the_schema_is_refused(tmp_path):
    near = BASE.replace("lane_width_m: 3.5", "lane_width_m: 2.21")
    (tmp_path / "narrow.yaml").write_text(near + "jitter: {lane_width: 0.2}\n")
    messages = [refusal(tmp_path / "narrow.yaml", seed) for seed in range(1, 9)]
    assert any("jitter makes road.lane_width_m" in message for message in messages)
