"""Open any supported Gaussian file by what it is, and report what cleaning dropped."""

from pathlib import Path

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.reading import open_regular, parsing
from alpasim_plugin.gaussians.cloud import CleanReport, GaussianArrays, GaussianCloud, build_cloud
from alpasim_plugin.gaussians.files.packed import (
    is_compressed_ply,
    read_compressed_ply,
    read_splat,
    read_spz,
)
from alpasim_plugin.gaussians.files.ply import read_ply_arrays, read_ply_header
from alpasim_plugin.gaussians.files.sog import is_sog, read_sog

SUPPORTED = (".ply", ".compressed.ply", ".splat", ".spz", ".sog (also as a folder with meta.json)")


def read_gaussians(
    path: Path | str, element: str | None = None
) -> tuple[GaussianCloud, CleanReport]:
    """Read a Gaussian model in any supported form.

    The first bytes decide between PLY and SPZ; ``.splat`` has no header and is known by its suffix.
    SPZ models are turned into the axes of a PLY, so the same model lies in the same place in every
    form.

    Args:
        path: PLY, compressed PLY, ``.splat`` or ``.spz`` file; SOG as ``.sog`` or as its folder.
        element: For a PLY with several models, the one to read.

    Returns:
        The cloud without broken Gaussians, and the count of those dropped, by cause.

    Raises:
        InputError: Unknown form, or a damaged file.

    Example:
        >>> cloud, report = read_gaussians("garden.spz")  # doctest: +SKIP
    """
    with parsing(path):
        return build_cloud(_read_arrays(Path(path), element))


def _read_arrays(path: Path, element: str | None) -> GaussianArrays:
    if is_sog(path):
        return read_sog(path)
    with open_regular(path) as stream:
        head = stream.read(4)
    if head[:3] == b"ply":
        compressed = is_compressed_ply(read_ply_header(path))
        return read_compressed_ply(path) if compressed else read_ply_arrays(path, element)
    if head[:4] == b"NGSP" or head[:2] == b"\x1f\x8b":
        return read_spz(path)
    if path.suffix.lower() == ".splat":
        return read_splat(path)
    raise InputError(
        f"{path}: suffix {path.suffix!r} with first bytes {head!r}",
        f"give one of {', '.join(SUPPORTED)}; .ksplat, .lcc, .splatv and training checkpoints must be converted first (splat-transform)",
    )
