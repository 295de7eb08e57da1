"""ZIP archives that may come from anywhere, read member by member and never unpacked to the disk.

Before a member is read, the list of members is bounded in size and in number, and the archive is
refused where a member is a link, could leave the archive, shares its name or its bytes with another
one, or lies beyond the end of the file. Members are stored or deflated: what bzip2 and LZMA unpack
cannot be held to a size while it is unpacked.
"""

from __future__ import annotations

import io
import math
import stat
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, cast

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.limits import DIRECTORY_BYTES, FILE_BYTES, Bound
from alpasim_plugin.core.files.reading import FETCH_AGAIN, check_names, open_regular, parsing

METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
LOCAL_HEADER_BYTES = 30  # before a member's name and data
ENCRYPTED = 1  # flag of a member


class _CappedReads:
    """A stream that hands out a limited number of bytes at once: `zipfile` reads the whole list of
    members in one piece, whose size the archive states.
    """

    def __init__(self, stream: IO[bytes], location: Path | str) -> None:
        self._stream = stream
        self._location = location
        self.size = stream.seek(0, io.SEEK_END)
        self.most = DIRECTORY_BYTES.high
        self.seek = stream.seek
        self.tell = stream.tell
        self.seekable = stream.seekable

    def read(self, size: int = -1) -> bytes:
        left = self.size - self._stream.tell()
        if (left if size < 0 else min(size, left)) > self.most:
            DIRECTORY_BYTES.check(size, self._location)
        return self._stream.read(size)


@contextmanager
def open_zip(
    path: Path | str, bound: Bound = FILE_BYTES, do_this: str = FETCH_AGAIN
) -> Iterator[zipfile.ZipFile]:
    """Open an archive after the checks that the module's text lists.

    Args:
        path: File.
        bound: Its greatest size.
        do_this: Hint of the errors.

    Raises:
        InputError: It is no ZIP, or refused; see also `open_regular`.
    """
    with open_regular(path, bound, do_this) as stream:
        capped = _CappedReads(stream, path)
        with parsing(path, do_this, "no readable ZIP"):
            archive = zipfile.ZipFile(cast("IO[bytes]", capped))
        capped.most = math.inf
        with archive:
            infos = archive.infolist()
            check_names([info.filename for info in infos], path)
            _check_places(infos, capped.size, path)
            yield archive


def _check_places(infos: Sequence[zipfile.ZipInfo], size: int, location: Path | str) -> None:
    """Refuse links, members that share bytes, and members beyond the end of the file.

    Raises:
        InputError: There are some.
    """
    end = 0
    last = ""
    for info in sorted(infos, key=lambda info: info.header_offset):
        name = info.filename
        if stat.S_ISLNK(info.external_attr >> 16):
            raise InputError(f"{location}: the member {name!r} is a link", "do not use this file")
        if info.header_offset < end:
            raise InputError(
                f"{location}: the members {last!r} and {name!r} share bytes", "do not use this file"
            )
        end = info.header_offset + LOCAL_HEADER_BYTES + info.compress_size
        last = name
    if end > size:
        raise InputError(
            f"{location}: the member {last!r} ends beyond the end of the file",
            "fetch the file again; it may be truncated",
        )


def read_member(
    archive: zipfile.ZipFile,
    info: zipfile.ZipInfo,
    bound: Bound,
    location: Path | str,
    do_this: str = FETCH_AGAIN,
) -> bytes:
    """Return what a member of `open_zip`'s archive unpacks to.

    Args:
        archive: Archive.
        info: Member.
        bound: How many bytes it may have.
        location: The archive's file, for messages.
        do_this: Hint of the errors.

    Raises:
        InputError: It is encrypted, packed in another way than `METHODS`, damaged, or larger than
            the bound, whatever size the archive states.
    """
    place = f"{location}, {info.filename}"
    if info.flag_bits & ENCRYPTED:
        raise InputError(f"{place}: it is encrypted", "write the archive without a password")
    if info.compress_type not in METHODS:
        raise InputError(
            f"{place}: packed by method {info.compress_type} of ZIP",
            "store or deflate the archive's members",
        )
    most = int(bound.high)
    if info.file_size > most:
        raise InputError(f"{place}: {info.file_size} bytes", f"give a member below {most} bytes")
    with parsing(place, do_this, "it cannot be read"), archive.open(info) as stream:
        data = stream.read(most + 1)
    if len(data) != info.file_size:
        raise InputError(
            f"{place}: {len(data)} bytes where the archive states {info.file_size}", do_this
        )
    return data
