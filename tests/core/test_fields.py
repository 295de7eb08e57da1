"""Fields of a file that a reader does not know are named."""

from xml.etree import ElementTree

import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.fields import Fields, met_in

FIELDS = Fields("Map", {"map": "road", "road": "@id lane"}, {"map": "@version", "road": "userData"})


def notes_of(text):
    return FIELDS.notes_of_xml(ElementTree.fromstring(text))


def test_fields_that_are_read_or_harmless_are_not_named():
    assert notes_of('<map version="1"><road id="1"><lane/><userData a="1"/></road></map>') == ()


def test_other_fields_are_named_with_how_often_the_file_has_them():
    (note,) = notes_of('<map><road id="1" rule="x"/><road id="2" rule="y"/><bridge a="1"/></map>')
    assert note == "Map: not read are road@rule (2), map/bridge (1)"


def test_what_stands_in_a_field_that_is_not_read_is_not_named_on_its_own():
    (note,) = notes_of("<map><!-- a comment --><tunnel><road><lane/></road></tunnel></map>")
    assert note == "Map: not read are map/tunnel (1)"


def test_many_fields_are_counted_behind_the_first_ones():
    attributes = " ".join(f'a{i}="1"' for i in range(14))
    (note,) = notes_of(f'<map><road id="1" {attributes}/></map>')
    assert note.endswith(" and 2 more")


STRICT = Fields("Model", {"row": "x f_#"}, {"row": "nx"}, {"row": "motion"}, others="refused")
LENIENT = Fields("Drive", {"frame": "pose"}, {}, {"frame": "rolling_shutter"})


def test_a_number_sign_stands_for_any_number():
    STRICT.check(met_in("row", ["f_0", "f_12", "nx"]), "a.ply", "export it again")
    with pytest.raises(InputError, match="row/f_x"):
        STRICT.check(met_in("row", ["f_x"]), "a.ply", "export it again")


@pytest.mark.parametrize(
    ("fields", "refused"), [(STRICT, {"motion", "y"}), (LENIENT, {"rolling_shutter"})]
)
def test_fields_that_change_the_result_are_refused(fields, refused):
    holder = next(iter(fields.read))
    for name in ("motion", "rolling_shutter", "y"):
        if name in refused:
            with pytest.raises(InputError, match=name):
                fields.check(met_in(holder, [name]), "a", "write it without")
        elif fields.others == "named":
            fields.check(met_in(holder, [name]), "a", "write it without")
            assert name in str(fields.notes(met_in(holder, [name])))


def test_the_row_of_a_page_says_what_becomes_of_other_fields():
    assert STRICT.row() == ("Model", "`row`: f_# x", "`row`: nx", "`row`: motion; all others")
    assert LENIENT.row()[3] == "`frame`: rolling_shutter"
