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
