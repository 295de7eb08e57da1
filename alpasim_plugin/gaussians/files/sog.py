"""Read SOG (PlayCanvas, version 2): ``meta.json`` and lossless WebP planes, in a folder or zipped
as ``.sog``.

One pixel a Gaussian, row by row. Places are 16 bits an axis on a logarithmic scale; rotations leave
out their largest component; scales and colours are entries of codebooks of 256; higher harmonics
are shared by palette. Axes are those of a PLY.
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from typing_extensions import TypedDict

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import parse_json, read_bytes
from alpasim_plugin.core.files.fields import Fields, field_name
from alpasim_plugin.core.files.limits import GAUSSIANS, SOURCE_BYTES, STORED_PIXELS
from alpasim_plugin.core.files.reading import as_shape, parsing
from alpasim_plugin.core.files.zips import open_zip, read_member
from alpasim_plugin.core.types import F64, U8
from alpasim_plugin.gaussians.cloud import GaussianArrays
from alpasim_plugin.gaussians.constants import EPS2D_PX2
from alpasim_plugin.gaussians.files.packed import with_largest

META = "meta.json"
DO_THIS = "write it again as SOG of version 2 (splat-transform), or give the PLY"
BANDS = {1: 3, 2: 8, 3: 15}  # of harmonics above the constant one to coefficients
PALETTE_WIDTH = 64  # palette entries a row of the centroids' plane
Get = Callable[[str], bytes]


class _Plane(TypedDict):
    codebook: list[float]
    files: list[str]


class _Means(TypedDict):
    mins: list[float]
    maxs: list[float]
    files: list[str]


class _Files(TypedDict):
    files: list[str]


class _Meta(TypedDict):
    version: int
    count: int
    means: _Means
    scales: _Plane
    quats: _Files
    sh0: _Plane


SOG = Fields(
    "SOG",
    read={
        META: " ".join((*_Meta.__annotations__, "shN", "antialias", "model")),
        "means": "mins maxs files",
        "scales": "codebook files",
        "quats": "files",
        "sh0": "codebook files",
        "shN": "count bands codebook files",
    },
    harmless={META: "asset width height"},
    # LichtFeld Studio names the size of its palette so, and has written the harmonics in an order
    # that neither its own reader nor any other one expects.
    moving={"shN": "palette_size coeffs"},
    others="refused",
)


def is_sog(path: Path) -> bool:
    """Return whether a path is a folder with SOG's ``meta.json``, that file, or a zip."""
    return (
        (os.path.isdir(path) and os.path.isfile(path / META))
        or path.name == META
        or path.suffix.lower() == ".sog"
    )


def read_sog(path: Path) -> GaussianArrays:
    """Read a model.

    Raises:
        InputError: A plane is missing, damaged or too small; or another version.
    """
    if os.path.isdir(path) or path.name == META:
        folder = path if os.path.isdir(path) else path.parent
        return _read(lambda name: read_bytes(folder / Path(name).name, SOURCE_BYTES), folder / META)
    with (
        parsing(path, DO_THIS, "a damaged zip"),
        open_zip(path, SOURCE_BYTES, DO_THIS) as archive,
    ):
        infos = {Path(info.filename).name: info for info in archive.infolist()}
        return _read(
            lambda name: read_member(archive, infos[name], SOURCE_BYTES, path, DO_THIS), path
        )


def _read(get: Get, location: Path) -> GaussianArrays:
    document = parse_json(get(META), location)
    meta = as_shape(_Meta, document, location, DO_THIS)
    if meta["version"] != 2:
        raise InputError(f"{location}: version {meta['version']}", DO_THIS)
    met = [field_name(META, key) for key in document]
    planes = {key: part for key, part in document.items() if isinstance(part, dict)}
    for plane_name in planes.keys() - {"asset"}:
        met += [field_name(plane_name, key) for key in planes[plane_name]]
    SOG.check(met, location, DO_THIS)
    model = document.get("model", "default")
    if model not in ("default", "antialiased", "2dgs"):
        raise InputError(f"{location}: a model {model!r}", DO_THIS)
    n = meta["count"]
    GAUSSIANS.check(n, location)

    def plane(name: str, least: int) -> U8:
        pixels = _plane(get(name), f"{location}, {name}").reshape(-1, 4)
        if len(pixels) < least:
            raise InputError(
                f"{location}, {name}: {len(pixels)} pixels for {least} values", DO_THIS
            )
        return pixels[:least]

    low, high = (plane(name, n)[:, :3].astype(np.float64) for name in meta["means"]["files"])
    mins = np.array(meta["means"]["mins"])
    maxs = np.array(meta["means"]["maxs"])
    logs = mins + (low + 256 * high) / 65535 * (maxs - mins)
    means = np.sign(logs) * np.expm1(np.abs(logs))
    scales = np.exp(
        np.array(meta["scales"]["codebook"])[plane(meta["scales"]["files"][0], n)[:, :3]]
    )
    colour = plane(meta["sh0"]["files"][0], n)
    constant = np.array(meta["sh0"]["codebook"])[colour[:, :3]]
    harmonics = np.zeros((n, 0, 3))
    if document.get("shN"):
        harmonics = _harmonics(document.get("shN"), plane, n)
    sh = np.concatenate([constant[:, None], harmonics], axis=1)
    pixels = plane(meta["quats"]["files"][0], n)
    three = (pixels[:, :3] / 255.0 - 0.5) * np.sqrt(2.0)
    quats = with_largest(three, np.clip(pixels[:, 3].astype(np.int64) - 252, 0, 3))
    antialiased = document.get("antialias") or model == "antialiased"
    antialias_px2 = EPS2D_PX2 if antialiased else 0.0
    opacities = colour[:, 3] / 255.0
    return GaussianArrays(means, quats, scales, opacities, sh, antialias_px2=antialias_px2)


def _plane(data: bytes, location: str) -> U8:
    """Return a plane as RGBA ``(H, W, 4)``, after looking at the size that its header claims."""
    size = _webp_size(data)
    if size is None:
        raise InputError(f"{location}: {len(data)} bytes beginning {data[:4]!r}, no WebP", DO_THIS)
    STORED_PIXELS.check(size[0] * size[1], location)
    with parsing(location, DO_THIS, "no readable WebP"):
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 3:
        raise InputError(f"{location}: a plane that does not decode", DO_THIS)
    code = cv2.COLOR_BGR2RGBA if image.shape[2] == 3 else cv2.COLOR_BGRA2RGBA
    return cv2.cvtColor(image, code)


def _webp_size(data: bytes) -> tuple[int, int] | None:
    """Return width and height of a WebP file (RFC 9649, 2.5 to 2.7); None where it is none."""
    if data[:4] != b"RIFF" or data[8:12] != b"WEBP" or len(data) < 30:
        return None
    if data[12:16] == b"VP8L":
        bits = int.from_bytes(data[21:25], "little")
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if data[12:16] == b"VP8X":
        return int.from_bytes(data[24:27], "little") + 1, int.from_bytes(data[27:30], "little") + 1
    return int.from_bytes(data[26:28], "little") & 0x3FFF, int.from_bytes(
        data[28:30], "little"
    ) & 0x3FFF


def _harmonics(facts: dict[str, Any], plane: Callable[[str, int], U8], n: int) -> F64:
    """Return the higher harmonics ``(N, K, 3)``."""
    count = int(facts["count"])
    bands = int(facts["bands"])
    coefficients = BANDS[bands]
    codebook = np.array(facts["codebook"], dtype=np.float64)
    rows = -(-count // PALETTE_WIDTH)
    centroids = plane(facts["files"][0], rows * PALETTE_WIDTH * coefficients)[:, :3]
    palette = codebook[centroids].reshape(rows * PALETTE_WIDTH, coefficients, 3)
    labels = plane(facts["files"][1], n).astype(np.int64)
    return palette[np.minimum(labels[:, 0] + 256 * labels[:, 1], count - 1)]
