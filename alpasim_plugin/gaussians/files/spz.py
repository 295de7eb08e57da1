"""Read SPZ, the quantised and compressed Gaussian container: versions 2 and 3 (gzip) and 4 (zstd streams).

Coordinates in the file are right-up-back (y up), those of a 3DGS PLY right-down-front. The reader turns the model into PLY axes by
default, so that one model in both files lies in one place.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.gaussians.arrays import GaussianArrays
from alpasim_plugin.io.limits import GAUSSIANS
from alpasim_plugin.io.reading import read_bytes
from alpasim_plugin.io.reading.packed import unzstd

MAGIC = 0x5053474E  # "NGSP" in file order
_GZIP = b"\x1f\x8b"
DOING = "reading an SPZ file"
_COLOUR_SCALE = 0.15
_EXPORT_AGAIN = "copy or export the file again"
Axes = Literal["rdf", "rub"]

# Sign of each basis function (degree 0 to 4, order of the 3DGS PLY) when y and z change sign: the parity of its y z factor.
_FLIP_YZ = np.array([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1, -1, 1, -1, 1, 1, -1, 1, -1, 1], dtype=np.float32)


@dataclass(frozen=True)
class SpzHeader:
    """Hold the fields of an SPZ header."""

    version: int
    count: int
    sh_degree: int
    fractional_bits: int
    flags: int

    @property
    def stream_bytes(self) -> tuple[int, int, int, int, int, int]:
        """Sizes of positions, alphas, colours, scales, rotations and harmonics once unpacked."""
        n, rotation = self.count, 3 if self.version < 3 else 4
        return 9 * n, n, 3 * n, 3 * n, rotation * n, 3 * n * ((self.sh_degree + 1) ** 2 - 1)


def read_spz(path: Path | str, axes: Axes = "rdf") -> GaussianArrays:
    """Read an SPZ file of version 2, 3 or 4.

    Args:
        path: The file.
        axes: ``rdf`` turns the model into the axes of a 3DGS PLY, ``(x, y, z) -> (x, -y, -z)``; ``rub`` leaves it as stored.

    Raises:
        InputError: Missing or truncated file, wrong magic, unknown version, or sizes that do not fit the count.
    """
    path = Path(path)
    data = read_bytes(path, DOING)
    if data[:2] == _GZIP:
        data = _gunzip(path, data)
    header = _parse_header(path, data)
    streams = _zstd_streams(path, data, header) if header.version == 4 else _plain_streams(path, data, header)
    return _decode(header, streams, axes)


def unpack_smallest_three(packed: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return unit quaternions ``(N, 4)`` wxyz from the 4 bytes of versions 3 and 4.

    Little-endian word: top two bits name the largest of x, y, z, w, which is left out; the others follow from the highest bits
    down in order, each a sign bit and nine bits of magnitude over ``1 / sqrt(2)``.
    """
    words = np.ascontiguousarray(packed).view("<u4").reshape(-1)
    largest = (words >> 30).astype(np.intp)
    fields = np.stack([(words >> shift) & 1023 for shift in (20, 10, 0)], axis=1)
    magnitude = (fields & 511) / 511.0 * np.sqrt(0.5)
    others = np.where(fields & 512, -magnitude, magnitude)
    xyzw = np.empty((len(words), 4))
    slots = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    np.put_along_axis(xyzw, slots, others, axis=1)
    left_out = np.sqrt(np.maximum(1.0 - np.sum(others**2, axis=1), 0.0))
    np.put_along_axis(xyzw, largest[:, None], left_out[:, None], axis=1)
    return xyzw[:, [3, 0, 1, 2]]


def _decode(header: SpzHeader, streams: list[NDArray[np.uint8]], axes: Axes) -> GaussianArrays:
    n, k = header.count, (header.sh_degree + 1) ** 2
    positions, alphas, colours, scales, rotations, harmonics = streams
    parts = positions.reshape(n, 3, 3).astype(np.int32)
    fixed = parts[..., 0] | parts[..., 1] << 8 | parts[..., 2] << 16
    fixed = np.where(fixed & 0x800000, fixed - 0x1000000, fixed)
    means = fixed.astype(np.float64) / (1 << header.fractional_bits)
    quats = unpack_smallest_three(rotations) if header.version >= 3 else _unpack_xyz(rotations.reshape(n, 3))
    dc = (colours.reshape(n, 1, 3) / 255.0 - 0.5) / _COLOUR_SCALE
    rest = (harmonics.reshape(n, k - 1, 3).astype(np.float64) - 128.0) / 128.0
    sh = np.concatenate([dc, rest], axis=1).astype(np.float32)
    if axes == "rdf":
        means = means * np.array([1.0, -1.0, -1.0])
        quats = quats * np.array([1.0, 1.0, -1.0, -1.0])  # conjugation by half a turn about x
        sh = sh * _FLIP_YZ[:k, None]
    return GaussianArrays(
        means=means.astype(np.float32),
        quats=quats.astype(np.float32),
        scales=np.exp(scales.reshape(n, 3) / 16.0 - 10.0),
        opacities=alphas / 255.0,
        sh=sh,
    )


def _unpack_xyz(packed: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return quaternions ``(N, 4)`` wxyz from the three bytes of version 2; w is what is left to length 1."""
    xyz = packed / 127.5 - 1.0
    w = np.sqrt(np.maximum(1.0 - np.sum(xyz**2, axis=1, keepdims=True), 0.0))
    return np.concatenate([w, xyz], axis=1)


def _gunzip(path: Path, data: bytes) -> bytes:
    """Unpack versions 2 and 3: the header first, so that the rest is bounded by what it announces."""
    stream = zlib.decompressobj(wbits=31)
    try:
        head = stream.decompress(data, 16)
        header = _parse_header(path, head)
        body = stream.decompress(stream.unconsumed_tail, sum(header.stream_bytes) + 1)
    except zlib.error as error:
        raise _failure(path, f"damaged gzip data ({error})", _EXPORT_AGAIN) from error
    return head + body


def _parse_header(path: Path, data: bytes) -> SpzHeader:
    if len(data) < 16:
        raise _failure(path, f"{len(data)} bytes, shorter than any header", _EXPORT_AGAIN)
    magic, version, count, degree, bits, flags, _ = struct.unpack_from("<IIIBBBB", data)
    if magic != MAGIC:
        raise _failure(path, f"magic {data[:4]!r}, expected b'NGSP'", "give an SPZ file")
    if version not in (2, 3, 4):
        raise _failure(path, f"version {version}; versions 2, 3 and 4 are known", "export the file as version 3 or 4")
    GAUSSIANS.check(count, DOING, path)
    if degree > 4 or bits > 24:
        raise _failure(path, f"{count} Gaussians of degree {degree} with {bits} fractional bits", _EXPORT_AGAIN)
    return SpzHeader(version, count, degree, bits, flags)


def _plain_streams(path: Path, data: bytes, header: SpzHeader) -> list[NDArray[np.uint8]]:
    """Cut the unpacked body of versions 2 and 3."""
    body = np.frombuffer(data, dtype=np.uint8, offset=16)
    need = sum(header.stream_bytes)
    if len(body) < need:
        raise _failure(path, f"{len(body)} bytes of data, {header.count} Gaussians need {need}", _EXPORT_AGAIN)
    ends = np.cumsum(header.stream_bytes)
    return [body[end - size : end] for size, end in zip(header.stream_bytes, ends, strict=True)]


def _zstd_streams(path: Path, data: bytes, header: SpzHeader) -> list[NDArray[np.uint8]]:
    """Unpack version 4: a table of (compressed, unpacked) sizes, then one zstd frame a stream."""
    if len(data) < 32:
        raise _failure(path, f"{len(data)} bytes, shorter than the header of version 4", _EXPORT_AGAIN)
    n_streams, table = data[15], struct.unpack_from("<I", data, 16)[0]
    expected = [size for size in header.stream_bytes if size] if header.count else []
    wanted = [size for size in header.stream_bytes[:5]] + ([header.stream_bytes[5]] if header.sh_degree else [])
    if n_streams < len(wanted) or table < 32 or table + 16 * n_streams > len(data):
        found = f"{n_streams} streams with a table at byte {table} in {len(data)} bytes, {len(expected)} are needed"
        raise _failure(path, found, _EXPORT_AGAIN)
    sizes = [struct.unpack_from("<QQ", data, table + 16 * i) for i in range(n_streams)]
    at, streams = table + 16 * n_streams, []
    for i, need in enumerate(wanted):
        packed, unpacked = sizes[i]
        if unpacked != need or at + packed > len(data):
            found = (
                f"stream {i} announces {unpacked} bytes, {header.count} Gaussians need {need}"
                if unpacked != need
                else f"stream {i} ends at byte {at + packed}, the file at {len(data)}"
            )
            raise _failure(path, found, _EXPORT_AGAIN)
        streams.append(_unzstd(path, i, data[at : at + packed], need))
        at += packed
    return streams if header.sh_degree else [*streams, np.zeros(0, dtype=np.uint8)]


def _unzstd(path: Path, index: int, packed: bytes, need: int) -> NDArray[np.uint8]:
    return np.frombuffer(unzstd(packed, need, f"{path}, stream {index}", DOING, _EXPORT_AGAIN), dtype=np.uint8)


def _failure(path: Path, found: str, do_this: str) -> InputError:
    return InputError(DOING, str(path), found, do_this)
