"""What a user sets is set, whatever form names it: over variations, jitter, and as text."""

import pytest

from alpasim_plugin.core.files.config import value_of
from scenarios.sources import open_document
from scenarios.variation import draw

SCENE = """version: 1
road: {segments: [{kind: straight, length_m: 200}]}
ego: {speed_mps: 8}
actors: [{id: lead, kind: drive, s_m: 40, speeds: [[0, 10]]}]
variations: {actors.lead.s_m: {low: 44, high: 50}, ego.speed_mps: {low: 11, high: 12}}
"""
LEAD = "{id: lead, kind: drive, s_m: 33, speeds: [[0, 10]]}"


def drawn(folder, seed, *overrides):
    (folder / "scene.yaml").write_text(SCENE)
    return draw(open_document(folder / "scene.yaml", None), seed, overrides).spec


@pytest.mark.parametrize("seed", [0, 3])
@pytest.mark.parametrize(
    "text", ["actors.lead.s_m=33", "actors.0.s_m=33", f"actors.0={LEAD}", f"actors=[{LEAD}]"]
)
def test_a_place_that_is_set_is_neither_varied_nor_jittered(tmp_path, seed, text):
    spec = drawn(tmp_path, seed, text)
    assert spec.actors[0].s_m == 33
    assert spec.ego.speed_mps > 10  # the other variation is drawn


@pytest.mark.parametrize("seed", [0, 3])
@pytest.mark.parametrize("text", ["ego.speed_mps=10", "ego={speed_mps: 10}"])
def test_a_speed_that_is_set_is_neither_varied_nor_jittered(tmp_path, seed, text):
    spec = drawn(tmp_path, seed, text)
    assert spec.ego.speed_mps == 10
    assert spec.actors[0].s_m != 40


NUMBERED = """version: 1
road: {segments: [{kind: straight, length_m: 200}]}
actors:
  - {id: lead, kind: drive, s_m: 30, speeds: [[0, 10]]}
  - {id: "0", kind: drive, s_m: 60, speeds: [[0, 10]]}
variations: {actors.0.s_m: {low: 70, high: 71}}
"""


@pytest.mark.parametrize("seed", [0, 3])
def test_an_actor_whose_id_is_a_number_is_meant_by_it_and_not_by_its_place(tmp_path, seed):
    (tmp_path / "scene.yaml").write_text(NUMBERED)
    document = open_document(tmp_path / "scene.yaml", None)
    lead, other = draw(document, seed, ["actors.lead.s_m=33"]).spec.actors
    assert lead.s_m == 33
    assert 60 < other.s_m < 90
    lead, other = draw(document, seed, ["actors.0.s_m=33"]).spec.actors
    assert lead.s_m < 33
    assert other.s_m == 33
    lead, other = draw(document, seed, ["actors.1.s_m=34"]).spec.actors
    assert other.s_m == 34


def test_an_actor_that_is_set_and_then_taken_away_is_not_there(tmp_path):
    assert drawn(tmp_path, 3, "actors.0.s_m=33", "actors=[]", "variations={}").actors == ()


def test_two_forms_of_one_key_are_taken_in_their_order(tmp_path):
    assert drawn(tmp_path, 3, "actors.lead.s_m=33", "actors.0.s_m=35").actors[0].s_m == 35


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("#text", "#text"),
        ("a #b", "a #b"),
        ("'#a'", "#a"),
        ("3", 3),
        ("", None),
        ("[1, 2]", [1, 2]),
    ],
)
def test_a_value_on_the_command_line_has_no_comments(text, value):
    assert value_of(text, "--set key") == value
