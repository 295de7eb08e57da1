"""Members of an AlpaSim ``.usdz``: a plain ZIP that may come from anywhere, read in memory, member by member, within limits."""

from __future__ import annotations

import io
import zipfile
import zlib
from pathlib import Path, PurePosixPath
from types import TracebackType
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import yaml

from scenarios.reading import SourceFiles

MAX_MEMBER_BYTES = 256 << 20  # the largest tables and tracks of public scenes are a few MiB
MAX_MEMBERS = 100_000


class Archive:
    """An open archive. Nothing is extracted to the disk, and no member is ever unpickled or executed.

    Raises:
        InputError: It is no ZIP, or a member's name is unsafe or stands twice.
    """

    def __init__(self, files: SourceFiles, path: Path) -> None:
        self.files, self.path = files, path
        try:
            self._zip = zipfile.ZipFile(path)
            infos = self._zip.infolist()
        except FileNotFoundError as error:
            raise files.fail(path, "no such file", "check the path") from error
        except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
            raise files.fail(path, f"no readable ZIP: {error}", "fetch the file again; it may be truncated") from error
        if len(infos) > MAX_MEMBERS:
            raise files.fail(path, f"{len(infos)} members", f"give an archive of at most {MAX_MEMBERS}")
        self._infos: dict[str, zipfile.ZipInfo] = {}
        for info in infos:
            parts = PurePosixPath(info.filename).parts
            if info.filename.startswith("/") or "\\" in info.filename or ".." in parts or "\0" in info.filename:
                raise files.fail(path, f"a member named {info.filename!r}, outside the archive", "do not use this file")
            if info.filename in self._infos:
                raise files.fail(path, f"member {info.filename!r} twice", "write the archive again")
            self._infos[info.filename] = info

    def __enter__(self) -> Archive:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self._zip.close()

    @property
    def sizes(self) -> dict[str, int]:
        """Return every member's name and size in bytes."""
        return {name: info.file_size for name, info in self._infos.items()}

    def __contains__(self, member: str) -> bool:
        return member in self._infos

    def read(self, member: str) -> bytes:
        """Read a member; its name and bytes enter the hash of `files`.

        Raises:
            InputError: It is missing, encrypted, damaged, or larger than the limit, whatever size the archive states.
        """
        where = f"{self.path}, {member}"
        info = self._infos.get(member)
        if info is None:
            raise self.files.fail(where, "no such member", "give a complete AlpaSim scene")
        if info.file_size > MAX_MEMBER_BYTES:
            raise self.files.fail(where, f"{info.file_size} bytes", f"give a member below {MAX_MEMBER_BYTES} bytes")
        try:
            with self._zip.open(info) as stream:
                data = stream.read(MAX_MEMBER_BYTES + 1)
        except (zipfile.BadZipFile, zlib.error, OSError, EOFError, RuntimeError, NotImplementedError) as error:
            raise self.files.fail(where, f"it cannot be read: {error}", "fetch the file again; it may be damaged") from error
        if len(data) > MAX_MEMBER_BYTES:
            raise self.files.fail(where, f"more than {MAX_MEMBER_BYTES} bytes", "do not use this file")
        self.files.note_bytes(member, data)
        return data

    def json(self, member: str) -> Any:
        """Read a JSON member."""
        return self.files.parse_json(self.read(member), f"{self.path}, {member}")

    def yaml(self, member: str) -> Any:
        """Read a YAML member; only plain data is built."""
        try:
            return yaml.safe_load(self.read(member))
        except (yaml.YAMLError, UnicodeDecodeError, RecursionError, ValueError) as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise self.files.fail(f"{self.path}, {member}", f"broken YAML: {reason}", "fetch the file again") from error

    def table(self, member: str) -> list[dict[str, Any]]:
        """Read a parquet member as rows."""
        data = self.read(member)
        try:
            table = pq.read_table(io.BytesIO(data))
            table.validate(full=True)
            rows: list[dict[str, Any]] = table.to_pylist()
        except (pa.ArrowException, OSError, ValueError) as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise self.files.fail(f"{self.path}, {member}", f"no readable parquet: {reason[:120]}", "fetch the file again") from error
        return rows
