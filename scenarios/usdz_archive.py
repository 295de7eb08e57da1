"""Members of an AlpaSim ``.usdz``: a plain ZIP that may come from anywhere, read in memory, member
by member, within limits.
"""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import pyarrow as pa

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import parse_json, parsing
from alpasim_plugin.core.files.config import parse
from alpasim_plugin.core.files.fields import field_name, met_in
from alpasim_plugin.core.files.limits import (
    ARCHIVE_BYTES,
    JSON_BYTES,
    SCENE_BYTES,
    SOURCE_BYTES,
    YAML_BYTES,
    Bound,
)
from alpasim_plugin.core.files.tables import parse_rows
from alpasim_plugin.core.files.zips import open_zip, read_member
from alpasim_plugin.core.json_types import JsonObject
from scenarios.recorded import SourceFiles

TABLE_FOLDERS = ("map_data", "clipgt", "fastmap")  # the first usable one counts


class Archive:
    """An open archive. Nothing is extracted to the disk, and no member is ever unpickled or
    executed.

    Raises:
        InputError: It is no ZIP, or refused; see `alpasim_plugin.core.files.zips`.
    """

    def __init__(self, files: SourceFiles, path: Path) -> None:
        self.files = files
        self.path = path
        self._bytes_read = 0
        with contextlib.ExitStack() as opening:
            do_this = "fetch the file again; it may be truncated"
            self._zip = opening.enter_context(open_zip(path, ARCHIVE_BYTES, do_this))
            self._open = opening.pop_all()
        self._infos = {info.filename: info for info in self._zip.infolist()}

    def __enter__(self) -> Archive:
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    @property
    def sizes(self) -> dict[str, int]:
        """Return every member's name and size in bytes."""
        return {name: info.file_size for name, info in self._infos.items()}

    def __contains__(self, member: str) -> bool:
        return member in self._infos

    def read(self, member: str, bound: Bound = SOURCE_BYTES) -> bytes:
        """Read a member; its name and bytes enter the hash of `files`.

        Args:
            member: Its name.
            bound: How many bytes it may have.

        Raises:
            InputError: It is missing, damaged, or larger than its bound, or all that was read is
                larger than the archive's; see `read_member`.
        """
        info = self._infos.get(member)
        if info is None:
            location = f"{self.path}, {member}"
            raise InputError(f"{location}: no such member", "give a complete AlpaSim scene")
        do_this = "fetch the file again; it may be damaged"
        data = read_member(self._zip, info, bound, self.path, do_this)
        self._bytes_read += len(data)
        SCENE_BYTES.check(self._bytes_read, self.path)
        self.files.note_bytes(member, data)
        return data

    @property
    def parts(self) -> list[str]:
        """Return the names of members at the top, of folders, and of tables in the folders of
        tables, each one once.
        """
        names: dict[str, None] = {}
        for member in self._infos:
            first, _, below = member.partition("/")
            is_table = first in TABLE_FOLDERS and below.endswith(".parquet")
            names[field_name("tables", Path(below).stem) if is_table else first] = None
        return list(names)

    def json(self, member: str) -> Any:
        """Read a JSON member."""
        return parse_json(self.read(member, JSON_BYTES), f"{self.path}, {member}")

    def yaml(self, member: str) -> Any:
        """Read a YAML member; only plain data is built, within the bounds of a configuration
        file.
        """
        location = f"{self.path}, {member}"
        data = self.read(member, YAML_BYTES)
        with parsing(location, "fetch the file again", "broken YAML"):
            return parse(data.decode("utf-8"), location).data

    def table(self, member: str) -> list[JsonObject]:
        """Read a parquet member as rows."""
        location = f"{self.path}, {member}"
        name = Path(member).stem
        with parsing(location, "fetch the file again", "no readable parquet"):
            schema, rows = parse_rows(self.read(member), location)
            for column in schema:
                holder = column.name if column.name in ("key", name) else ""
                if holder and pa.types.is_struct(column.type):
                    self.files.met += met_in(holder, (part.name for part in column.type))
                else:
                    self.files.met.append(field_name(name, column.name))
            return rows
