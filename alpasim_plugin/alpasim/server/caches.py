"""What a server keeps loaded: scenes, found by id in folders, and a fixer for each.

A fixer behind a service is a pure step from a past and a render to a frame and the next past.
"""

import os
import threading
from collections import OrderedDict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from alpasim_plugin.alpasim.server.status import CallTime, UnknownScene
from alpasim_plugin.cameras.lens_cover import LensCover
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import some_of
from alpasim_plugin.core.interfaces import BlockRule, Renderer
from alpasim_plugin.core.parts import RendererSpec, build, complete, resolve_renderer
from alpasim_plugin.core.types import U8, CameraSpec, Frame, RenderRequest, Scenario
from alpasim_plugin.fixers.pixel_settings import PixelFixerSettings
from alpasim_plugin.fixers.references import ReferenceSession, session_of
from alpasim_plugin.fixers.semantic_map.prepare import PreparedMap, prepare_map
from alpasim_plugin.fixers.settings import FixerSettings
from alpasim_plugin.log.schema import wire_camera
from alpasim_plugin.log.wire import FRONT_WIDE, sensorsim_pb2
from alpasim_plugin.renderers.weather import in_weather
from alpasim_plugin.runs.guards import checked_frames
from scenarios.load import load_scenario
from scenarios.usdz import usdz_scene_id

KEPT_SCENES = 4  # loaded, the least recently used going first
FILES = (".usdz", ".yaml", ".yml", ".xml")


class CausalFixer(Protocol):
    """Fix one frame at a time with an explicit past, as
    `alpasim_plugin.fixers.pixel_fixer.PixelFixer` does.
    """

    def advance(self, frame: Frame, sdmap: U8 | None, past: Any) -> tuple[Frame, Any]:
        """Return the frame fixed and what the next frame's call is given as ``past``; a past is
        never written to.
        """


def resolve_served(name: str, overrides: Sequence[str] = ()) -> RendererSpec:
    """Resolve a renderer for serving: noise is keyed by content, and ``identity`` is no fixer.

    Raises:
        InputError: An unknown name, a bad setting, or a fixer that needs frames ahead of the
            present.
    """
    spec = resolve_renderer(name, overrides)
    if spec.fixer is None:
        return spec
    if isinstance(spec.fixer.settings, PixelFixerSettings):
        return resolve_renderer(name, [*overrides, "noise=content"])
    if spec.fixer.name == "identity":
        return RendererSpec(spec.name, spec.base)
    settings: Any = spec.fixer.settings
    problem = (
        f"{spec.fixer.name} works on blocks of frames, whose poses are not part of a render request"
    )
    if settings.loop_mode == "frame by frame":
        problem = f"{spec.fixer.name} has one history a camera, and requests of several drives come over one connection"
    raise InputError(
        f"renderer {name!r}: {problem}",
        "serve a fixer with an explicit past, such as onefixer",
    )


class FixerCache:
    """One fixer per scene (the scene is in the noise's key); the network is loaded once and shared.

    Args:
        spec: A renderer with a fixer.
        device: For the network.
    """

    def __init__(self, spec: RendererSpec, device: str = "cpu") -> None:
        assert spec.fixer is not None, "a renderer without a fixer has nothing to fix"
        self._spec = spec.fixer
        self._session = {"device": device, "threads": None}
        self._made: dict[str, CausalFixer] = {}

    @property
    def needs_map(self) -> bool:
        """Whether the fixer takes semantic maps."""
        return bool(getattr(self._spec.settings, "uses_map", False))

    def of(self, scene_id: str) -> CausalFixer:
        """Return the fixer of a scene."""
        if scene_id not in self._made:
            if len(self._made) >= 256:  # ids come from requests
                self._made.clear()
            fixer = build(self._spec, scene_id=scene_id, seed=0, **self._session)
            if fixer.blocks != BlockRule(1, 1) or not hasattr(fixer, "advance"):
                raise InputError(
                    f"fixer {self._spec.name!r}: {type(fixer).__name__} has no advance(frame, map, past)",
                    "serve a fixer of single frames, such as onefixer",
                )
            self._made[scene_id] = fixer
        return self._made[scene_id]


@dataclass(frozen=True)
class SceneEntry:
    """A loaded scene: the scenario, its prepared map, its renderer where the server renders itself,
    and its recorded frames, if any.
    """

    scenario: Scenario
    scene_map: PreparedMap | None
    renderer: Renderer | None
    references: ReferenceSession | None = None
    reads_device: bool = False  # whether its fixer takes frames from a device

    def render(self, requests: Sequence[RenderRequest], on_device: bool = False) -> list[Frame]:
        """Render the frames of an instant with their references, which depend on the requests
        alone; what a device drew may stay there.
        """
        assert self.renderer is not None, "scenes without a renderer are for maps only"
        frames = checked_frames(self.renderer, requests, on_device)
        if self.references is None:
            return frames
        return self.references.added(requests, frames, on_device)

    @property
    def draws_lenses(self) -> bool:
        """Whether the renderer draws lenses itself, and not the pinholes that cover them."""
        assert self.renderer is not None, "scenes without a renderer are for maps only"
        return self.renderer.draws_lenses


class SceneCache:
    """Scenes by id.

    Args:
        places: Folders with ``*.usdz`` and scenario files (searched for files, not deeper), single
            files, recorded logs, or shipped names.
        spec: The renderer to build for a scene; None: scenes are only needed for their maps and
            paths.
        needs_map: Whether the fixer takes semantic maps.
        device: For the renderer.

    Raises:
        InputError: A place without a scene, a file that is no scene, or two scenes of one id.
    """

    def __init__(
        self,
        places: Iterable[str | Path],
        spec: RendererSpec | None,
        needs_map: bool,
        device: str = "cpu",
    ) -> None:
        self._spec = spec
        self._needs_map = needs_map
        self._session: dict[str, Any] = {"seed": 0, "device": device, "threads": None}
        self._sources: dict[str, str | Path] = {}
        self._loaded: OrderedDict[str, SceneEntry] = OrderedDict()
        self._lock = threading.Lock()
        self._loading = threading.Lock()
        for place in places:
            for source in sources_in(place):
                scene_id = (
                    usdz_scene_id(source)
                    if str(source).endswith(".usdz")
                    else load_scenario(source).scene_id
                )
                if scene_id in self._sources:
                    raise InputError(
                        f"scene {scene_id!r}: both {self._sources[scene_id]} and {source} have this id",
                        "remove one",
                    )
                self._sources[scene_id] = source

    @property
    def ids(self) -> list[str]:
        """All scene ids, sorted."""
        return sorted(self._sources)

    @property
    def loaded(self) -> list[str]:
        """Ids of the scenes that are loaded, the least recently used first."""
        return list(self._loaded)

    def get(self, scene_id: str, left: CallTime = CallTime()) -> SceneEntry:
        """Return a scene, loaded if it is not. One is loaded at a time, and whoever asks for a
        loaded one does not wait for that.

        Raises:
            UnknownScene: No scene has that id.
            InputError: It cannot be read or built.
            Late: The call's time is over.
        """
        entry = self._found(scene_id)
        if entry is not None:
            return entry
        with left.holding(self._loading):
            entry = self._found(scene_id)  # another call may have loaded it meanwhile
            if entry is None:
                entry = self._load(self._sources[scene_id])
                with self._lock:
                    self._loaded[scene_id] = entry
                    while len(self._loaded) > KEPT_SCENES:
                        self._loaded.popitem(last=False)
            return entry

    def _found(self, scene_id: str) -> SceneEntry | None:
        """Return a scene if it is loaded, which is used by that."""
        with self._lock:
            if scene_id in self._loaded:
                self._loaded.move_to_end(scene_id)
                return self._loaded[scene_id]
        if scene_id not in self._sources:
            examples = some_of(self.ids)
            raise UnknownScene(
                f"scene {scene_id!r}: it is none of the {len(self._sources)} known: {examples}",
                "add its file to --scenes",
            )
        return None

    def _load(self, source: str | Path) -> SceneEntry:
        scenario = load_scenario(source)
        renderer, references, reads_device = None, None, False
        if self._spec is not None:
            pinhole_scenario = LensCover(scenario.cameras).drawn(scenario)
            arguments = {"scenario": pinhole_scenario, "cameras": scenario.cameras}
            built = complete(build(self._spec.base, **arguments, **self._session), Renderer)
            cameras = scenario.cameras if built.draws_lenses else pinhole_scenario.cameras
            renderer = in_weather(built, pinhole_scenario, **self._session, cameras=cameras)
            settings = self._spec.fixer and self._spec.fixer.settings
            reads_device = isinstance(settings, PixelFixerSettings)
            if isinstance(settings, FixerSettings):
                recorded = renderer.recorded() if settings.references else ()
                references = session_of(settings, scenario, recorded, hysteresis=False)
        return SceneEntry(
            scenario,
            prepare_map(scenario.lane_map) if self._needs_map else None,
            renderer,
            references,
            reads_device,
        )


def sources_in(place: str | Path) -> list[str | Path]:
    """Return the scene files of a folder, or the place itself where it is a file, a recorded log or
    a shipped name.

    Raises:
        InputError: A folder without a scene.
    """
    folder = Path(place)
    if not os.path.isdir(folder):
        return [place]
    files: list[str | Path] = [
        path for path in sorted(folder.iterdir()) if path.suffix in FILES and os.path.isfile(path)
    ]
    if files:
        return files
    logs: list[str | Path] = [path for path in sorted(folder.iterdir()) if os.path.isdir(path)]
    if not logs:
        raise InputError(
            f"{place}: no {', '.join(FILES)} and no recorded log",
            "name a folder with scenes, a file or a shipped scenario",
        )
    return logs


def advertised(scenario: Scenario) -> list[sensorsim_pb2.AvailableCamerasReturn.AvailableCamera]:
    """Return a scene's cameras; a single camera also under the name that AlpaSim's presets use for
    the front one.
    """
    cameras = [wire_camera(camera) for camera in scenario.cameras]
    if cameras and all(camera.logical_id != FRONT_WIDE for camera in cameras):
        alias = sensorsim_pb2.AvailableCamerasReturn.AvailableCamera()
        alias.CopyFrom(wire_camera(front_camera(scenario)))
        alias.logical_id = alias.intrinsics.logical_id = FRONT_WIDE
        cameras.append(alias)
    return cameras


def front_camera(scenario: Scenario) -> CameraSpec:
    """Return the camera that AlpaSim's presets mean by their name of the front one: ``front``, else
    the first.
    """
    named = (camera for camera in scenario.cameras if camera.name == "front")
    return next(named, scenario.cameras[0])


def scene_camera(scenario: Scenario, logical_id: str) -> CameraSpec | None:
    """Return the camera of a scene that a caller names, which may be by the name that `advertised`
    adds; None where it is a camera of the caller's own.
    """
    for camera in scenario.cameras:
        if camera.name == logical_id:
            return camera
    return front_camera(scenario) if logical_id == FRONT_WIDE and scenario.cameras else None
