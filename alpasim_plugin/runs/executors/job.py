"""What a node does for a run: it drives cells in a folder of its own and gives back results."""

from __future__ import annotations

import hashlib
import pickle
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from alpasim_plugin.core.atomic import disk_error, scratch_folder
from alpasim_plugin.core.cache import cache_root, cached, share_measurements
from alpasim_plugin.core.errors import InfrastructureError, SimrunError
from alpasim_plugin.core.parts import PartSpec
from alpasim_plugin.core.types import Scenario
from alpasim_plugin.renderers.reconstruction import KIND as MODELS
from alpasim_plugin.renderers.reconstruction_key import model_key
from alpasim_plugin.runs.cell import failed_manifest, run_cell
from alpasim_plugin.runs.commits import RolloutResult, commit_key, pack, run_stored_cell
from alpasim_plugin.runs.executors.assignment import (
    Contents,
    is_here,
    measured_folder,
    paths_in,
    place,
    placed_path,
    scratch_root,
    with_paths,
)
from alpasim_plugin.runs.executors.base import Faulty, Node
from alpasim_plugin.runs.plan import Cell, RunOptions, RunPlan
from scenarios.suite import ScenarioRef

HELD_SCENES = 4  # by each worker


@dataclass(frozen=True)
class RolloutWork:
    """Drive cells of a run; pickled once per worker.

    Attributes:
        run: Token of the run.
        options: Of the run.
        threads: Of each rollout.
        scenes: Scene -> SHA-256 of the pickled scenario.
        backgrounds: Scene -> its background file (path on the driver -> SHA-256).
        models: Scene -> files of its reconstruction (name -> SHA-256), where the driver has it;
            otherwise each node fits its own.
        store: URL of a store in which rollouts are looked up and committed.
        fresh: As for `alpasim_plugin.runs.commits.commit_key`.
    """

    run: str
    options: RunOptions
    threads: int
    scenes: Mapping[str, str]
    backgrounds: Mapping[str, Mapping[str, str]]
    models: Mapping[str, Mapping[str, str]]
    store: str | None = None
    fresh: str = ""

    def __call__(self, job: Cell, node: Node) -> RolloutResult | Faulty[RolloutResult]:
        """Drive one cell; what says more of the node than of the rollout comes back as `Faulty`."""
        cell = job
        share_measurements(measured_folder(self.run))
        try:
            with scratch_folder(scratch_root() / "rollout") as scratch:
                here = self._placed(cell, node)
                self._drive(here, scratch, node)
                result = pack(scratch / cell.folder, node.name)
        except InfrastructureError as error:
            return self._faulty(cell, node, error)
        except OSError as error:
            return self._faulty(cell, node, disk_error(scratch_root(), error))
        if (
            result.manifest["status"] != "ok"
            and result.manifest["error"]["failure_class"] == InfrastructureError.failure_class
        ):
            return Faulty(result, result.manifest["error"]["message"])
        return result

    def _drive(self, cell: Cell, scratch: Path, node: Node) -> None:
        def load(ref: ScenarioRef) -> Scenario:
            return self._scenario(cell.scene, node)

        if self.store is None:
            run_cell(cell, self.options, scratch, self.threads, load=load)
        else:
            run_stored_cell(cell, self.options, scratch, self.threads, self.store, self.fresh, load)

    def key(self, cell: Cell) -> str:
        """Return the digest of everything that decides the rollout's files."""
        return commit_key(cell, self.options, self.fresh)

    def needs(self, cell: Cell) -> list[str]:
        """Return the SHA-256 of the scene, of its background and reconstruction, and of the files
        of the cell's parts.
        """
        parts = (cell.renderer.base, cell.renderer.fixer, cell.policy, cell.controller)
        files = [sha256 for part in parts if part is not None for sha256 in part.files.values()]
        return [
            self.scenes[cell.scene],
            *self.models.get(cell.scene, {}).values(),
            *self.backgrounds.get(cell.scene, {}).values(),
            *files,
        ]

    def _faulty(self, cell: Cell, node: Node, error: SimrunError) -> Faulty[RolloutResult]:
        manifest = failed_manifest(cell, error) | {"node": node.name, "files": {}}
        return Faulty(RolloutResult(manifest, {}), error.message)

    def _scenario(self, scene: str, node: Node) -> Scenario:
        """Return a scene, whose background file is one of this node."""
        scenario = _loaded(self.scenes[scene], node)
        if scenario.background is None:
            return scenario
        path = placed_path(
            scenario.background.path, self.backgrounds[scene][scenario.background.path], node
        )
        return replace(scenario, background=replace(scenario.background, path=path))

    def _placed(self, cell: Cell, node: Node) -> Cell:
        """Return a cell whose parts name files of this node, with the scene's reconstruction in
        this node's cache.
        """
        if self.models.get(cell.scene):
            place_model(self._scenario(cell.scene, node), self.models[cell.scene], node)
        base, fixer = (
            _part(cell.renderer.base, node),
            cell.renderer.fixer and _part(cell.renderer.fixer, node),
        )
        renderer = replace(cell.renderer, base=base, fixer=fixer)
        return replace(
            cell,
            renderer=renderer,
            policy=_part(cell.policy, node),
            controller=_part(cell.controller, node),
        )


_scenes: OrderedDict[str, Scenario] = OrderedDict()  # by SHA-256, as read last by this process


def _loaded(sha256: str, node: Node) -> Scenario:
    if sha256 not in _scenes:
        _scenes[sha256] = pickle.loads(place(sha256, "scenario.pickle", node).read_bytes())
        while len(_scenes) > HELD_SCENES:
            _scenes.popitem(last=False)
    return _scenes[sha256]


def _part(spec: PartSpec, node: Node) -> PartSpec:
    """Return a part whose settings name files of this node.

    Raises:
        InfrastructureError: A file that no setting names is not on this node, or has another
            content here.
    """
    if not spec.files:
        return spec
    named = paths_in(spec.settings)
    for path, sha256 in spec.files.items():
        if path not in named and not is_here(path, sha256):
            raise InfrastructureError(
                f"{path} of {spec.kind} {spec.name} on {node.name}: not there, or another content",
                "install the part's files on the nodes",
            )
    if spec.settings is None:
        return spec
    moved = {
        path: placed_path(path, sha256, node)
        for path, sha256 in spec.files.items()
        if path in named
    }
    return replace(spec, settings=with_paths(spec.settings, moved))


def place_model(scenario: Scenario, files: Mapping[str, str], node: Node) -> None:
    """Put a reconstruction into this node's cache, unless it is there; the renderer checks its
    content.
    """
    key = model_key(scenario)
    assert key is not None

    def make(folder: Path) -> None:
        for name, sha256 in files.items():
            data = node.fetch(sha256)
            if hashlib.sha256(data).hexdigest() != sha256:
                raise InfrastructureError(
                    f"reconstruction of {scenario.scene_id}: {name} is not what was sent",
                    "try again",
                )
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(data)

    cached(
        MODELS,
        key,
        make,
        lambda folder: folder,
        f"reconstruction of {scenario.scene_id} for {node.name}",
    )


def rollout_work(
    plan: RunPlan, run: str, cells: Sequence[Cell], threads: int, store: str | None, fresh: str
) -> tuple[RolloutWork, Contents]:
    """Return what the nodes need to drive cells of a plan, and the contents that they will ask for.

    Raises:
        InputError: A scenario or a part has something that cannot be sent.
    """
    contents = Contents()
    used = dict.fromkeys(cell.scene for cell in cells)
    scenes = {}
    backgrounds = {}
    models = {}
    for name in used:
        scenario = plan.scenarios[name]
        scenes[name] = contents.add_bytes(pickle.dumps(scenario))
        if scenario.background is not None:
            path = scenario.background.path
            backgrounds[name] = {path: contents.add_file(Path(path))}
        key = model_key(scenario)
        folder = cache_root() / MODELS / key if key else None
        if folder is not None and folder.is_dir():
            found = sorted(one for one in folder.rglob("*") if one.is_file())
            models[name] = {
                one.relative_to(folder).as_posix(): contents.add_file(one) for one in found
            }
    for part in plan.parts:
        for file in part.files:
            contents.add_file(Path(file))
    return RolloutWork(
        run, plan.options, threads, scenes, backgrounds, models, store, fresh
    ), contents
