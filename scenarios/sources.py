"""The table of recorded sources: how each is recognised and read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from alpasim_plugin.errors import InputError
from scenarios.argoverse import read_argoverse
from scenarios.commonroad import read_commonroad
from scenarios.cosmos import read_cosmos
from scenarios.recorded import RecordedLog
from scenarios.usdz import read_usdz


@dataclass(frozen=True)
class Source:
    """One kind of recorded input."""

    help: str
    matches: Callable[[Path], bool]
    read: Callable[[Path, str | None], RecordedLog]


SOURCES: dict[str, Source] = {
    "argoverse": Source(
        "Argoverse 2 log folder",
        lambda p: p.is_dir() and ((p / "city_SE3_egovehicle.feather").exists() or (p / "map").is_dir()),
        lambda p, ego: read_argoverse(p),
    ),
    "commonroad": Source("CommonRoad XML", lambda p: p.suffix == ".xml", lambda p, ego: read_commonroad(p, ego)),
    "cosmos": Source(
        "Cosmos-Drive-Dreams clip folder",
        lambda p: p.is_dir() and any((p / name).is_dir() for name in ("vehicle_pose", "3d_lanes", "pinhole_intrinsic")),
        lambda p, ego: read_cosmos(p),
    ),
    "usdz": Source("AlpaSim scene", lambda p: p.suffix == ".usdz", lambda p, ego: read_usdz(p)),
}


def detect(path: Path) -> str:
    """Return ``yaml`` or the name of the source that a path is.

    Raises:
        InputError: Nothing recognises it.
    """
    if path.suffix in (".yaml", ".yml") and not path.is_dir():
        return "yaml"
    for name, source in SOURCES.items():
        if source.matches(path):
            return name
    what = f"a folder with {', '.join(sorted(p.name for p in path.iterdir())[:5]) or 'nothing'}" if path.is_dir() else "a file"
    raise InputError(
        "reading a scenario", str(path), f"{what} that no reader recognises", f"give a scenario .yaml, or one of: "
        f"{', '.join(s.help for s in SOURCES.values())}",
    )  # fmt: skip


def read_log(kind: str, path: Path, ego: int | str | None) -> RecordedLog:
    """Read a recorded log of a known kind."""
    return SOURCES[kind].read(path, None if ego is None else str(ego))
