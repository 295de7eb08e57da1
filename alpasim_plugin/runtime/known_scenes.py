"""Finds scenes by the ids that logs hold."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import Scenario, Scene
from alpasim_plugin.run_folder.scenes import LoggedScene
from scenarios.load import load_scenario
from scenarios.suite import load_suite
from scenarios.usdz import read_usdz, usdz_scene_id

DOING = "finding the scene of a log"
_SEEDED = re.compile(r"(?P<own>.+)-seed(?P<seed>\d+)")  # a seed other than the file's is part of the id


class KnownScenes:
    """Finds scenes in files and folders; each is read once, on first use.

    Args:
        places: Scenes (anything that ``simrun run`` drives), or folders of them.
        rails: Whether lanes of AlpaSim scenes keep their rails.

    Raises:
        InputError: A place without scenes, or two AlpaSim scenes with one id.
    """

    def __init__(self, places: Sequence[str | Path], rails: bool = True) -> None:
        self.places, self._rails = [str(place) for place in places], rails
        self._archives: dict[str, Path] = {}
        self._others: list[str] = []
        self._read: dict[str, LoggedScene] = {}
        for place in self.places:
            for path in _scene_files(place):
                if Path(path).suffix == ".usdz":
                    self._add_archive(Path(path))
                else:
                    self._others.append(path)

    def of(self, scene_id: str) -> LoggedScene:
        """Return the scene with an id.

        Raises:
            InputError: None of the places has it, or it cannot be read.
        """
        if scene_id not in self._read and scene_id in self._archives:
            self._read[scene_id] = _from_archive(self._archives[scene_id], self._rails)
        seeded = _SEEDED.fullmatch(scene_id)
        for path in list(self._others) if scene_id not in self._read else []:
            found = _from_scenario(load_scenario(path))
            if seeded and found.scene_id == seeded["own"]:
                found = _from_scenario(load_scenario(path, int(seeded["seed"])))
            else:
                self._others.remove(path)
            self._read[found.scene_id] = found
            if found.scene_id == scene_id:
                break
        if scene_id not in self._read:
            known = sorted({*self._archives, *self._read})
            raise InputError(
                DOING, f"scene {scene_id!r}", f"not among the {len(known)} scenes of {', '.join(self.places)}: {', '.join(known[:5])}",
                "name the log's scene with --scene, or a folder that holds it",
            )  # fmt: skip
        return self._read[scene_id]

    def _add_archive(self, path: Path) -> None:
        scene_id = usdz_scene_id(path)
        before = self._archives.get(scene_id)
        if before is not None and before.resolve() != path.resolve():
            raise InputError(DOING, f"{before} and {path}", f"both have the id {scene_id!r}", "remove one of them")
        self._archives[scene_id] = path


def _scene_files(place: str) -> list[str]:
    """Return the scene files of a path, a folder or a shipped name."""
    path = Path(place)
    archives = sorted(path.rglob("*.usdz")) if path.is_dir() else []
    if archives:
        return [str(one) for one in archives]
    return [ref.path for ref in load_suite(place)]


def _from_archive(path: Path, rails: bool) -> LoggedScene:
    record = read_usdz(path, rails, needs_map=False)
    scene = Scene(record.scene_id, record.lane_map, record.ego_log, record.vehicle, record.alpasim_map)
    return LoggedScene(scene, record.source, record.content_hash, record.notes, record.actors, record.world_origin)


def _from_scenario(one: Scenario) -> LoggedScene:
    return LoggedScene(
        one.scene, one.source, one.content_hash, one.notes, one.actors, one.world_origin, one.start_us, one.end_us, one.warmup_us
    )


def scenario_finder(places: Sequence[str]) -> Callable[[str], Scenario]:
    """Return what finds a scenario by its scene id among files, folders and shipped names.

    Without places, and only then, every id gets a straight road, of which nothing is true but the id: a policy under test takes no more
    from its scenario than cameras and vehicle.

    Raises (when called):
        InputError: None of the places has the id.
    """
    if not places:
        blank = load_scenario("smoke/straight")
        return lambda scene_id: replace(blank, scene_id=scene_id, actors=())
    paths = [path for place in places for path in _scene_files(place)]
    found: dict[str, Scenario] = {}
    reading = threading.Lock()  # sessions open at the same time

    def find(scene_id: str) -> Scenario:
        with reading:
            while scene_id not in found and paths:
                scenario = load_scenario(paths.pop(0))
                found[scenario.scene_id] = scenario
        if scene_id not in found:
            shown = ", ".join(sorted(found)[:5])
            raise InputError(DOING, f"scene {scene_id!r}", f"not among the {len(found)} scenes given: {shown}", "name it with --scenes")
        return found[scene_id]

    return find
