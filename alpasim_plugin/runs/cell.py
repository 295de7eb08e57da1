"""One cell of a run: build its parts, drive, score, write. Runs in a worker process."""

import errno
import json
import os
import shutil
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2

from alpasim_plugin.control import Controller
from alpasim_plugin.core.errors import (
    FaultOfPart,
    InfrastructureError,
    InputError,
    PolicyError,
    RendererFault,
    SimrunError,
    is_interruption,
)
from alpasim_plugin.core.files import content_of, places, real, some_of
from alpasim_plugin.core.files.atomic import disk_error
from alpasim_plugin.core.files.inputs import ABSENT, Inputs, remembered
from alpasim_plugin.core.files.stage import announce
from alpasim_plugin.core.interfaces import Policy, Renderer
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.core.parts import PartSpec, RendererSpec, build, complete
from alpasim_plugin.core.parts.blame import last_called
from alpasim_plugin.core.parts.patches import replaced_code
from alpasim_plugin.core.parts.spec import short_digest
from alpasim_plugin.core.subprocesses import parts_print_to_stderr
from alpasim_plugin.core.types import Frame, RenderRequest, Scenario
from alpasim_plugin.log.asl import copy_log
from alpasim_plugin.log.run_folder.manifests import (
    Action,
    RolloutState,
    inspect_rollout,
    write_manifest,
)
from alpasim_plugin.log.run_folder.records import Manifest, RolloutError
from alpasim_plugin.log.run_folder.schema import (
    DEBUG_NAME,
    DERIVED,
    DRIVEN,
    FRAMES_NAME,
    LOG_NAME,
    MANIFEST,
    OUTPUT_NAME,
    SAME_POSES,
    VIDEO_NAME,
    WHY_NAME,
)
from alpasim_plugin.log.run_folder.writer import copy_steps, write_steps
from alpasim_plugin.log.schema import session_uuid
from alpasim_plugin.runs.changes import changed_inputs
from alpasim_plugin.runs.film import write_film
from alpasim_plugin.runs.guards import calling
from alpasim_plugin.runs.plan import Cell, RunOptions, as_driven
from alpasim_plugin.runs.recorder import Recorder
from alpasim_plugin.runs.renderer import make_renderer
from alpasim_plugin.runs.rollout import run_rollout
from alpasim_plugin.runs.scoring import score_log
from scenarios.load import load_scenario
from scenarios.suite import ScenarioRef


@dataclass(frozen=True)
class RolloutParts:
    """The parts of one rollout.

    Attributes:
        session: Identifies the rollout in its log; equal rollouts have equal ids.
        names: Name of each service, for the log's header.
        controller: Moves the ego.
        digests: Digest of each service that has one, for the log's header.
    """

    renderer: Renderer
    policy: Policy
    session: str
    names: Mapping[str, str]
    controller: Controller
    digests: Mapping[str, str] = field(default_factory=dict)


PartsBuilder = Callable[[Cell, RunOptions, Scenario, int], RolloutParts]


class NotAsked(Renderer):
    """Stand in for the renderer of a policy without a camera: no image changes its rollout."""

    def render(self, request: RenderRequest) -> Frame:
        """Refuse."""
        raise AssertionError("a renderer that was not built is asked for a frame")


def build_parts(
    cell: Cell, options: RunOptions, scenario: Scenario, threads: int, is_shown: bool = False
) -> RolloutParts:
    """Build the parts that a cell names; of a policy without a camera, whose rollout no renderer
    changes, no renderer unless ``is_shown``.
    """
    policy = build(cell.policy, scenario=scenario)
    renderer: Renderer = NotAsked()
    if is_shown or complete(policy, Policy).sensors:
        renderer = make_renderer(cell.renderer, scenario, cell.seed, options.device, threads)
    return RolloutParts(
        renderer,
        policy,
        cell.rollout_key,
        {"sensorsim": _service_name(cell.renderer), "egodriver": cell.policy.name},
        build(cell.controller, vehicle=scenario.vehicle, scene_id=scenario.scene_id),
        _digests_of(cell),
    )


def _digests_of(cell: Cell) -> dict[str, str]:
    """Return the digests of a cell's renderer and policy, without those that have none."""
    sha256 = {"sensorsim": cell.renderer.digest, "egodriver": cell.policy.digest}
    return {service: short_digest(text) for service, text in sha256.items() if text is not None}


def _service_name(renderer: RendererSpec) -> str:
    """Return what a log calls a renderer."""
    fixer = renderer.fixer
    return renderer.name if fixer is None else f"{renderer.name} ({fixer.label})"


def run_cell(
    cell: Cell,
    options: RunOptions,
    root: Path,
    threads: int,
    builder: PartsBuilder = build_parts,
    load: Callable[[ScenarioRef], Scenario] | None = None,
) -> Manifest:
    """Run and score one cell and return its manifest. The manifest is written last: a folder
    without one is unfinished.

    A failure is a result too: the manifest then has ``status: failed``, the error and the
    traceback.

    Args:
        cell: The rollout.
        options: Of the run.
        root: The run folder.
        threads: Of the rollout.
        builder: Makes the parts.
        load: Gives the scenario; None reads it from its file.
    """
    folder = root / cell.folder
    with _writing_manifest(cell, options, folder) as draft:
        planned = _scenario(cell) if load is None else load(cell.ref)
        scenario = as_driven(planned, options.preset)
        with (
            parts_print_to_stderr(folder / OUTPUT_NAME),
            _same_folder(),
            _stating_inputs(draft, cell, scenario, root),
        ):
            parts = builder(cell, options, scenario, threads)
            announce(f"first frame of {cell.renderer.name}, which compiles kernels once")
            recorder = _drive(parts, cell, options, scenario, folder)
        require_same_code()
        draft.add(**recorder.facts())
        draft.add(**_facts_of(parts, has_fixer=cell.renderer.fixer is not None))
        draft.manifest = _scored(draft.manifest, root, cell, options, scenario)
        require_same_code()
        if _wants_film(options.video, draft.manifest):
            recorder.film.save(folder)
            if not draft.manifest.has_camera:
                _render_film(cell, options, scenario, folder, threads)
    return draft.manifest


def _parts_of_drive(cell: Cell) -> list[PartSpec]:
    """Return the parts that drive a rollout."""
    parts = (cell.renderer.base, cell.renderer.fixer, cell.policy, cell.controller)
    return [part for part in parts if part is not None]


def _beside_plan(
    inputs: Inputs, parts: Sequence[PartSpec], scenario: Scenario, root: Path
) -> tuple[dict[str, str], tuple[str, ...]]:
    """Return what parts read, or may remember, that no key holds, by path: a later command reuses what
    they made only while these files are as they were. Return also which files that they read, or
    declare, are others now: whoever rewrites its own file makes another result each time.

    What lies in the cache or in the run folder is no input, nor is a file that was removed since: a
    temporary one. A file that was edited since counts as it was read.
    """
    code = [path for part in parts for path in part.code]
    declared = {str(real(path)): content for part in parts for path, content in part.files.items()}
    held = {*scenario.files, *declared, *map(str, map(real, code))}
    written = [real(root), real(places.cache())]
    read = {
        path: content
        for path, content in inputs.files.items()
        if path not in held
        and not any(Path(path).is_relative_to(folder) for folder in written)
        and (content == ABSENT or content_of(path) != ABSENT)
    }
    return remembered(code, read), tuple(changed_inputs(declared | read))


def is_copied(manifest: Manifest) -> bool:
    """Tell whether the same rollout behind other renderers is a copy of this one, which their
    images could not have changed.
    """
    return manifest.ok and not manifest.has_camera


def copy_cell(
    cell: Cell, options: RunOptions, root: Path, threads: int, original: Manifest
) -> Manifest:
    """Copy the rollout of a policy without a camera into the cell of another renderer and return
    the manifest. It is neither driven nor scored again; its film is rendered.

    The log names the cell's own renderer and session: it is the log that driving would have made.

    Args:
        cell: The copy.
        options: Of the run.
        root: The run folder.
        threads: Of the film.
        original: Manifest of the rollout that was driven; see `is_copied`.
    """
    folder = root / cell.folder
    source = root / original.path
    with _writing_manifest(cell, options, folder) as draft:
        session = session_uuid(cell.seed, cell.rollout_key)
        copy_log(
            source / LOG_NAME,
            folder / LOG_NAME,
            session,
            renderer=_service_name(cell.renderer),
            renderer_digest=_digests_of(cell).get("sensorsim", ""),
        )
        for file in (FRAMES_NAME, DEBUG_NAME, OUTPUT_NAME):
            if os.path.exists(source / file):
                shutil.copyfile(source / file, folder / file)
        copy_steps(source, folder, cell.renderer.name)
        draft.manifest = replace(
            original,
            **_begun_members(cell),
            preset=options.preset,
            stops_at_path_end=cell.stops_at_path_end,
            most_steps=cell.most_steps,
            video=options.video,
            copied_from=original.path,
            session_uuid=session,
            stage_ms={},
            reused=None,
        )
        if _wants_film(options.video, draft.manifest):
            with parts_print_to_stderr(folder / OUTPUT_NAME):
                _render_film(cell, options, _scenario(cell), folder, threads)
    return draft.manifest


@dataclass
class _Draft:
    """The manifest of a rollout while it is made."""

    manifest: Manifest

    def add(self, **members: Any) -> None:
        """Set members."""
        self.manifest = replace(self.manifest, **members)


@contextmanager
def _stating_inputs(draft: _Draft, cell: Cell, scenario: Scenario, root: Path) -> Iterator[None]:
    """Enter into a manifest what its rollout reads in the block, however that ends: a failure is that
    of the files too.
    """
    inputs = Inputs()
    try:
        with inputs:
            yield
    finally:
        parts = _parts_of_drive(cell)
        read, rewritten = _beside_plan(inputs, parts, scenario, root)
        draft.add(inputs=read, rewritten=rewritten)


@contextmanager
def _writing_manifest(cell: Cell, options: RunOptions, folder: Path) -> Iterator[_Draft]:
    """Clear the folder of a rollout, yield the draft of its manifest, and write it after the block;
    what the block raises becomes the rollout's failure.
    """
    began = time.perf_counter()
    # OpenCV's pool is outside the thread budget, and frames are too small to gain from it.
    cv2.setNumThreads(1)
    draft = _Draft(_begun(cell))
    draft.add(
        preset=options.preset,
        stops_at_path_end=cell.stops_at_path_end,
        most_steps=cell.most_steps,
        video=options.video,
    )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # The manifest first: without it nothing is trusted.
        for name in (MANIFEST, *DRIVEN, *DERIVED, SAME_POSES, WHY_NAME):
            (folder / name).unlink(missing_ok=True)
        yield draft
        draft.add(status="ok")
    except BaseException as error:
        if is_interruption(error):
            raise
        # A film that failed leaves a rollout without values.
        draft.add(status="failed", metrics={}, **_failure(error, folder))
        _log_traceback(error, folder)
    draft.add(wall_s=round(time.perf_counter() - began, 4))
    write_manifest(folder, draft.manifest)


@contextmanager
def _same_folder() -> Iterator[None]:
    """Return to the working folder after the block: a part may have left it."""
    folder = os.getcwd()
    try:
        yield
    finally:
        os.chdir(folder)


def _wants_film(video: str, manifest: Manifest) -> bool:
    return video == "all" or (video == "failures" and bool(manifest.events))


def _render_film(
    cell: Cell, options: RunOptions, scenario: Scenario, folder: Path, threads: int
) -> None:
    renderer = make_renderer(cell.renderer, scenario, cell.seed, options.device, threads)
    write_film(folder, scenario, renderer)


def _begun(cell: Cell) -> Manifest:
    """Return what the manifest of a rollout begins with: until it ends, it has failed."""
    return Manifest(**_begun_members(cell), status="failed", wall_s=None)


def _begun_members(cell: Cell) -> JsonObject:
    """Return the members of a manifest that the plan decides."""
    return {
        **cell.names,
        "path": cell.folder.as_posix(),
        "rollout_key": cell.rollout_key,
        "made_of": dict(cell.made_of),
        "score_key": cell.score_key,
    }


def _drive(
    parts: RolloutParts, cell: Cell, options: RunOptions, scenario: Scenario, folder: Path
) -> Recorder:
    """Drive a rollout and close its parts, however it ends."""
    recorder = Recorder(
        scenario,
        cell.seed,
        folder,
        parts.session,
        options.images,
        options.video != "none",
        parts.names,
        parts.digests,
    )
    policy = complete(parts.policy, Policy)
    controller = complete(parts.controller, Controller)
    with recorder, _closing(policy), _closing(controller):
        run_rollout(scenario, parts.renderer, policy, cell.seed, recorder, controller)
    return recorder


def _facts_of(parts: RolloutParts, has_fixer: bool) -> JsonObject:
    """Return what renderer and policy say of the rollout; a renderer with a fixer speaks for the
    fixer.
    """
    with calling(parts.renderer, "facts", RendererFault):
        rendered = stored(complete(parts.renderer, Renderer).facts())
    with calling(parts.policy, "facts", PolicyError):
        driven = stored(complete(parts.policy, Policy).facts())
    has_camera = bool(complete(parts.policy, Policy).sensors)
    facts: JsonObject = {"fixer": rendered if has_fixer else {}, "has_camera": has_camera}
    if rendered and not has_fixer:
        facts["renderer_facts"] = rendered
    if driven:
        facts["policy_facts"] = driven
    return facts


def stored(facts: Mapping[str, Any]) -> JsonObject:
    """Return what a part says of itself, as JSON holds it; raises where it does not."""
    values: JsonObject = json.loads(json.dumps(dict(facts)))
    return values


def require_same_code() -> None:
    """Refuse a rollout in which a part of the user's has replaced code of a library or of simrun.

    Raises:
        SimrunError: Of the part that was called last.
    """
    culprit = last_called()
    replaced = "" if culprit is None else replaced_code()
    if culprit is not None and replaced:
        raise culprit.error(f"{replaced} was replaced by a part of this rollout")


def _failure(error: BaseException, folder: Path) -> JsonObject:
    """Return what the manifest says of a rollout that failed; called where the error is handled."""
    facts: JsonObject = {"traceback": traceback.format_exc()}
    culprit = last_called()
    if isinstance(error, OSError) and error.errno == errno.EBADF and culprit is not None:
        error = culprit.error("it closed files of its process")
    elif isinstance(error, OSError):
        error = disk_error(folder, error)
    elif not isinstance(error, SimrunError):
        try:
            require_same_code()
        except SimrunError as fault:
            error = fault
    if isinstance(error, SimrunError):
        facts["final"] = isinstance(error, FaultOfPart) and error.is_final
        return facts | {"error": error_of(error)}
    return facts | {
        "error": RolloutError(
            message=f"{type(error).__name__}: {error}",
            hint="Read the traceback in the manifest and report it.",
            failure_class="infrastructure",
        )
    }


def error_of(error: SimrunError) -> RolloutError:
    """Return what a manifest says of an error."""
    return RolloutError(**error.as_dict())


def _log_traceback(error: BaseException, folder: Path) -> None:
    """Add the traceback of what failed first to the log of the rollout, which the terminal names;
    not of an error of ours, whose text says all.
    """
    cause = error
    while cause.__cause__ is not None:
        cause = cause.__cause__
    if isinstance(cause, SimrunError):
        return
    text = "".join(traceback.format_exception(cause))
    # the disk may be what failed; the manifest has it too
    with (
        suppress(OSError),
        (folder / OUTPUT_NAME).open("a", encoding="utf-8") as log,
    ):
        log.write(text)


def users_parts(cell: Cell) -> str:
    """Name the parts of the user's that a rollout calls; empty where all are simrun's."""
    renderer = cell.renderer
    called = [cell.policy, cell.controller, renderer.base, renderer.fixer]
    names = [part.name for part in called if part is not None and part.is_users]
    if any(part.is_users for part in cell.evaluators):
        names.append(cell.folder.as_posix())  # an evaluator must change no other rollout
    return ", ".join(names)


def failed_manifest(cell: Cell, error: SimrunError) -> Manifest:
    """Return the manifest of a rollout that was never driven to its end."""
    return replace(_begun(cell), error=error_of(error))


def rescore_cell(cell: Cell, options: RunOptions, root: Path, manifest: Manifest) -> Manifest:
    """Score a finished rollout again from its log: another preset, changed evaluators or a file that
    one of them read, or a damaged table; return the new manifest.
    """
    manifest = _scored(manifest, root, cell, options, _scenario(cell))
    manifest = replace(manifest, score_key=cell.score_key, preset=options.preset)
    write_manifest(root / cell.folder, manifest)
    return manifest


def find_rollout_state(
    cell: Cell,
    root: Path,
    reuse_undigested: bool = False,
    video: str = "none",
) -> tuple[Action, RolloutState]:
    """Return what a cell needs, and the rollout as it is found on disk.

    A rollout with another content key is driven again; so is one that read a file beside it which is
    another one now (an evaluator's file: scored again), one with a part that has no digest unless ``reuse_undigested`` is set, and a
    failed one, except where the code of a part alone is at fault: the same code would fail again.
    What a remote part did wrong is never kept. One that was driven without the
    ``video`` that is asked for now is driven again as well.
    """
    state = inspect_rollout(root, cell.folder.as_posix())
    manifest = state.manifest
    if manifest is None or manifest.rollout_key != cell.rollout_key:
        return "drive", state
    if not manifest.ok and (cell.undigested or not manifest.final):
        return "drive", state
    if changed_inputs(manifest.inputs):
        return "drive", state
    if cell.undigested and not reuse_undigested:
        return "drive", state
    if not _ended_so(cell, manifest):
        return "drive", state
    if not manifest.ok:
        return "none", state
    is_filmed = VIDEO_NAME in manifest.files or manifest.video == video
    if _wants_film(video, manifest) and not is_filmed:
        return "drive", state
    if state.action == "none" and not _is_scored_so(cell, manifest, reuse_undigested):
        return "score", state
    return state.action, state


def _ended_so(cell: Cell, manifest: Manifest) -> bool:
    """Tell whether a rollout ended where its cell would end: presets differ in whether they stop at the
    end of the path, and in the time that they give in a scene with a goal.
    """
    stops_alike = manifest.stops_at_path_end == cell.stops_at_path_end
    if stops_alike and manifest.most_steps == cell.most_steps:
        return True
    if not manifest.ok or manifest.steps is None or cell.most_steps is None:
        return False  # what failed may have failed in time that the cell does not give
    if manifest.passed_path_end:
        return stops_alike and manifest.steps <= cell.most_steps
    return manifest.steps == cell.most_steps


def _is_scored_so(cell: Cell, manifest: Manifest, reuse_undigested: bool) -> bool:
    """Tell whether the scores of a rollout are those that its cell asks for."""
    if manifest.score_key != cell.score_key or changed_inputs(manifest.score_inputs):
        return False
    return reuse_undigested or all(part.digest is not None for part in cell.evaluators)


def kept_failure(cell: Cell, manifest: Manifest) -> str:
    """Say that a failure is kept, and what would drive the rollout again."""
    parts = [cell.policy, cell.renderer.base, cell.renderer.fixer]
    files = [path for part in parts if part is not None for path in (*part.code, *part.files)]
    files += manifest.inputs
    edit = f"an edit of {some_of(files)}" if files else "another version of simrun"
    return (
        f"{cell.folder.as_posix()}: failed before with this code and these files, not driven again; "
        f"{edit} drives it again, and so does removing {manifest.path}"
    )


def _scored(
    manifest: Manifest, root: Path, cell: Cell, options: RunOptions, scenario: Scenario
) -> Manifest:
    """Score a log, write its steps, and return the manifest with its scores."""
    folder = root / cell.folder
    with Inputs() as inputs:
        rows, scores = score_log(
            folder / LOG_NAME, folder / FRAMES_NAME, scenario, options.preset, cell.evaluators
        )
    write_steps(folder, [cell.names | row for row in rows])
    read, rewritten = _beside_plan(inputs, cell.evaluators, scenario, root)
    return replace(
        scores.stated_in(manifest),
        score_inputs=read,
        rewritten=tuple(dict.fromkeys((*manifest.rewritten, *rewritten))),
    )


@contextmanager
def _closing(part: Policy | Controller) -> Iterator[None]:
    """Close a part after its rollout."""
    kind = PolicyError if isinstance(part, Policy) else InputError
    try:
        yield
    except BaseException:
        with suppress(SimrunError), calling(part, "close", kind):
            part.close()  # what failed first is the rollout's failure
        raise
    with calling(part, "close", kind):
        part.close()


def _scenario(cell: Cell) -> Scenario:
    """Return the scene of a rollout, as it was planned.

    Raises:
        InfrastructureError: The scenario file, or a file that it names, was changed since.
    """
    scenario = _kept_scenario(cell.ref, cell.content_hash)
    if scenario.content_hash != cell.content_hash:
        _kept_scenario.cache_clear()
        raise InfrastructureError(
            f"{cell.ref.path}: the scene is not the one that was planned: a file of it was changed",
            "give the same command again: it drives the scene as it is now",
        )
    return scenario


@lru_cache(maxsize=4)
def _kept_scenario(ref: ScenarioRef, content_hash: str) -> Scenario:
    """Return a scene, read once for each content."""
    return load_scenario(ref.path, ref.seed, ref.overrides, ref.source)
