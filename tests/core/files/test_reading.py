"""Rule 2: one way to read a file. Nothing that a file holds makes a reader hang, swell or show its
internals.
"""

import os
import socket
import struct
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typing_extensions import TypedDict

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.escape import MAX_PART
from alpasim_plugin.core.files import (
    read_bytes,
    read_json_as,
    read_text,
    tables,
)
from alpasim_plugin.core.files.arrays import open_npy, parse_npy
from alpasim_plugin.core.files.images import decode_image, image_size
from alpasim_plugin.core.files.limits import FILE_BYTES
from alpasim_plugin.core.files.reading import check_names, parse_xml, unzstd
from alpasim_plugin.core.files.tables import read_parquet
from tests.core.files.past_failures import png_header


def refused(call):
    with pytest.raises(InputError) as error:
        call()
    assert all(len(part) <= MAX_PART for part in error.value.as_dict().values())
    return error.value.message


def special(kind, path):
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "socket":
        socket.socket(socket.AF_UNIX).bind(str(path))
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to("/dev/zero")


@pytest.mark.parametrize("kind", ["pipe", "socket", "folder", "device"])
def test_only_regular_files_are_read(tmp_path, kind, monkeypatch):
    monkeypatch.chdir(tmp_path)  # names of sockets are short
    special(kind, Path("x"))
    refused(lambda: read_bytes("x"))


def test_size_is_checked_before_reading(tmp_path):
    with (tmp_path / "large").open("wb") as file:
        file.truncate(1 << 40)
    assert "1099511627776 bytes" in refused(lambda: read_bytes(tmp_path / "large"))
    (tmp_path / "small").write_bytes(b"12345")
    assert read_bytes(tmp_path / "small", replace(FILE_BYTES, high=5)) == b"12345"
    assert "5 bytes, more than 4" in refused(
        lambda: read_bytes(tmp_path / "small", replace(FILE_BYTES, high=4))
    )


@pytest.mark.parametrize("name", ["a" * 5000, "a\0b", "none"])
def test_names_that_no_file_has(name):

    refused(lambda: read_text(name))


class Shape(TypedDict, total=False):
    count: int
    names: dict[str, list[float]]


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("{", "broken JSON"),
        ("[" * 100_000, "broken JSON"),
        ("[" * 100 + "]" * 100, "the document"),
        ("1" * 5000, "broken JSON"),
        ('{"count": NaN}', "broken JSON"),
        ('{"count": 1e999}', "broken JSON"),
        ("[1]", "the document: a list of 1"),
        ('{"count": "1"}', "count: the text"),
        ('{"count": 1.5}', "count: the value 1.5"),
        ('{"names": {"a": [1, [2]]}}', "names.a.1: a list of 1"),
        ("\ud800", "broken JSON"),
        ('["\\ud800"]', "broken JSON"),
        ('{"a\\udc00": 1}', "broken JSON"),
    ],
)
def test_json_has_limits_and_a_shape(tmp_path, text, found):
    (tmp_path / "a.json").write_bytes(text.encode("utf-8", "surrogatepass"))
    assert found in refused(lambda: read_json_as(Shape, tmp_path / "a.json"))


def npy(shape, body=b"", descr="'<f8'"):
    head = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head.encode() + body


@pytest.mark.parametrize(
    "data",
    [
        npy("(999999999999,)"),
        npy("(2, 2)", b"\0" * 31),
        npy("(-1,)", b"\0" * 8),
        npy("(1,)", b"0" * 8, "'|O'"),
        b"",
    ],
)
def test_arrays_are_as_long_as_their_header_says(tmp_path, data):
    assert "NumPy" in refused(lambda: parse_npy(data, "a.npy"))
    (tmp_path / "a.npy").write_bytes(data)
    refused(lambda: open_npy(tmp_path / "a.npy"))


def test_pictures_are_measured_before_they_are_decoded():
    assert image_size(png_header(30_000, 20_000)) == (30_000, 20_000)
    assert "30,000 px" in refused(lambda: decode_image(png_header(30_000, 30_000), "a.png"))
    assert "pixels" in refused(lambda: decode_image(png_header(16_000, 16_000), "a.png"))
    assert decode_image(png_header(7, 5), "a.png").shape == (5, 7, 3)
    refused(lambda: decode_image(b"GIF89a", "a.gif"))


def test_packed_data_are_unpacked_to_the_size_that_is_needed():
    refused(lambda: unzstd(b"\x28\xb5\x2f\xfd\0\0", 5, "a.zst"))


@pytest.mark.parametrize("names", [["../a"], ["/a"], ["a\\b"], ["a", "a"], ["a\0"]])
def test_members_stay_in_their_archive(names):
    refused(lambda: check_names(names, "a.zip"))


def test_tables_have_their_columns_and_types(tmp_path):
    pq.write_table(
        pa.table({"a": [1, 2], "b": ["x", None], "c": [[1], [2]]}), tmp_path / "t.parquet"
    )
    assert read_parquet(tmp_path / "t.parquet", {"a": "integer", "b": "text"}).num_rows == 2
    assert "'d'" in refused(lambda: read_parquet(tmp_path / "t.parquet", {"d": "number"}))
    assert "wanted number" in refused(lambda: read_parquet(tmp_path / "t.parquet", {"c": "number"}))
    (tmp_path / "t.parquet").write_bytes((tmp_path / "t.parquet").read_bytes()[:-20])
    refused(lambda: read_parquet(tmp_path / "t.parquet", {}))


def test_runs_of_equal_values_count_as_what_they_become(tmp_path, monkeypatch):
    pq.write_table(pa.table({"a": pa.nulls(1_000_000, pa.int64())}), tmp_path / "t.parquet")
    assert (tmp_path / "t.parquet").stat().st_size < 10_000
    monkeypatch.setattr(tables, "TABLE_BYTES", replace(tables.TABLE_BYTES, high=7_999_999))
    assert "unpacked size" in refused(lambda: read_parquet(tmp_path / "t.parquet", {}))


@pytest.mark.parametrize("kind", [pa.string(), pa.large_string(), pa.binary()])
def test_a_text_that_many_rows_repeat_counts_for_each_of_them(tmp_path, monkeypatch, kind):
    path = tmp_path / "t.parquet"
    table = pa.table({"a": pa.array(["x" * 10_000] * 1000 + [None, ""]).cast(kind)})
    pq.write_table(table, path)
    assert path.stat().st_size < 30_000
    assert read_parquet(path, {}).equals(table)
    monkeypatch.setattr(tables, "TABLE_TEXT_BYTES", replace(tables.TABLE_TEXT_BYTES, high=9e6))
    assert "text of a table" in refused(lambda: read_parquet(path, {}))


@pytest.mark.parametrize(
    ("column", "bound", "name"),
    [
        (pa.array([["x" * 10_000]] * 1000), "TABLE_TEXT_BYTES", "text of a table"),
        (pa.array([b"x" * 10_000] * 1000, pa.binary(10_000)), "TABLE_BYTES", "unpacked size"),
    ],
    ids=["texts of lists", "bytes of one length"],
)
def test_values_of_any_length_count_for_each_row(tmp_path, monkeypatch, column, bound, name):
    pq.write_table(pa.table({"a": column}), tmp_path / "t.parquet")
    monkeypatch.setattr(tables, bound, replace(getattr(tables, bound), high=9e6))
    assert name in refused(lambda: read_parquet(tmp_path / "t.parquet", {}))


@pytest.mark.parametrize(
    "text",
    [
        "<a>" * 100 + "</a>" * 100,
        "<!DOCTYPE a [<!ENTITY b 'c'>]><a>&b;</a>",
        "<a",
        '<?xml version="1.0" encoding="x"?><a/>',
    ],
)
def test_xml_has_limits_and_no_entities(text):
    refused(lambda: parse_xml(text.encode(), "a.xml"))
