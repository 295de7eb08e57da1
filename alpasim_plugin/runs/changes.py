"""Why a rollout that was driven before is driven or scored again: what of its making is another one
now, by name.
"""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence

from alpasim_plugin.core.files import content_of, real, some_of
from alpasim_plugin.core.files.inputs import ABSENT
from alpasim_plugin.core.parts import PartSpec
from alpasim_plugin.log.run_folder.records import Manifest, PartFacts, RunInfo
from alpasim_plugin.runs.plan import SIMRUN, Cell, RunPlan

OLDER = "it was driven by another version of simrun"
SHOWN_FILES = 3
REWRITTEN = (
    "was changed during the rollout that read it; what rewrites a file that it reads "
    "is made again by each command"
)


def changed_inputs(before: Mapping[str, str]) -> dict[str, str]:
    """Return the files that a rollout, or its scoring, read beside what its key holds and that are
    others now: the content at present by path.

    Args:
        before: The content that was read, by path.
    """
    now = {path: content_of(path) for path in before}
    return {path: content for path, content in now.items() if content != before[path]}


def reasons(cell: Cell, manifest: Manifest, held: RunInfo | None, plan: RunPlan) -> list[str]:
    """Say why a rollout is driven again that another command, or an earlier one, drove; nothing where
    all that it was made of is as it was.

    Args:
        cell: The rollout as it is planned now.
        manifest: Of what was driven.
        held: ``run.json`` of that time; None where it is not known.
        plan: The run.
    """
    changed = _file_changes(manifest.inputs, changed_inputs(manifest.inputs), manifest.rewritten)
    before = manifest.made_of
    if before is None:
        return [OLDER]
    now = cell.made_of
    if before.get(SIMRUN) != now[SIMRUN]:
        return [OLDER]
    for name in now:
        if name not in before:
            changed.append(f"{name} is new")
        elif before[name] != now[name]:
            files = _files_of(name, held, plan, manifest.rewritten)
            changed += files or [_other(name, cell)]
    return changed


def _other(name: str, cell: Cell) -> str:
    """Say that what a rollout was made of under a name is another one, where no file is known to be."""
    if name == f"scene {cell.scene}":
        return f"{name} is another one: its file {cell.ref.path}, or what is set in it, was changed"
    return f"{name} is another one"


def score_reasons(manifest: Manifest, held: RunInfo | None, plan: RunPlan) -> list[str]:
    """Say why a rollout is scored again whose files are whole: the arguments are those of `reasons`."""
    now = changed_inputs(manifest.score_inputs)
    changed = _file_changes(manifest.score_inputs, now, manifest.rewritten)
    if manifest.preset != plan.options.preset:
        changed.append(f"the preset was {manifest.preset}")
    stated = {} if held is None else held.parts
    evaluators = [part for part in plan.parts if part.kind == "evaluator"]
    return changed + changed_evaluators(stated, evaluators)


def changed_evaluators(
    stated: Mapping[str, PartFacts], evaluators: Sequence[PartSpec]
) -> list[str]:
    """Say what is another one in the evaluators that a ``run.json`` states in ``parts``; nothing where
    it states none.
    """
    before = {name: facts for name, facts in stated.items() if name.startswith("evaluator ")}
    if not before:
        return []
    changed = []
    names = {f"evaluator {part.name}": part for part in evaluators}
    for name, part in names.items():
        facts = before.get(name)
        if facts is None:
            changed.append(f"{name} is new")
        elif facts.digest != part.digest:
            files = _changes_of_part(facts, part)
            changed += files or [f"{name} is another one"]
    return changed + [f"{name} is left out" for name in before if name not in names]


def sentence(count: int, all_reasons: Sequence[str], action: str = "driven") -> str:
    """Say how many rollouts are driven or scored again, and why."""
    rollouts = "1 rollout is" if count == 1 else f"{count} rollouts are"
    causes = list(dict.fromkeys(all_reasons))
    return f"{rollouts} {action} again: {some_of(causes, SHOWN_FILES)}"


def _files_of(
    name: str, held: RunInfo | None, plan: RunPlan, rewritten: Collection[str]
) -> list[str]:
    """Name the files by which a scene or a part differs from what ``run.json`` states of it."""
    if held is None:
        return []
    kind, _, label = name.partition(" ")
    if kind == "scene":
        scene = held.scenes.get(label)
        return _file_changes({} if scene is None else scene.files, plan.scenarios[label].files)
    changes: list[str] = []
    for part in plan.parts:
        if not _is_part_of(f"{part.kind} {part.name}", kind, label, plan):
            continue
        stated = held.parts.get(f"{part.kind} {part.name}")
        if stated is not None:
            changes += _changes_of_part(stated, part, rewritten)
    return changes


def _changes_of_part(
    stated: PartFacts, part: PartSpec, rewritten: Collection[str] = ()
) -> list[str]:
    """Name the files by which a part differs from what ``run.json`` states of it."""
    return [
        *_file_changes(stated.code, part.code),
        *_file_changes(stated.files, part.files, rewritten),
    ]


def _is_part_of(part: str, kind: str, label: str, plan: RunPlan) -> bool:
    """Tell whether a part is what a rollout is made of under a name; a renderer has two."""
    if kind != "renderer":
        return part == f"{kind} {label}"
    spec = next(spec for spec in plan.renderers if spec.name == label)
    parts = [spec.base] if spec.fixer is None else [spec.base, spec.fixer]
    return part in {f"{part.kind} {part.name}" for part in parts}


def _file_changes(
    before: Mapping[str, str], now: Mapping[str, str], rewritten: Collection[str] = ()
) -> list[str]:
    """Name what happened to files: edited, gone, read for the first time, or changed already while they
    were read.
    """
    changes = []
    for path, content in now.items():
        if path not in before:
            changes.append(f"{path} was not read before")
        elif content == before[path]:
            continue
        elif str(real(path)) in rewritten:
            changes.append(f"{path} {REWRITTEN}")
        elif content == ABSENT:
            changes.append(f"{path} is gone")
        else:
            changes.append(f"{path} was edited")
    return changes


def rewritten_files(manifests: Sequence[Manifest]) -> dict[str, str]:
    """Return what ``run.json`` says of files that were changed while rollouts that read them were made,
    by path.
    """
    counts = Counter(path for manifest in manifests for path in manifest.rewritten)
    return {
        path: f"{'1 rollout' if count == 1 else f'{count} rollouts'}: it {REWRITTEN}"
        for path, count in counts.items()
    }
