"""What a map's country and the kinds of its roads decide: the colour of centre lines, pavements."""

import pytest

from scenarios.countries import centre_line, country_at, country_of
from scenarios.load import load_scenario
from tests.files.opendrive_text import lane, road, section

UNKNOWN = '<roadMark sOffset="0" type="custom" color="standard"/>'


def drive(folder, kind):
    """A street of two ways whose centre line the map has in a form that is not known."""
    centre = f'<center><lane id="0" type="none">{UNKNOWN}</lane></center>'
    sides = section(0, lane(1, more=""), lane(-1)).replace("<right>", f"{centre}<right>")
    text = road("1", sides, length=150).replace("<planView>", f"{kind}<planView>")
    file = folder / "map.xodr"
    file.write_text(f"<OpenDRIVE>{text}</OpenDRIVE>", encoding="utf-8")
    route = ("map.vehicles=0", "map.route.from=1:20", "map.route.to=1:120")
    return load_scenario(file, None, route)


@pytest.mark.parametrize(
    ("kind", "mark"),
    [
        ('<type s="0" type="town" country="JP"/>', "dashed_white"),
        ('<type s="0" type="town" country="US"/>', "double_yellow"),
        ('<type s="0" type="town"/>', "double_yellow"),
    ],
)
def test_an_unknown_centre_line_has_the_colour_of_the_country(tmp_path, kind, mark):
    lanes = drive(tmp_path, kind).lane_map.lanes
    assert {lanes["1.0.1"].left_mark_type, lanes["1.0.-1"].left_mark_type} == {mark}


def test_a_road_is_a_motorway_where_the_map_says_so(tmp_path):
    for kind in ("motorway", "town"):
        lanes = drive(tmp_path, f'<type s="0" type="{kind}"/>').lane_map.lanes
        assert {one.is_motorway for one in lanes.values()} == {kind == "motorway"}


@pytest.mark.parametrize(
    ("lat_deg", "lon_deg", "country"),
    [
        (35.68, 139.77, "JP"),  # Tokyo
        (43.06, 141.35, "JP"),  # Sapporo
        (26.21, 127.68, "JP"),  # Naha
        (33.59, 130.40, "JP"),  # Fukuoka
        (35.18, 129.08, None),  # Busan
        (25.03, 121.56, None),  # Taipei
        (49.01, 8.40, None),  # Karlsruhe
    ],
)
def test_places_in_japan_are_known(lat_deg, lon_deg, country):
    assert country_at(lat_deg, lon_deg) == country


def test_codes_of_both_lengths_are_read():
    assert centre_line("usa") == centre_line("US") == "double_yellow"
    assert centre_line("DEU") == centre_line("jp") == "dashed_white"


@pytest.mark.parametrize(
    ("codes", "line"),
    [
        (["DE", "DEU", ""], "dashed_white"),
        (["US", "CAN"], "double_yellow"),
        (["US", "DE"], "double_yellow"),  # no country
        (["OpenDRIVE", "UNKNOWN", "7"], "double_yellow"),
    ],
)
def test_the_country_of_a_map_is_that_of_all_its_roads(codes, line):
    assert centre_line(country_of(codes)) == line
