"""One way to read a file: regular files only, capped in size before a byte is read, and every
failure an error that names the file.

Anything that a parser raises becomes an `InputError` that names the file (`parsing`). Which module
reads what:

- `inputs`: nothing itself; it records what a maker reads through the others.
- `files`: bytes, text, JSON (with limits, and of a stated shape), XML, the check of a path that a
  library opens itself, and gzip, zstd and zip, decompressed to a stated size at most.
- `arrays`: NumPy files, by their header against the file's size, and headers and checkpoints of
  weights.
- `images`: images, by their header before they are decoded.
- `tables`: parquet and Arrow tables with typed columns.

Light modules only are imported here; `arrays`, `images` and `tables` are imported where they are
used.
"""

from alpasim_plugin.core.files.reading import (
    check_regular,
    content_of,
    contents,
    file_sha256,
    inside,
    natural_order,
    parse_json,
    parsing,
    read_bytes,
    read_json,
    read_json_as,
    read_json_lines,
    read_json_object,
    read_record,
    read_text,
    real,
    some_of,
)

__all__ = [
    "check_regular",
    "content_of",
    "contents",
    "file_sha256",
    "inside",
    "natural_order",
    "parse_json",
    "parsing",
    "read_bytes",
    "read_json",
    "read_json_as",
    "read_json_lines",
    "read_json_object",
    "read_record",
    "read_text",
    "real",
    "some_of",
]
