"""Pictures: PNG and JPEG, by their header before they are decoded, since a few bytes can claim
billions of pixels.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.limits import PICTURE_PIXELS, PICTURE_SIDE_PX, SOURCE_BYTES
from alpasim_plugin.core.reading.files import parsing, read_bytes

GIVE = "give a whole PNG or JPEG image"
PNG = b"\x89PNG\r\n\x1a\n"
_FRAMES = (
    0xC0,
    0xC1,
    0xC2,
    0xC3,
    0xC5,
    0xC6,
    0xC7,
    0xC9,
    0xCA,
    0xCB,
    0xCD,
    0xCE,
    0xCF,
)  # JPEG markers that carry the size
_BARE = (
    0x01,
    0xD0,
    0xD1,
    0xD2,
    0xD3,
    0xD4,
    0xD5,
    0xD6,
    0xD7,
    0xD8,
)  # JPEG markers without a length


def image_size(data: bytes) -> tuple[int, int] | None:
    """Return width and height from the header of a PNG or JPEG; None where there is none.

    Source: PNG (ISO/IEC 15948) 11.2.2; JPEG (ITU-T T.81) B.2.2.
    """
    if data.startswith(PNG):
        return (
            struct.unpack(">II", data[16:24])
            if data[12:16] == b"IHDR" and len(data) >= 24
            else None
        )
    if not data.startswith(b"\xff\xd8"):
        return None
    frame = next((at for at in _segments(data) if data[at + 1] in _FRAMES), None)
    if frame is None:
        return None
    height, width = struct.unpack(">HH", data[frame + 5 : frame + 9])
    return width, height


def picture_fault(data: bytes) -> str | None:
    """Return what makes a picture of a good header useless as a photograph: cut off before its end,
    or printed colours; None if nothing.

    Decoders fill the missing rest of a JPEG with grey, and turn CMYK into RGB by guess, without a
    word.
    """
    if data.startswith(PNG):
        return (
            None if b"IEND" in data[-16:] else "it ends before its last chunk: the file is cut off"
        )
    if b"\xff\xd9" not in data[-4096:]:  # some cameras write a few bytes after it
        return "it ends without an end marker: the file is cut off"
    at = next((i for i in _segments(data) if data[i + 1] in _FRAMES), None)
    if at is not None and data[at + 9 : at + 10] == b"\x04":
        return "four colour channels (CMYK)"
    return None


def _segments(data: bytes) -> Iterator[int]:
    """Yield where the segments of a JPEG begin, up to the one that carries its size."""
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        yield at
        if marker in _FRAMES:
            return
        at += (
            1
            if marker == 0xFF
            else 2
            if marker in _BARE
            else 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        )


def check_image(data: bytes, where: Path | str, do_this: str = GIVE) -> tuple[int, int]:
    """Return width and height of an encoded picture.

    Raises:
        InputError: No PNG or JPEG header, or a picture larger than the bounds.
    """
    size = image_size(data)
    if size is None:
        raise InputError(
            f"{where}: {len(data)} bytes beginning {data[:4]!r}, no PNG or JPEG", do_this
        )
    PICTURE_SIDE_PX.check(max(size), where)
    PICTURE_SIDE_PX.check(min(size), where)
    PICTURE_PIXELS.check(size[0] * size[1], where)
    return size


def decode_image(data: bytes, where: Path | str, do_this: str = GIVE, flag: int = 1) -> Any:
    """Decode a PNG or JPEG as OpenCV does.

    Args:
        data: The encoded picture.
        where: Its file, for messages.
        do_this: Last part of the errors.
        flag: ``cv2.IMREAD_...``; by default colour, ``(H, W, 3)`` uint8 BGR.

    Raises:
        InputError: See `check_image`; or data that do not decode.
    """
    import cv2

    check_image(data, where, do_this)
    with parsing(where, do_this, "no readable picture"):
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flag)
    if image is None:
        raise InputError(f"{where}: {len(data)} bytes that do not decode", do_this)
    return image


def read_image(path: Path | str, do_this: str = GIVE, flag: int = 1) -> Any:
    """Read and decode a picture file; see `decode_image`."""
    return decode_image(read_bytes(path, SOURCE_BYTES, do_this), path, do_this, flag)
