"""Read the quantised forms of a Gaussian model: SuperSplat's compressed PLY, ``.splat`` and SPZ.

A compressed PLY holds 16 bytes a Gaussian, quantised within chunks of 256. ``.splat`` holds 32
bytes a Gaussian without a header, constant colour only. SPZ (versions 2 and 3 by gzip, 4 by zstd
streams) has coordinates right-up-back (y up), or those that an extension of it states, where those
of a 3DGS PLY are right-down-front; its reader turns the model into PLY axes, so that one model in
both files lies in one place.
"""

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import read_bytes
from alpasim_plugin.core.files.fields import Fields, field_name
from alpasim_plugin.core.files.limits import GAUSSIANS
from alpasim_plugin.core.files.reading import parsing, unzstd
from alpasim_plugin.core.geometry import quat_from_matrix
from alpasim_plugin.core.types import F64, I64, U8
from alpasim_plugin.gaussians.cloud import GaussianArrays, quat_multiply
from alpasim_plugin.gaussians.constants import EPS2D_PX2
from alpasim_plugin.gaussians.files.ply import (
    PlyHeader,
    antialias_in,
    read_ply_element,
    read_ply_header,
    stated_in,
)
from alpasim_plugin.gaussians.sh import C0, SH_SIZES, rotate_sh

CHUNK = 256
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_BOUNDS = ("x", "y", "z", "scale_x", "scale_y", "scale_z")
_MAX_LOG_SCALE = 20.0
COMPRESSED = Fields(
    "compressed PLY",
    read={
        "file": "chunk vertex sh",
        "chunk": " ".join(f"{end}_{name}" for end in ("min", "max") for name in (*_BOUNDS, *"rgb")),
        "vertex": " ".join(_PACKED),
        "sh": "f_rest_#",
    },
    harmless={},
    others="refused",
)
SPZ = Fields(
    "SPZ",
    read={
        "header": "magic version count sh_degree fractional_bits flags streams table",
        "flags": "antialiased extended",
        "extensions": "coordinate_system",
    },
    harmless={"extensions": "safe_orbit_camera"},
    others="refused",
)


def is_compressed_ply(header: PlyHeader) -> bool:
    """Return whether a PLY header announces the packed layout."""
    return any("packed_position" in element.properties for element in header.elements)


def read_compressed_ply(path: Path | str) -> GaussianArrays:
    """Read a compressed PLY file.

    Returns:
        The Gaussians in the axes of the file, ``N`` rows in file order (Morton order, as the writer
        sorts them).

    Raises:
        InputError: Truncated file, missing properties, or fewer chunks than the Gaussians need.
    """
    header = read_ply_header(path)
    chunk_rows = read_ply_element(header, "chunk")
    rows = read_ply_element(header, "vertex")
    _check(header, chunk_rows, rows)
    chunk = np.arange(len(rows)) // CHUNK
    bounds = {name: chunk_rows[name].astype(np.float64) for name in chunk_rows.dtype.names or ()}

    def spread(fractions: F64, names: tuple[str, ...]) -> F64:
        low = np.stack([bounds[f"min_{name}"] for name in names], axis=1)[chunk]
        high = np.stack([bounds[f"max_{name}"] for name in names], axis=1)[chunk]
        return low * (1 - fractions) + high * fractions

    means = spread(_unpack_11_10_11(rows["packed_position"]), ("x", "y", "z"))
    log_scales = spread(_unpack_11_10_11(rows["packed_scale"]), ("scale_x", "scale_y", "scale_z"))
    colours = rows["packed_color"]
    rgba = np.stack([(colours >> shift) & 255 for shift in (24, 16, 8, 0)], axis=1) / 255.0
    # Files from before the colour bounds were introduced store colours over 0..1.
    rgb = spread(rgba[:, :3], ("r", "g", "b")) if "min_r" in bounds else rgba[:, :3]
    dc = (rgb - 0.5) / C0
    return GaussianArrays(
        means=means.astype(np.float32),
        quats=unpack_rotation(rows["packed_rotation"]).astype(np.float32),
        scales=np.exp(np.clip(log_scales, -_MAX_LOG_SCALE, _MAX_LOG_SCALE)),
        opacities=rgba[:, 3],
        sh=np.concatenate([dc[:, None, :], _read_sh(header, len(rows))], axis=1).astype(np.float32),
        notes=stated_in(header),
        antialias_px2=antialias_in(header),
    )


def unpack_rotation(packed: NDArray[np.uint32]) -> F64:
    """Return unit quaternions ``(N, 4)`` wxyz from 2 + 3 x 10 bits.

    The top two bits say which of w, x, y, z is the largest and left out; the others follow in order
    as ``0.5 + q / sqrt(2)``.
    """
    fractions = np.stack([(packed >> shift) & 1023 for shift in (20, 10, 0)], axis=1) / 1023.0
    others = (fractions - 0.5) * np.sqrt(2.0)
    return with_largest(others, (packed >> 30).astype(np.int64))


def with_largest(others: F64, largest: I64) -> F64:
    """Return unit quaternions ``(N, 4)`` of three components each ``(N, 3)``, in order, and the
    place ``(N,)`` of the largest one, which was left out.
    """
    quats = np.empty((len(others), 4))
    slots = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    np.put_along_axis(quats, slots, others, axis=1)
    # Rounding can bring the three slightly above length 1.
    left_out = np.sqrt(np.maximum(1.0 - np.sum(others**2, axis=1), 0.0))
    np.put_along_axis(quats, largest[:, None], left_out[:, None], axis=1)
    return quats


def _unpack_11_10_11(packed: NDArray[np.uint32]) -> F64:
    """Return fractions ``(N, 3)`` in 0..1."""
    return np.stack(
        [(packed >> 21) / 2047.0, ((packed >> 11) & 1023) / 1023.0, (packed & 2047) / 2047.0],
        axis=1,
    )


def _read_sh(header: PlyHeader, n: int) -> F64:
    """Return the higher bands ``(N, K - 1, 3)``: bytes at the centres of 256 bins over -4..4,
    channel-major as in a plain PLY.
    """
    if all(element.name != "sh" for element in header.elements):
        return np.zeros((n, 0, 3))
    rows = read_ply_element(header, "sh")
    n_rest = len(rows.dtype.names or ())
    if n_rest not in (0, 9, 24, 45, 72) or len(rows) != n:
        raise InputError(
            f"{header.path}, element 'sh': {len(rows)} rows of {n_rest} values for {n} Gaussians",
            "export the file again",
        )
    if n_rest == 0:  # gsplat writes the element of a model without harmonics too
        return np.zeros((n, 0, 3))
    table = np.stack([rows[f"f_rest_{i}"] for i in range(n_rest)], axis=1).astype(np.float64)
    # The two end bytes stand for the ends of the range, so that clipped values keep their size.
    fractions = np.where(table == 0, 0.0, np.where(table == 255, 1.0, (table + 0.5) / 256.0))
    return np.swapaxes(((fractions - 0.5) * 8.0).reshape(n, 3, n_rest // 3), 1, 2)


def _check(header: PlyHeader, chunks: NDArray[np.void], rows: NDArray[np.void]) -> None:
    missing = [name for name in _PACKED if name not in (rows.dtype.names or ())]
    bounds = [f"{end}_{name}" for end in ("min", "max") for name in _BOUNDS]
    missing += [name for name in bounds if name not in (chunks.dtype.names or ())]
    met = [field_name("file", element.name) for element in header.elements]
    for element in header.elements:
        met += [field_name(element.name, name) for name in element.properties]
    COMPRESSED.check(met, header.path, "export a plain compressed PLY (SuperSplat, gsplat)")
    need = -(-len(rows) // CHUNK)
    if missing or len(chunks) < need:
        problem = (
            f"missing properties {missing}"
            if missing
            else f"{len(chunks)} chunks where {need} are needed"
        )
        raise InputError(f"{header.path}: {problem}", "export the file again")


_ROW = np.dtype(
    [("position", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)],
)


def read_splat(path: Path | str) -> GaussianArrays:
    """Read a ``.splat`` file.

    Raises:
        InputError: Missing or empty file, or a size that is not a multiple of 32 bytes.
    """
    path = Path(path)
    data = read_bytes(path)
    if not data or len(data) % _ROW.itemsize:
        raise InputError(
            f"{path}: {len(data)} bytes, not a whole number of {_ROW.itemsize}-byte rows",
            "copy or export the file again; it has no header, so a cut file shows only in its size",
        )
    GAUSSIANS.check(len(data) // _ROW.itemsize, path)
    rows = np.frombuffer(data, dtype=_ROW)
    rgba = rows["rgba"].astype(np.float64) / 255.0
    return GaussianArrays(
        means=rows["position"].copy(),
        quats=(rows["rotation"].astype(np.float32) - 128.0) / 128.0,
        scales=rows["scale"].copy(),
        opacities=rgba[:, 3],
        sh=((rgba[:, None, :3] - 0.5) / C0).astype(np.float32),
    )


MAGIC = 0x5053474E  # "NGSP" in file order
_GZIP = b"\x1f\x8b"
_COLOUR_SCALE = 0.15
_EXPORT_AGAIN = "copy or export the file again"

# Flags of a header
ANTIALIASED = 1
EXTENDED = 2
FLAGS = {ANTIALIASED: "antialiased", EXTENDED: "extended"}
AXES = 0xADBE0003  # the extension that states where axes point
EXTENSIONS = {0xADBE0002: "safe_orbit_camera", AXES: "coordinate_system"}
MOST_EXTENDED = 1 << 16  # bytes of extensions
# Axes by the number in the extension: where x, y and z point.
SYSTEMS = (
    "RUB LDB RDB LUB RUB LDF RDF LUF RUF LFD RFD LFU RFU LBD RBD LBU RBU".split()  # noqa: SIM905
)
# What the format's own library, and splat-transform after it, write and read under these numbers is
# turned by 180 degrees about x from what their letters say: no file tells which one is meant.
CONTRADICTORY = ("LFD", "RFD", "LBU", "RBU")
# Right, down and front are the axes of a PLY.
DIRECTIONS = {
    "R": (1, 0, 0),
    "L": (-1, 0, 0),
    "D": (0, 1, 0),
    "U": (0, -1, 0),
    "F": (0, 0, 1),
    "B": (0, 0, -1),
}


@dataclass(frozen=True)
class SpzHeader:
    """Hold the fields of an SPZ header that are read."""

    version: int
    count: int
    sh_degree: int
    fractional_bits: int
    flags: int = 0

    @property
    def stream_bytes(self) -> tuple[int, int, int, int, int, int]:
        """Sizes of positions, alphas, colours, scales, rotations and harmonics once unpacked."""
        n = self.count
        rotation = 3 if self.version < 3 else 4
        return 9 * n, n, 3 * n, 3 * n, rotation * n, 3 * n * ((self.sh_degree + 1) ** 2 - 1)


def read_spz(path: Path | str) -> GaussianArrays:
    """Read an SPZ file of version 2, 3 or 4, turned into the axes of a 3DGS PLY: ``(x, y, z) ->
    (x, -y, -z)``, unless an extension states other axes.

    Args:
        path: The file.

    Raises:
        InputError: Missing or truncated file, wrong magic, unknown version, or sizes that do not
            fit the count.
    """
    path = Path(path)
    data = read_bytes(path)
    if data[:2] == _GZIP:
        # The header first, so that the rest is bounded by what it announces.
        stream = zlib.decompressobj(wbits=31)
        head = stream.decompress(data, 16)
        size = sum(_parse_header(path, head).stream_bytes) + MOST_EXTENDED
        data = head + stream.decompress(stream.unconsumed_tail, size)
    header = _parse_header(path, data)
    if header.version == 4:
        table = struct.unpack_from("<I", data, 16)[0]
        offset = table + 16 * data[15]
        streams = []
        for i, need in enumerate(header.stream_bytes):
            if need == 0:
                streams.append(np.zeros(0, dtype=np.uint8))
                continue
            packed = struct.unpack_from("<Q", data, table + 16 * i)[0]
            plain = unzstd(
                data[offset : offset + packed], need, f"{path}, stream {i}", _EXPORT_AGAIN
            )
            streams.append(np.frombuffer(plain, dtype=np.uint8))
            offset += packed
        extensions = data[32 : struct.unpack_from("<I", data, 16)[0]]
    else:
        body = np.frombuffer(data, dtype=np.uint8, offset=16)
        ends = np.cumsum(header.stream_bytes)
        streams = [
            body[end - size : end] for size, end in zip(header.stream_bytes, ends, strict=True)
        ]
        extensions = data[16 + sum(header.stream_bytes) :]
    system = SYSTEMS[0]
    notes: tuple[str, ...] = ()
    if header.flags & EXTENDED:
        system = _stated_axes(path, extensions)
    elif len(extensions):
        notes += (f"{len(extensions)} bytes that the header does not announce are not read",)
    if system != SYSTEMS[0]:
        notes += (f"axes {system} as the file states them, turned into those of a PLY",)
    arrays = in_ply_axes(_decode(header, streams), system)
    antialias_px2 = EPS2D_PX2 if header.flags & ANTIALIASED else 0.0
    return arrays._replace(notes=notes, antialias_px2=antialias_px2)


def _stated_axes(path: Path, data: bytes) -> str:
    """Return the axes that extensions state: records of a type, a length and as many bytes."""
    offset = 0
    system = SYSTEMS[0]
    while offset < len(data):
        with parsing(path, _EXPORT_AGAIN, "damaged extensions"):
            kind, size = struct.unpack_from("<II", data, offset)
            if kind == AXES:
                system = SYSTEMS[struct.unpack_from("<I", data, offset + 8)[0]]
        if system in CONTRADICTORY:
            raise _failure(
                path,
                f"axes {system}, which the library of SPZ and the letters take for two different ones",
                "export it with axes RUB or RDF",
            )
        name = EXTENSIONS.get(kind, f"{kind:#010x}")
        SPZ.check([field_name("extensions", name)], path, "export it without this extension")
        offset += 8 + size
    return system


def in_ply_axes(arrays: GaussianArrays, system: str) -> GaussianArrays:
    """Return Gaussians in the axes of a 3DGS PLY: a left-handed system is mirrored along x, then all
    is turned.

    Args:
        arrays: Gaussians.
        system: Where their x, y and z point, such as ``RUB``: a letter of each pair of `DIRECTIONS`.
    """
    M = np.array([DIRECTIONS[letter] for letter in system], dtype=np.float64).T
    means, quats, sh = arrays.means, arrays.quats, arrays.sh
    if np.linalg.det(M) < 0:
        M = M * [-1, 1, 1]
        means = means * [-1, 1, 1]
        quats = quats * [1, 1, -1, -1]
        # The harmonic of order m holds x to the power of |m|, or one more where m is negative.
        orders = [m for degree in range(5) for m in range(-degree, degree + 1)]
        odd = np.array([(abs(m) + (m < 0)) % 2 for m in orders])[: sh.shape[1]]
        sh = sh * (1 - 2 * odd)[:, None]
    rotated_sh = rotate_sh(sh[:, : SH_SIZES[-1]].astype(np.float64), M)
    turned = quat_multiply(quat_from_matrix(M), quats.astype(np.float64))
    return arrays._replace(
        means=(means @ M.T).astype(np.float32),
        quats=turned.astype(np.float32),
        sh=np.concatenate([rotated_sh, sh[:, SH_SIZES[-1] :]], axis=1).astype(np.float32),
    )


def unpack_smallest_three(packed: U8) -> F64:
    """Return unit quaternions ``(N, 4)`` wxyz from the 4 bytes of versions 3 and 4.

    Little-endian word: top two bits name the largest of x, y, z, w, which is left out; the others
    follow from the highest bits down in order, each a sign bit and nine bits of magnitude over ``1
    / sqrt(2)``.
    """
    words = np.ascontiguousarray(packed).view("<u4").reshape(-1)
    largest = (words >> 30).astype(np.int64)
    fields = np.stack([(words >> shift) & 1023 for shift in (20, 10, 0)], axis=1)
    magnitude = (fields & 511) / 511.0 * np.sqrt(0.5)
    others = np.where(fields & 512, -magnitude, magnitude)
    return with_largest(others, largest)[:, [3, 0, 1, 2]]


def _decode(header: SpzHeader, streams: list[U8]) -> GaussianArrays:
    n = header.count
    k = (header.sh_degree + 1) ** 2
    positions, alphas, colours, scales, rotations, harmonics = streams
    parts = positions.reshape(n, 3, 3).astype(np.int32)
    fixed = parts[..., 0] | parts[..., 1] << 8 | parts[..., 2] << 16
    fixed = np.where(fixed & 0x800000, fixed - 0x1000000, fixed)
    means = fixed.astype(np.float64) / (1 << header.fractional_bits)
    if header.version >= 3:
        quats = unpack_smallest_three(rotations)
    else:  # w is what is left to length 1
        xyz = rotations.reshape(n, 3) / 127.5 - 1.0
        w = np.sqrt(np.maximum(1.0 - np.sum(xyz**2, axis=1, keepdims=True), 0.0))
        quats = np.concatenate([w, xyz], axis=1)
    dc = (colours.reshape(n, 1, 3) / 255.0 - 0.5) / _COLOUR_SCALE
    higher = (harmonics.reshape(n, k - 1, 3).astype(np.float64) - 128.0) / 128.0
    sh = np.concatenate([dc, higher], axis=1).astype(np.float32)
    return GaussianArrays(
        means=means,
        quats=quats,
        scales=np.exp(scales.reshape(n, 3) / 16.0 - 10.0),
        opacities=alphas / 255.0,
        sh=sh,
    )


def _parse_header(path: Path, data: bytes) -> SpzHeader:
    if len(data) < 16:
        raise _failure(path, f"{len(data)} bytes, shorter than any header", _EXPORT_AGAIN)
    magic, version, count, degree, bits, flags, reserved = struct.unpack_from("<IIIBBBB", data)
    if magic != MAGIC:
        raise _failure(path, f"magic {data[:4]!r}, expected b'NGSP'", "give an SPZ file")
    if version not in (2, 3, 4):
        raise _failure(
            path,
            f"version {version}; versions 2, 3 and 4 are known",
            "export the file as version 3 or 4",
        )
    GAUSSIANS.check(count, path)
    if degree > 4 or bits > 24:
        raise _failure(
            path, f"{count} Gaussians of degree {degree} with {bits} fractional bits", _EXPORT_AGAIN
        )
    flag_names = (FLAGS.get(1 << bit, f"bit_{bit}") for bit in range(8) if flags >> bit & 1)
    met = [field_name("flags", name) for name in flag_names]
    if any(data[20:32]) if version == 4 else reserved:
        met.append(field_name("header", "reserved"))
    SPZ.check(met, path, "export it without them")
    return SpzHeader(version, count, degree, bits, flags)


def _failure(path: Path, problem: str, do_this: str) -> InputError:
    return InputError(f"{path}: {problem}", do_this)
