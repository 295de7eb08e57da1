"""The formats of recorded drives that come with the package, and how a path finds its reader."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import Source
from alpasim_plugin.plugins.parts import PartSpec, build, names, resolve
from scenarios.recorded import RecordedLog


class Argoverse(Source):
    """Argoverse 2 log folders."""

    help = "Argoverse 2 log folder"

    def matches(self, path: Path) -> bool:
        """Look for the ego's poses or the map."""
        return path.is_dir() and ((path / "city_SE3_egovehicle.feather").exists() or (path / "map").is_dir())

    def read(self, path: Path, ego: str | None) -> RecordedLog:
        """Read a log; the ego is the recording vehicle."""
        from scenarios.argoverse import read_argoverse

        return read_argoverse(path)


class CommonRoad(Source):
    """CommonRoad scenarios of version 2020a or 2018b."""

    help = "CommonRoad XML"

    def matches(self, path: Path) -> bool:
        """Go by the ending."""
        return path.suffix == ".xml"

    def read(self, path: Path, ego: str | None) -> RecordedLog:
        """Read a scenario; ``ego`` is the id of the obstacle that becomes the ego."""
        from scenarios.commonroad import read_commonroad

        return read_commonroad(path, ego)


class Cosmos(Source):
    """Cosmos-Drive-Dreams clips."""

    help = "Cosmos-Drive-Dreams clip folder"

    def matches(self, path: Path) -> bool:
        """Look for one of the dataset's folders."""
        return path.is_dir() and any((path / name).is_dir() for name in ("vehicle_pose", "3d_lanes", "pinhole_intrinsic"))

    def read(self, path: Path, ego: str | None) -> RecordedLog:
        """Read a clip; the ego is the recording vehicle."""
        from scenarios.cosmos import read_cosmos

        return read_cosmos(path)


class Usdz(Source):
    """AlpaSim scenes."""

    help = "AlpaSim scene"

    def matches(self, path: Path) -> bool:
        """Go by the ending."""
        return path.suffix == ".usdz"

    def read(self, path: Path, ego: str | None) -> RecordedLog:
        """Read a scene; the ego is the recording vehicle."""
        from scenarios.usdz import read_usdz

        return read_usdz(path)


def source_of(path: Path) -> str | None:
    """Return the name of the source that recognises a path; None where none does. Scenario files are recognised by none."""
    return next((name for name in names("source") if _source(name)[1].matches(path)), None)


def detect(path: Path) -> str:
    """Return ``yaml`` or the name of the source that a path is.

    Raises:
        InputError: Nothing recognises it.
    """
    if path.suffix in (".yaml", ".yml") and not path.is_dir():
        return "yaml"
    name = source_of(path)
    if name is not None:
        return name
    what = f"a folder with {', '.join(sorted(p.name for p in path.iterdir())[:5]) or 'nothing'}" if path.is_dir() else "a file"
    formats = ", ".join(_source(name)[1].help or name for name in names("source"))
    do = f"give a scenario .yaml, or one of: {formats}; a reader of your own is named with --source (docs/extending.md)"
    raise InputError("reading a scenario", str(path), f"{what} that no reader recognises", do)


def read_log(kind: str, path: Path, ego: int | str | None) -> RecordedLog:
    """Read a recorded log.

    Args:
        kind: Its source as `alpasim_plugin.plugins.parts.resolve` takes it.
        path: File or folder.
        ego: Which recorded vehicle becomes the ego, where the format does not say it.

    Raises:
        InputError: Anything wrong with the log, or a reader that gives something else than a `RecordedLog`.
    """
    spec, source = _source(kind)
    record = source.read(path, None if ego is None else str(ego))
    if not isinstance(record, RecordedLog):
        found = f"a {type(record).__name__}"
        raise InputError(
            "reading a scenario", f"source {spec.name!r}, {path}", found, "make the reader return a scenarios.recorded.RecordedLog"
        )
    return record


def source_digest(kind: str) -> str | None:
    """Return what identifies a source's code and files."""
    return _source(kind)[0].digest


@lru_cache(maxsize=16)
def _source(kind: str) -> tuple[PartSpec, Source]:
    spec = resolve("source", kind)
    source: Source = build(spec)
    return spec, source
