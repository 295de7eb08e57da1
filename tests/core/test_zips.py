"""Archives that lie: nested, overlapping, leaving their folder, linking, swelling, cut and patched
ones are refused by name, or their members are read as what they are.
"""

import stat
import struct
import zipfile
from contextlib import contextmanager
from dataclasses import replace

import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import parse_json, reading, tables
from alpasim_plugin.core.files.limits import Bound
from alpasim_plugin.core.files.reading import parse_xml
from alpasim_plugin.core.files.tables import parse_rows
from alpasim_plugin.core.files.zips import open_zip, read_member
from tests.scenarios.make_usdz import parquet

LIMIT = Bound("size of a member", "bytes", 0, 1_000_000, "it is a test")
SIZES = {"packed size": 20, "size": 24, "place": 42}  # where they stand in an entry of the list


def write(path, members, method=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return path


def read(path):
    """Return all members by name."""
    with open_zip(path) as archive:
        return {
            info.filename: read_member(archive, info, LIMIT, path) for info in archive.infolist()
        }


@pytest.fixture
def small(tmp_path):
    return write(tmp_path / "small.zip", {"a.json": b"[1]" * 100, "b.json": b"[2]" * 200})


def entry_of(data, name):
    """Return where the entry of a member in the list of members begins."""
    return data.rindex(name.encode()) - 46


def patched(path, name, field, value):
    data = bytearray(path.read_bytes())
    place = entry_of(data, name) + SIZES[field]
    data[place : place + 4] = struct.pack("<I", value)
    path.write_bytes(data)
    return path


def test_members_are_read_as_they_were_written_and_an_archive_in_an_archive_is_bytes(
    tmp_path, small
):
    inner = small.read_bytes()
    outer = write(tmp_path / "outer.zip", {"inner.zip": inner, "folder/": b""})
    assert read(outer) == {"inner.zip": inner, "folder/": b""}


@pytest.mark.parametrize("field", SIZES)
@pytest.mark.parametrize("value", [0, 1, 301, 999, 0x7FFFFFFF, 0xFFFFFFFE])
def test_sizes_and_places_that_lie_are_refused(small, field, value):
    with pytest.raises(InputError, match=r"small\.zip"):
        read(patched(small, "a.json" if value else "b.json", field, value))


def test_members_that_share_bytes_are_refused(small):
    place = entry_of(small.read_bytes(), "a.json") + SIZES["place"]
    (first,) = struct.unpack_from("<I", small.read_bytes(), place)
    with pytest.raises(InputError, match=r"'a\.json' and 'b\.json' share bytes"):
        read(patched(small, "b.json", "place", first))


@pytest.mark.parametrize("name", ["../up", "/etc/x", "a/../../b", "C:\\x"])
def test_names_outside_the_archive_are_refused(tmp_path, name):
    with pytest.raises(InputError, match="outside the archive"):
        read(write(tmp_path / "a.zip", {name: b""}))


def test_a_link_is_refused(tmp_path):
    link = zipfile.ZipInfo("scene.json")
    link.create_system = 3
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    with pytest.raises(InputError, match="is a link"):
        read(write(tmp_path / "a.zip", {link: b"/etc/passwd"}))


@pytest.mark.parametrize("method", [zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2])
def test_what_cannot_be_held_to_a_size_while_it_is_unpacked_is_refused(tmp_path, method):
    with pytest.raises(InputError, match=f"packed by method {method}"):
        read(write(tmp_path / "a.zip", {"a": b"0" * 1000}, method))


def test_more_members_than_the_bound_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(reading, "MEMBERS", replace(reading.MEMBERS, high=3))
    read(write(tmp_path / "few.zip", dict.fromkeys("abc", b"")))
    with pytest.raises(InputError, match="members of an archive = 4"):
        read(write(tmp_path / "many.zip", dict.fromkeys("abcd", b"")))


def test_a_list_of_members_that_would_fill_the_memory_is_not_read(tmp_path):
    size = 1 << 30
    path = tmp_path / "sparse.zip"
    with path.open("wb") as file:
        file.seek(size)
        file.write(struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, 9, 9, size, 0, 0))
    with pytest.raises(InputError, match="list of an archive's members"):
        read(path)


def test_a_truncated_archive_is_refused_wherever_it_ends(small):
    data = small.read_bytes()
    for length in range(0, len(data), 7):
        small.write_bytes(data[:length])
        with pytest.raises(InputError):
            read(small)


def test_content_that_is_not_what_was_summed_is_refused(small):
    data = bytearray(small.read_bytes())
    data[entry_of(data, "b.json") + 16] ^= 255  # of its sum
    small.write_bytes(data)
    with pytest.raises(InputError, match=r"b\.json: it cannot be read: Bad CRC-32"):
        read(small)


def test_a_member_that_swells_is_refused(tmp_path):
    path = write(tmp_path / "a.zip", {"a": b"0" * 1_000_001})
    with pytest.raises(InputError, match="1000001 bytes"):
        read(path)


@contextmanager
def at_most(monkeypatch, name, count, module=reading):
    """Lower a bound to a count, and expect that it refuses."""
    monkeypatch.setattr(module, name, replace(getattr(module, name), high=count))
    yield
    monkeypatch.undo()


@pytest.mark.parametrize("text", ["[{},{},{}]", '[[[["a"]]],"b"]', '{"a":1,"b":2,"c":3,"d":[4]}'])
def test_documents_of_more_values_than_the_bound_are_refused_before_they_are_parsed(
    monkeypatch, text
):
    count = text.count(",") + text.count("[") + text.count("{")
    for document in (text, text.encode()):
        with at_most(monkeypatch, "PARSED_VALUES", count):
            parse_json(document, "a.json")
        refused = pytest.raises(InputError, match=f"values of a document = {count}")
        with at_most(monkeypatch, "PARSED_VALUES", count - 1), refused:
            parse_json(document, "a.json")


def test_an_xml_document_of_many_attributes_is_refused_before_it_is_parsed(monkeypatch):
    text = b"<a " + b" ".join(b'a%d="1"' % i for i in range(50)) + b"/>"
    with at_most(monkeypatch, "XML_MARKS", 51):
        assert len(parse_xml(text, "a.xml").attrib) == 50
    with at_most(monkeypatch, "XML_MARKS", 50), pytest.raises(InputError, match="attributes"):
        parse_xml(text, "a.xml")


def test_rows_of_more_values_than_the_bound_are_refused(monkeypatch):
    data = parquet([{"key": {"id": "a"}, "line": [{"x": 1.0}, {"x": 2.0}]}] * 10)
    values = 10 * 2 + 20 * 4  # a text in an object; a number in an object in a list
    with at_most(monkeypatch, "TABLE_VALUES", values, tables):
        _, rows = parse_rows(data, "a.parquet")
    assert rows[9] == {"key": {"id": "a"}, "line": [{"x": 1.0}, {"x": 2.0}]}
    refused = pytest.raises(InputError, match="values of a map table")
    with at_most(monkeypatch, "TABLE_VALUES", values - 1, tables), refused:
        parse_rows(data, "a.parquet")


def test_a_text_that_many_rows_repeat_counts_for_each_of_them(monkeypatch):
    data = parquet([{"key": {"id": "a" * 10_000}}] * 5_000)
    assert len(data) < 30_000
    with at_most(monkeypatch, "SCENE_TABLE_BYTES", 50_000_000, tables):
        _, rows = parse_rows(data, "a.parquet")
    assert rows[-1] == {"key": {"id": "a" * 10_000}}
    refused = pytest.raises(InputError, match="50,000,000 bytes")
    with at_most(monkeypatch, "SCENE_TABLE_BYTES", 49_999_999, tables), refused:
        parse_rows(data, "a.parquet")


def test_a_tag_that_is_longer_than_the_bound_is_refused_before_its_end_comes(monkeypatch):
    monkeypatch.setattr(reading, "XML_PIECE_BYTES", 100)
    text = b'<a>%s<b c="%s"/><!--%s--></a>' % (b"t" * 5_000, b"c" * 900, b"d" * 900)
    with at_most(monkeypatch, "XML_TAG_BYTES", 1_200):
        assert len(parse_xml(text, "a.xml")[0].get("c")) == 900
    monkeypatch.setattr(reading, "XML_PIECE_BYTES", 100)
    refused = pytest.raises(InputError, match="size of a tag")
    with at_most(monkeypatch, "XML_TAG_BYTES", 800), refused:
        parse_xml(text, "a.xml")
