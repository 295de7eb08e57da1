"""Packed data, unpacked to a stated size at most: a few bytes can claim to be terabytes."""

from __future__ import annotations

import zlib
from pathlib import Path

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.io.limits import MEMBERS, UNPACKED_BYTES, Bound
from alpasim_plugin.io.reading.files import FETCH_AGAIN, parsing

GZIP = 16 + zlib.MAX_WBITS


def gunzip(data: bytes, most: int, where: Path | str, doing: str, do_this: str = FETCH_AGAIN) -> bytes:
    """Unpack gzip data.

    Args:
        data: One gzip member; what follows it is ignored.
        most: Bytes that the caller can use; `alpasim_plugin.io.limits.UNPACKED_BYTES` holds in any case.
        where: The file, for messages.
        doing: What the caller is doing, for messages.
        do_this: Last part of the errors.

    Raises:
        InputError: Damaged data, data that end too early, or more than ``most``.
    """
    most = min(most, int(UNPACKED_BYTES.high))
    with parsing(doing, where, do_this, "damaged gzip data"):
        unpacker = zlib.decompressobj(GZIP)
        out = unpacker.decompress(data, most + 1)
    if len(out) > most:
        raise InputError(doing, str(where), f"gzip data of more than {most} bytes", do_this)
    if not unpacker.eof:
        raise InputError(doing, str(where), f"gzip data that end after {len(out)} bytes", do_this)
    return out


def unzstd(data: bytes, expected: int, where: Path | str, doing: str, do_this: str = FETCH_AGAIN) -> bytes:
    """Unpack a zstd frame of a size that is known; see `gunzip`.

    Raises:
        InputError: Damaged data, or another size than expected.
    """
    import zstandard

    UNPACKED_BYTES.check(expected, doing, where)
    with parsing(doing, where, do_this, "damaged zstd data"):
        out = zstandard.ZstdDecompressor(max_window_size=1 << 27).stream_reader(data).read(expected + 1) if expected else b""
    if len(out) != expected:
        found = f"more than {expected} bytes" if len(out) > expected else f"{len(out)} of {expected} bytes"
        raise InputError(doing, str(where), f"zstd data of {found}", do_this)
    return out


def check_names(names: list[str], where: Path | str, doing: str, bound: Bound = MEMBERS) -> None:
    """Refuse the members of an archive if one could leave it, two share a name, or there are too many.

    Raises:
        InputError: They do.
    """
    bound.check(len(names), doing, where)
    seen: set[str] = set()
    for name in names:
        parts = name.replace("\\", "/").split("/")
        if name.startswith("/") or "\\" in name or ".." in parts or "\0" in name:
            raise InputError(doing, str(where), f"a member named {name!r}, outside the archive", "do not use this file")
        if name in seen:
            raise InputError(doing, str(where), f"member {name!r} twice", "write the archive again")
        seen.add(name)
