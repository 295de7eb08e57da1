"""Read and write Gaussians as PLY in the layout of the original 3DGS code, for any spherical
harmonics degree.

The container is the Stanford polygon format: an ASCII header that lists elements and their
properties, then the rows of each element in header order. Everything is found by name. Opacity is
stored as logit, scale as natural logarithm, rotation as ``wxyz`` (not normalised) and ``f_rest``
channel by channel: all red coefficients, then green, then blue.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.atomic import atomic_file, write_bytes
from alpasim_plugin.core.files.fields import Fields, field_name
from alpasim_plugin.core.files.limits import GAUSSIANS
from alpasim_plugin.core.files.reading import open_regular, parsing, read_bytes, some_of
from alpasim_plugin.core.types import F64, U8, FloatArray
from alpasim_plugin.gaussians.cloud import (
    GaussianArrays,
    GaussianCloud,
    build_cloud,
    logit,
    sigmoid,
)
from alpasim_plugin.gaussians.constants import EPS2D_PX2, MIP_PX2

_SCALES = ("scale_0", "scale_1", "scale_2")
_REQUIRED = (
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "rot_0", "rot_1", "rot_2", "rot_3"),
)
COLOURS = ("red", "green", "blue")
VERTEX = "vertex"  # holds the properties of a Gaussian, whatever the element's name
ELEMENT = "file"  # holds elements
PLY = Fields(
    "3DGS PLY",
    read={
        ELEMENT: "vertex color_space",
        VERTEX: """x y z f_dc_# f_rest_# opacity scale_# rot_# filter_3D filter_3d transform state
            motion_# omega_#""",
    },
    # Normals, colours of points, features by which Gaussians are grouped, and the training camera
    # of a model, as Apple's SHARP writes it.
    harmless={
        ELEMENT: "extrinsic intrinsic image_size frame disparity version",
        VERTEX: """nx ny nz red green blue id ins_feat_r ins_feat_g ins_feat_b ins_feat_r2 ins_feat_g2
            ins_feat_b2 obj_dc_# ins_feat_# semantic_# language_# language_feature_# semantic
            semantic_id label label_id class class_id object object_id instance instance_id segment
            segment_id""",
    },
    others="refused",
)
# Properties that change nothing where they have one value in every row: SuperSplat's number of a
# transform and its marks of hidden Gaussians, and motions.
_NEUTRAL = {"transform": 0.0, "state": 0.0, "motion": 0.0, "omega": 0.0}
PLAIN = "export a plain 3DGS model, with colours in sRGB"
_FLAT = 1e-3  # thickness of a 2D Gaussian, in its smaller scale
# Comments that state how a model is to be drawn or how its axes lie.
_STATED = re.compile(r"ax[ie]s|coordinate|handed|unit|scale|antialias|rendermode|frame", re.I)
# What Brush and Postshot write of antialiasing, and the 2D filter that they mean, pixels^2.
_ANTIALIASED = {"SplatRenderMode: mip": MIP_PX2, "antialiased 1": EPS2D_PX2}


def read_ply(path: Path | str, element: str | None = None) -> GaussianCloud:
    """Read a Gaussian PLY file; broken Gaussians are dropped (`read_gaussians` also reports how
    many).

    Args:
        path: The file.
        element: Which element to read where the file holds several models, as Street Gaussians
            writes them (``vertex_background``, ``vertex_obj_000``, ...); None takes the only one.

    Returns:
        The cloud, in the axes and units of the file.

    Raises:
        InputError: Missing or truncated file, missing properties, properties that may change what
            is drawn and are not known, or several elements and none named.

    Example:
        >>> cloud = read_ply("background.ply")  # doctest: +SKIP
    """
    return build_cloud(read_ply_arrays(path, element))[0]


def read_ply_arrays(path: Path | str, element: str | None = None) -> GaussianArrays:
    """Read a Gaussian PLY file without dropping anything; see `read_ply`."""
    header = read_ply_header(path)
    chosen = header.element(element) if element is not None else _only_gaussian_element(header)
    n_rest, unsure = _check_properties(header, chosen)
    for beside in header.elements:
        if beside.name == "color_space" and read_ply_element(header, beside.name)[0][0]:
            raise InputError(f"{header.path}, element 'color_space': linear colours", PLAIN)
        if beside.count and not beside.name.startswith("vertex"):
            PLY.check([field_name(ELEMENT, beside.name)], header.path, PLAIN)
    rows = read_ply_element(header, chosen.name)
    notes = stated_in(header)
    if unsure:
        _check_neutral(header, chosen, rows, unsure)
        notes += (f"of no effect, since it has one value in every row: {some_of(unsure)}",)
    flat = "scale_2" not in chosen.properties
    with np.errstate(over="ignore"):  # overflow becomes infinity, which cleaning drops and counts
        scales = np.exp(_columns(rows, _SCALES[: 2 if flat else 3]).astype(np.float64))
    if flat:
        thickness = _FLAT * scales.min(axis=1, keepdims=True)
        scales = np.concatenate([scales, thickness], axis=1)
        notes += ("2D Gaussians are drawn as flat ellipsoids",)
    opacities = sigmoid(_columns(rows, ["opacity"])[:, 0])
    antialias_px2 = antialias_in(header)
    filtered = [name for name in chosen.properties if name.lower() == "filter_3d"]
    if filtered:
        scales, opacities = smoothed(scales, opacities, _columns(rows, filtered))
        notes += ("the 3D filter of Mip-Splatting is applied to scales and opacities",)
        antialias_px2 = MIP_PX2
    return GaussianArrays(
        means=_columns(rows, ("x", "y", "z")),
        quats=_columns(rows, [f"rot_{i}" for i in range(4)]),
        scales=scales,
        opacities=opacities,
        sh=_sh_from_columns(rows, n_rest),
        notes=notes,
        antialias_px2=0.0 if flat else antialias_px2,
    )


def smoothed(scales: F64, opacities: F64, width: FloatArray) -> tuple[F64, F64]:
    """Return scales ``(N, 3)`` and opacities ``(N,)`` under the 3D smoothing filter of widths ``(N,
    1)``, metres.

    Source: Mip-Splatting (Yu et al. 2024), equation 9.
    """
    square = scales**2
    wider = square + width.astype(np.float64) ** 2
    with np.errstate(invalid="ignore"):
        return np.sqrt(wider), opacities * np.sqrt((square / wider).prod(axis=1))


def stated_in(header: PlyHeader) -> tuple[str, ...]:
    """Return notes on the comments of a file that state how it is to be drawn."""
    return tuple(f"the file says {text!r}" for text in header.comments if _STATED.search(text))


def antialias_in(header: PlyHeader) -> float:
    """Return the 2D filter that comments of Brush or of Postshot state, pixels^2; the last one
    counts, and 0 is none.
    """
    filters = {text.lower(): px2 for text, px2 in _ANTIALIASED.items()}
    stated = 0.0
    for comment in header.comments:
        text = comment.lower()
        if text.startswith(("splatrendermode", "antialiased")):
            stated = filters.get(text, 0.0)
    return stated


def write_ply(path: Path | str, cloud: GaussianCloud) -> None:
    """Write a cloud as a binary little-endian PLY that other 3DGS tools read.

    Antialiasing is stated in a comment. Means, rotations and colours survive a round trip bit for
    bit. Scales and opacities pass through
    a logarithm, which float32 cannot hold exactly (relative error up to 5e-7).

    Args:
        path: The file; it appears under its name only once complete.
        cloud: What to write.

    Raises:
        InfrastructureError: The folder is missing or not writable, or the disk is full.
    """
    path = Path(path)
    rows = ply_rows(cloud)
    comments = [text for text, px2 in _ANTIALIASED.items() if px2 == cloud.antialias_px2]
    header = _header(len(rows), [f"float {name}" for name in rows.dtype.names or ()], comments)
    with atomic_file(path) as partial, partial.open("wb") as stream:
        stream.write(header)
        stream.write(rows.tobytes())


def _header(count: int, properties: Sequence[str], comments: Sequence[str] = ()) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {text}" for text in comments]
    lines += [f"element vertex {count}"]
    lines += [f"property {name}" for name in properties]
    return "\n".join([*lines, "end_header", ""]).encode("ascii")


def write_points(path: Path, xyz: F64, rgb: U8) -> None:
    """Write points ``(N, 3)`` with colours ``(N, 3)`` as a binary PLY."""
    rows = np.empty(len(xyz), dtype=[("xyz", "<f4", 3), ("rgb", "u1", 3)])
    rows["xyz"], rows["rgb"] = xyz, rgb
    words = [*(f"float {name}" for name in "xyz"), *(f"uchar {name}" for name in COLOURS)]
    write_bytes(path, _header(len(rows), words) + rows.tobytes())


def ply_rows(cloud: GaussianCloud) -> NDArray[np.void]:
    """Return the rows ``(N,)`` of the vertex element that `write_ply` stores."""
    n, k = cloud.sh.shape[:2]
    higher = np.swapaxes(np.asarray(cloud.sh)[:, 1:, :], 1, 2).reshape(n, 3 * (k - 1))
    with np.errstate(divide="ignore"):
        log_scales = np.log(np.asarray(cloud.scales, dtype=np.float64))
    groups: list[tuple[Sequence[str], FloatArray]] = [
        (("x", "y", "z"), np.asarray(cloud.means)),
        (("nx", "ny", "nz"), np.zeros((n, 3))),
        ([f"f_dc_{i}" for i in range(3)], np.asarray(cloud.sh)[:, 0, :]),
        ([f"f_rest_{i}" for i in range(3 * (k - 1))], higher),
        (("opacity",), logit(np.asarray(cloud.opacities))[:, None]),
        ([f"scale_{i}" for i in range(3)], log_scales),
        ([f"rot_{i}" for i in range(4)], np.asarray(cloud.quats)),
    ]
    names = [name for group, _ in groups for name in group]
    table = np.concatenate([values for _, values in groups], axis=1).astype("<f4")
    return np.ascontiguousarray(table).view([(name, table.dtype) for name in names]).reshape(n)


def _only_gaussian_element(header: PlyHeader) -> PlyElement:
    """Return the only element that may hold Gaussians, or say which there are."""
    candidates = [
        element
        for element in header.elements
        if "opacity" in element.properties or element.name.startswith("vertex")
    ]
    if len(candidates) == 1:
        return candidates[0]
    names = [element.name for element in header.elements]
    if not candidates:
        raise InputError(
            f"{header.path}: no vertex element, only {names}",
            "give a 3DGS PLY",
        )
    raise InputError(
        f"{header.path}: {len(candidates)} models in one file: {[element.name for element in candidates]}",
        f"name one with element=, for example element={candidates[0].name!r}",
    )


def _neutral_of(name: str) -> float | None:
    """Return the value with which a property changes nothing; None where none is known."""
    return _NEUTRAL.get(re.sub(r"_\d+$", "", name))


def _check_neutral(
    header: PlyHeader, element: PlyElement, rows: NDArray[np.void], names: Sequence[str]
) -> None:
    """Refuse properties that are not neutral in every row."""
    changing = [name for name in names if not (rows[name] == _neutral_of(name)).all()]
    if changing:
        raise InputError(
            f"{header.path}, element {element.name!r}: properties that change what is drawn: {some_of(changing)}",
            "export a plain 3DGS model, with transforms and motions applied",
        )


def _check_properties(header: PlyHeader, element: PlyElement) -> tuple[int, list[str]]:
    """Return the number of coefficients per channel beyond the constant one, and the properties that
    must have their neutral value.
    """
    names = set(element.properties)
    location = f"{header.path}, element {element.name!r}"
    _check_names(names, location)
    _check_types(element, names, location)
    neutral = sorted(name for name in names if _neutral_of(name) is not None)
    return _coefficients_per_channel(names, location), neutral


def _check_names(names: set[str], location: str) -> None:
    """Refuse properties that are missing, unknown, or more than a Gaussian has."""
    missing = [name for name in _REQUIRED if name not in names]
    if missing:
        raise InputError(
            f"{location}: missing properties {missing}",
            "give a 3DGS PLY, not a mesh or points; read_gaussians also knows compressed PLY",
        )
    PLY.check(
        [field_name(VERTEX, name) for name in names],
        location,
        "export a plain 3DGS model, of one time and without filters; or leave the properties out if nothing is drawn of them",
    )
    numbered = {name for name in names if re.fullmatch(r"(scale|rot|f_dc)_\d+", name)}
    stray = sorted(numbered - {*_REQUIRED, *_SCALES})
    if stray:
        raise InputError(
            f"{location}: more numbers than a Gaussian has: {some_of(stray)}",
            PLAIN,
        )


def _check_types(element: PlyElement, names: set[str], location: str) -> None:
    """Refuse whole numbers where a logit or a logarithm stands."""
    fields = element.dtype or np.dtype([])
    whole = [name for name in ("opacity", *_SCALES) if name in names and fields[name].kind != "f"]
    if whole:
        raise InputError(
            f"{location}: whole numbers as {some_of(whole)}, which are a logit and logarithms",
            "export a plain 3DGS model, with properties of type float",
        )


def _coefficients_per_channel(names: set[str], location: str) -> int:
    """Return how many coefficients a channel has beyond the constant one, of whole bands."""
    n_rest = sum(name.startswith("f_rest_") for name in names)
    per_channel, left_over = divmod(n_rest, 3)
    is_complete = all(f"f_rest_{i}" in names for i in range(n_rest))
    has_whole_bands = math.isqrt(per_channel + 1) ** 2 == per_channel + 1
    if left_over or not is_complete or not has_whole_bands:
        raise InputError(
            f"{location}: {n_rest} f_rest properties; a degree L has 3 ((L + 1)^2 - 1): 0, 9, 24, 45, 72",
            "export the file again with whole bands of spherical harmonics",
        )
    return per_channel


def _columns(rows: NDArray[np.void], names: Sequence[str]) -> FloatArray:
    """Return ``(N, len(names))`` of float32, or float64 where the file has doubles."""
    doubles = any(rows.dtype[name].itemsize > 4 for name in names)
    return np.stack(
        [rows[name].astype(np.float64 if doubles else np.float32) for name in names], axis=1
    )


def _sh_from_columns(rows: NDArray[np.void], n_rest: int) -> FloatArray:
    """Return ``(N, 1 + n_rest, 3)``; the file is channel-major, memory is basis-major."""
    dc = _columns(rows, [f"f_dc_{i}" for i in range(3)])
    if not n_rest:
        return dc[:, None, :]
    higher = _columns(rows, [f"f_rest_{i}" for i in range(3 * n_rest)]).reshape(
        len(rows), 3, n_rest
    )
    return np.concatenate([dc[:, None, :], np.swapaxes(higher, 1, 2)], axis=1)


_MAX_HEADER_BYTES = 1 << 20
_KINDS = {
    "i1": ("char", "int8"),
    "u1": ("uchar", "uint8"),
    "i2": ("short", "int16"),
    "u2": ("ushort", "uint16"),
    "i4": ("int", "int32"),
    "u4": ("uint", "uint32"),
    "f4": ("float", "float32"),
    "f8": ("double", "float64"),
}
_SCALAR_CODES = {word: kind for kind, words in _KINDS.items() for word in words}
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}
_EXPORT_AGAIN = "export the file again as a binary PLY, or copy it again if the transfer broke off"


@dataclass(frozen=True)
class PlyElement:
    """Name one element of a PLY file.

    Attributes:
        name: Element name, such as ``vertex``.
        count: Number of rows.
        dtype: Row layout, or None if the element has list properties (its row size then varies).
        offset: Byte position of its first row in the file, or None if an element before it has list
            properties; in a text file, how many lines of rows stand before it.
    """

    name: str
    count: int
    dtype: np.dtype[np.void] | None
    offset: int | None

    @property
    def properties(self) -> tuple[str, ...]:
        """Return the property names in file order; empty for an element with list properties."""
        return () if self.dtype is None or self.dtype.names is None else self.dtype.names


@dataclass(frozen=True)
class PlyHeader:
    """Hold what a PLY header says.

    Attributes:
        path: The file.
        elements: In the order of the file.
        comments: Its comments.
        text: Where the rows begin in a text file; None in a binary one.
    """

    path: Path
    elements: tuple[PlyElement, ...]
    comments: tuple[str, ...] = ()
    text: int | None = None

    def element(self, name: str) -> PlyElement:
        """Return the element called `name`.

        Raises:
            InputError: No such element.
        """
        for element in self.elements:
            if element.name == name:
                return element
        raise InputError(
            f"{self.path}, element {name!r}: no such element; the file has {[element.name for element in self.elements]}",
            "name one of the elements of the file",
        )


def read_ply_header(path: Path | str) -> PlyHeader:
    """Read and check the header of a PLY file.

    Raises:
        InputError: Missing file, not a PLY, malformed header line, or an impossible count.
    """
    path = Path(path)
    lines, body_offset = _header_lines(path)
    form = ""
    comments = []
    element_rows: list[tuple[str, int, list[tuple[str, str] | None]]] = []
    for number, line in enumerate(lines, start=1):
        match line.split():
            case [] | ["ply" | "end_header", *_]:
                pass
            case ["comment" | "obj_info", *words]:
                comments.append(" ".join(words))
            case ["format", word, _] if word in _BYTE_ORDERS:
                form = word
            case ["element", name, count] if count.isascii() and count.isdigit():
                rows = int(count[:20])
                GAUSSIANS.check(rows, f"{path}, line {number}", "element count")
                element_rows.append((name, rows, []))
            case ["property", "list", *_] if element_rows:
                element_rows[-1][2].append(None)
            case ["property", word, name, *_] if element_rows and form and word in _SCALAR_CODES:
                # CloudCompare puts scalar_ before every name.
                code = _BYTE_ORDERS[form] + _SCALAR_CODES[word]
                element_rows[-1][2].append((name.removeprefix("scalar_"), code))
            case _:
                raise InputError(
                    f"{path}, line {number}: a line that means nothing here: {line[:80]!r}",
                    _EXPORT_AGAIN,
                )
    if not form:
        raise InputError(f"{path}: no format line", _EXPORT_AGAIN)
    is_text = form == "ascii"
    elements = _placed_elements(path, element_rows, None if is_text else body_offset)
    return PlyHeader(path, elements, tuple(comments), body_offset if is_text else None)


def _placed_elements(
    path: Path,
    element_rows: Sequence[tuple[str, int, list[tuple[str, str] | None]]],
    body_offset: int | None,
) -> tuple[PlyElement, ...]:
    """Return the elements with where each begins: bytes of the file, or lines of a text's body. What
    stands behind an element with lists in a binary file has no known place.

    Args:
        path: For errors.
        element_rows: Name, number of rows, and properties with their types; None is a list.
        body_offset: Where the body of a binary file begins; None of a text.
    """
    elements = []
    is_text = body_offset is None
    offset = 0 if is_text else body_offset
    for name, rows, fields in element_rows:
        scalars = [field for field in fields if field is not None]
        with parsing(path, _EXPORT_AGAIN, f"element {name!r}"):
            dtype = np.dtype(scalars) if len(scalars) == len(fields) else None
        elements.append(PlyElement(name, rows, dtype, offset))
        if is_text and offset is not None:
            offset += rows
        elif dtype is not None and offset is not None:
            offset += rows * dtype.itemsize
        else:
            offset = None
    return tuple(elements)


def read_ply_element(header: PlyHeader, name: str) -> NDArray[np.void]:
    """Read all rows of one element.

    Returns:
        Structured array ``(count,)`` with the file's property names and types.

    Raises:
        InputError: Unknown element, list properties in the way, or the file ends too early.
    """
    element = header.element(name)
    if element.dtype is None or element.offset is None:
        raise InputError(
            f"{header.path}, element {name!r}: {'list properties, so rows have no fixed size' if element.dtype is None else 'it follows list properties'}",
            "give a Gaussian model; meshes with faces are not one",
        )
    if header.text is not None:
        return _text_rows(header, element, element.dtype, header.text, element.offset)
    have = header.path.stat().st_size - element.offset
    if element.count * element.dtype.itemsize > have:
        rows = max(have, 0) // element.dtype.itemsize
        raise InputError(
            f"{header.path}, element {name!r}: the header announces {element.count} rows of {element.dtype.itemsize} bytes, the file ends after {rows}",
            _EXPORT_AGAIN,
        )
    with open_regular(header.path) as stream:
        return np.fromfile(stream, dtype=element.dtype, count=element.count, offset=element.offset)


def _text_rows(
    header: PlyHeader, element: PlyElement, dtype: np.dtype[np.void], start: int, first: int
) -> NDArray[np.void]:
    lines = read_bytes(header.path)[start:].splitlines()[first : first + element.count]
    location = f"{header.path}, element {element.name!r}"
    if len(lines) < element.count:
        raise InputError(f"{location}: {len(lines)} of {element.count} rows", _EXPORT_AGAIN)
    with parsing(location, _EXPORT_AGAIN, "rows that are not of numbers"):
        table = np.loadtxt(lines, dtype=np.float64, ndmin=2, comments=None)
        rows = np.empty(element.count, dtype=dtype)
        for name, column in zip(element.properties, table.T, strict=True):
            rows[name] = column
    return rows


def _header_lines(path: Path) -> tuple[list[str], int]:
    """Return the header's lines and the byte position after it."""
    with open_regular(path) as stream:
        head = stream.read(_MAX_HEADER_BYTES)
    if head[:3] != b"ply" or head[3:4] not in (b"\n", b"\r"):
        raise InputError(
            f"{path}: first bytes {head[:4]!r}, expected b'ply'",
            "give a PLY file",
        )
    marker = head.find(b"\nend_header")
    end = head.find(b"\n", marker + 1) if marker >= 0 else -1
    if end < 0:
        raise InputError(
            f"{path}: no end_header in the first {len(head)} bytes",
            _EXPORT_AGAIN,
        )
    return head[:end].decode("ascii", errors="replace").splitlines(), end + 1
