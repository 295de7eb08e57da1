"""From a path to its document, and from a specification to its recording: the formats of recorded
drives and their readers.
"""

import os
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import contents, parsing, real
from alpasim_plugin.core.files.config import Document, load_yaml
from alpasim_plugin.core.files.inputs import Inputs, note_files, unrecorded
from alpasim_plugin.core.interfaces import Source
from alpasim_plugin.core.parts import PartSpec, build, names, require_installed, resolve
from scenarios.recorded import RecordedLog
from scenarios.schema_parts import SHIPPED
from scenarios.unread_forms import unread_form
from scenarios.variation import SceneDraft

SCENARIO_FILE = "scenario.yaml"  # of an imported drive
MODELS = (".ply", ".splat", ".spz", ".sog")
FILMS = (".mp4", ".mov", ".mkv", ".webm", ".avi", ".m4v")
DRIVES = ("transforms.json", "calib.txt", "cameras.bin", "cameras.txt", "sparse", "colmap")
MAPS = {".xodr": "opendrive", ".osm": "lanelet2"}
DRIVE_FILE = "drive.json"  # of an imported drive, as `scenarios.drive` has it


class Argoverse(Source):
    """Argoverse 2 log folders."""

    help = "Argoverse 2 log folder"

    def matches(self, path: Path) -> bool:
        """Look for the ego's poses or the map."""
        return os.path.isdir(path) and (
            os.path.exists(path / "city_SE3_egovehicle.feather") or os.path.isdir(path / "map")
        )

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


class ImportedDrive(Source):
    """Recorded drives that ``simrun import`` has written."""

    help = "folder that simrun import has written"

    def matches(self, path: Path) -> bool:
        """Look for the drive's own file."""
        return os.path.isfile(path / DRIVE_FILE)

    def read(self, path: Path, ego: str | None) -> RecordedLog:
        """Read a drive; the ego is the recording vehicle."""
        from scenarios.drive import read_drive

        return read_drive(path)


class Osi(Source):
    """Traces of the Open Simulation Interface."""

    help = "OSI trace"

    def matches(self, path: Path) -> bool:
        """Go by the ending."""
        return path.suffix in (".osi", ".mcap")

    def read(self, path: Path, ego: str | None) -> RecordedLog:
        """Read a trace; ``ego`` is the id of the moving object that becomes the ego."""
        from scenarios.osi import read_osi

        return read_osi(path, ego)


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


def open_document(path: Path, source: str | None) -> Document:
    """Return the document of a scenario file, or the one that stands for a recorded log.

    Args:
        path: File or folder, which exists.
        source: Who reads it, as `alpasim_plugin.core.parts.resolve` takes it; None finds out.

    Raises:
        InputError: Nothing recognises the path, the file is broken, or it is a suite.
    """
    kind = source or detect(path)
    if kind in MAPS.values():
        return Document({"version": 1, "map": {kind: str(real(path))}}, {}, str(path))
    if kind != "yaml":
        place = str(real(path))
        log = {kind: place} if kind in SHIPPED else {"source": kind, "path": place}
        return Document({"version": 1, "log": log}, {}, str(path))
    document = load_yaml(path)
    if isinstance(document.data, dict) and "scenarios" in document.data:
        raise document.error(
            ("scenarios",),
            "a suite, not a scenario",
            "use load_suite, or run it with simrun",
        )
    return document


def source_of(path: Path) -> str | None:
    """Return the name of the source that recognises a path; None where none does. Scenario files
    are recognised by none.
    """
    return next((name for name in names("source") if _source(name)[1].matches(path)), None)


def detect(path: Path) -> str:
    """Return ``yaml``, a format of maps or the name of the source that a path is.

    Raises:
        InputError: Nothing recognises it.
    """
    if path.suffix in (".yaml", ".yml") and not os.path.isdir(path):
        return "yaml"
    if path.suffix in MAPS:
        return MAPS[path.suffix]
    name = source_of(path)
    if name is not None:
        return name
    description = contents(path)
    advice = import_advice(path)
    if advice is not None:
        raise InputError(f"{path}: {description}, which is no scenario yet", advice)
    formats = ", ".join(_source(name)[1].help or name for name in names("source"))
    raise InputError(
        f"{path}: {description} that no reader recognises",
        f"give a scenario .yaml, a map (OpenDRIVE .xodr, Lanelet2 .osm), or one of: {formats}; a reader of your own is named with --source (docs/extending.md)",
    )


def import_advice(path: Path) -> str | None:
    """Return the command that makes a scenario of a path; None where nothing suggests one."""
    out = f"-o OUT, then simrun OUT/{SCENARIO_FILE}"
    if path.suffix.lower() in MODELS or os.path.isfile(path / "meta.json"):
        return f"make one: simrun import splat {path} --poses POSES {out}"
    if path.suffix.lower() in FILMS:
        return "find the film's poses with COLMAP, then simrun import drive (docs/real-drives.md)"
    places = [path / name for name in DRIVES]
    if path.name == DRIVES[0] or any(os.path.exists(place) for place in places):
        return f"make one: simrun import drive {path} {out}"
    unread = unread_form(path)
    return None if unread is None else f"{unread[0]} is not read: {unread[1]}"


def recorded_drive(draft: SceneDraft, named: str | None = None) -> RecordedLog:
    """Read the recorded log that a specification names, and check what the reader returns.

    Args:
        draft: The specification.
        named: A reader that need not be installed, since the user has named it.

    Raises:
        InputError: Nothing is there, anything is wrong with the log, or the reader gives something
            else than a `RecordedLog`.
    """
    document = draft.document
    log = draft.spec.log
    assert log is not None
    kind, text, key = log.recorded
    path = document.folder_of(("log", key)) / text if document.marks else Path(text)
    if not os.path.exists(path):
        raise document.error(
            ("log", key),
            f"{path} does not exist",
            "correct the path; it is relative to the scenario file",
        )
    require_installed([kind], document.path, [named])
    spec, source, read_when_made = _source(kind)
    note_files(read_when_made)
    with parsing(path, "repair this log, or use another one"):
        record = source.read(path, None if log.ego is None else str(log.ego))
        if not isinstance(record, RecordedLog):
            raise InputError(
                f"source {spec.name!r}, {path}: a {type(record).__name__}",
                "make the reader return a scenarios.recorded.RecordedLog",
            )
    from scenarios.map_lines import link_notes  # takes a while to import

    return replace(record, notes=(*record.notes, *link_notes(record.lane_map.lanes)))


def source_digest(kind: str) -> str | None:
    """Return what identifies a source's code and files."""
    return _source(kind)[0].digest


@lru_cache(maxsize=16)
def _source(kind: str) -> tuple[PartSpec, Source, dict[str, str]]:
    """Return a source, made once, with the files that it read when it was imported and made, beside
    those of its digest.
    """
    with unrecorded(), Inputs() as inputs:
        spec = resolve("source", kind)
        source: Source = build(spec)
    of_digest = {str(real(path)) for path in (*spec.code, *spec.files)}
    read = {path: content for path, content in inputs.files.items() if path not in of_digest}
    return spec, source, read
