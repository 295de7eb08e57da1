"""The stages of the comparison: scenes, pairs, networks, quality, and the closed loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from alpasim_plugin.core.parts import resolve
from alpasim_plugin.lab.bench.quality import VERSION, metric_digests
from alpasim_plugin.lab.paper.config import RAW, PaperConfig, SceneSet, system_of
from alpasim_plugin.lab.paper.records import QUALITY_FILE, SUMMARY_FILE
from alpasim_plugin.lab.paper.stages import Stage
from alpasim_plugin.lab.training.detectors import RECORD_FILE
from alpasim_plugin.lab.training.recipes.ablation import BASE, BASE_BI
from alpasim_plugin.lab.training.recipes.recipe import INIT, INIT_BI, Recipe
from alpasim_plugin.lab.training.recipes.registry import recipe_of
from alpasim_plugin.lab.training.vae import VAE_FILE
from alpasim_plugin.lab.video_metrics.detectors import FILES, available_detectors

BUNDLE = "fixer.safetensors"
CARD = "fixer.card.json"
PAIRS_TRAIN = "pairs-train"
PAIRS_TEST = "pairs-test"
AUTOENCODER = "autoencoder"
DRIVE = "drive"
TIMES = "times"
DETECTORS = "detectors"
TRUTH_ROWS = "truth-rows"  # folder of the experiment: rows of the clean frames, measured once
RUN = "run"  # the run folder in the stage's

# Recipe -> its stages whose weights other recipes train anyway: stage -> recipe and folder.
SHARED: Mapping[str, Mapping[str, tuple[str, str]]] = {
    "self-forcing": {"student": ("omnidreams", "")},
    "one-forcing": {"teacher": ("self-forcing", "teacher/"), "student": ("omnidreams", "")},
    "artifixer": {
        "bidirectional": ("artifixer-pre", "bidirectional/"),
        "causal": ("artifixer-pre", ""),
    },
    "harmonizer-temporal": {"harmonizer": ("harmonizer", "")},
    "harmonizer-temporal-teacher": {"harmonizer": ("harmonizer", "")},
}


@dataclass(frozen=True)
class Effort:
    """How the commands are run; beside the device, results do not depend on it.

    Attributes:
        device: Where networks compute. A training may go on on another; a measurement may not.
        threads: Torch threads of a training.
        jobs: Processes of everything else.
    """

    device: str = "cpu"
    threads: int = 1
    jobs: int = 1


def quality_name(label: str) -> str:
    """Return the stage that measures a row."""
    return f"quality-{label}"


def train_name(system: str) -> str:
    """Return the stage that trains a system."""
    return f"train-{system}"


def comparison(
    config: PaperConfig,
    weights: Path | None,
    effort: Effort,
    out: Path,
    first: Sequence[str] = (),
) -> list[Stage]:
    """Return the stages, each after those that it reads; a row is measured as soon as its system is
    trained.

    Args:
        config: What is compared, at which budget.
        weights: Folder of the metrics' weights.
        effort: How the commands are run.
        out: Folder of the experiment.
        first: Rows that are wanted before the others, in order.
    """
    rows = list(dict.fromkeys((*first, *config.labels)))
    measured = [row for row in rows if row in config.labels and row != RAW]
    stages = [*_pairs(PAIRS_TEST, config.test, effort), *_pairs(PAIRS_TRAIN, config.train, effort)]
    if trains_detectors(config, weights):
        stages.append(_detectors(config, effort))
    stages += [_quality(RAW, config, weights, effort, out), _autoencoder(config, effort)]
    for row in measured:
        stages += _not_yet(stages, _trainings(config, [row], effort))
        stages.append(_quality(row, config, weights, effort, out))
    if config.drive is not None:
        driven = [row for row in config.drive.renderers if row != RAW]
        stages += _not_yet(stages, _trainings(config, driven, effort))
        stages += _drives(config, effort)
    if config.times is not None:
        stages.append(_times(config, effort))
    return stages


def _not_yet(stages: Sequence[Stage], more: Sequence[Stage]) -> list[Stage]:
    names = {stage.name for stage in stages}
    return [stage for stage in more if stage.name not in names]


def _trainings(config: PaperConfig, rows: Sequence[str], effort: Effort) -> list[Stage]:
    """Return the stages that train the systems of rows, after pairs and autoencoder."""
    systems = systems_of(rows)
    needed = {source for system in systems for source in _inits(recipe_of(system))}
    bases = [
        _base(base, config, effort)
        for base, source in ((BASE, INIT), (BASE_BI, INIT_BI))
        if source in needed
    ]
    return bases + [_system(system, config, effort) for system in systems]


def systems_of(rows: Sequence[str]) -> list[str]:
    """Return the recipes of rows, each after those whose weights it shares."""
    systems: dict[str, None] = {}

    def add(system: str) -> None:
        for shared, _ in SHARED.get(system, {}).values():
            add(shared)
        systems.setdefault(system)

    for row in rows:
        add(system_of(row))
    return list(systems)


def _pairs(name: str, scenes: SceneSet, effort: Effort) -> list[Stage]:
    scenes_name = name.replace("pairs", "scenes")
    words = ("train", "pairs", f"{{{scenes_name}}}", "--out", "{out}", "--split", scenes.split)
    pairs = Stage(
        name,
        words,
        (scenes_name,),
        effort=("--jobs", str(effort.jobs), "--device", effort.device),
        budget=f"{scenes.scenes} scenes rendered",
    )
    return [_scenes(scenes_name, scenes), pairs]


def _scenes(name: str, scenes: SceneSet) -> Stage:
    words = ["train", "scenes", "--out", "{out}", "--split", scenes.split]
    words += ["--count", str(scenes.scenes)]
    if scenes.duration_s is not None:
        words += ["--duration-s", str(scenes.duration_s)]
    return Stage(name, tuple(words), budget=f"{scenes.scenes} scenes of {scenes.split}")


def _computed(effort: Effort) -> tuple[str, ...]:
    return ("--device", effort.device, "--threads", str(effort.threads))


def _autoencoder(config: PaperConfig, effort: Effort) -> Stage:
    training = config.training
    updates = training.autoencoder_updates
    words = ("train", "fixer", f"{{{PAIRS_TRAIN}}}", "--recipe", "vae", "--out", "{out}")
    return Stage(
        AUTOENCODER,
        (*words, "--steps", str(updates), "--seed", str(training.seed)),
        (PAIRS_TRAIN,),
        effort=_computed(effort),
        budget=_updates(updates),
        products=(VAE_FILE,),
    )


def trains_detectors(config: PaperConfig, weights: Path | None) -> bool:
    """Whether our own detectors are trained: where they have updates and the user gives none."""
    return config.training.detector_updates is not None and not available_detectors(weights)


def _detectors(config: PaperConfig, effort: Effort) -> Stage:
    training = config.training
    words = ["train", "detector", f"{{{PAIRS_TRAIN}}}", "--out", "{out}"]
    words += ["--check", f"{{{PAIRS_TEST}}}", "--check-split", config.test.split]
    words += ["--steps", str(training.detector_updates), "--seed", str(training.seed)]
    return Stage(
        DETECTORS,
        tuple(words),
        (PAIRS_TRAIN, PAIRS_TEST),
        effort=_computed(effort),
        budget=f"{training.detector_updates} updates of each",
        products=(*FILES.values(), RECORD_FILE),
    )


def _training_words(config: PaperConfig, recipe: str, updates: int) -> list[str]:
    training = config.training
    words = ["train", "fixer", f"{{{PAIRS_TRAIN}}}", "--recipe", recipe, "--out", "{out}"]
    words += ["--vae", f"{{{AUTOENCODER}}}/vae.safetensors", "--size", training.size]
    options = {
        "steps": updates,
        "clips": training.clips,
        "accumulate": training.accumulate,
        "latents": training.latents,
        "stride": training.stride,
        "lr": training.lr,
        "ema": training.ema,
        "precision": training.precision,
        "seed": training.seed,
        **({} if training.columns is None else {"columns": training.columns}),
    }
    for name, value in options.items():
        words += [f"--{name}", str(value)]
    return words


def _base(name: str, config: PaperConfig, effort: Effort) -> Stage:
    updates = config.training.base_updates
    return Stage(
        name,
        tuple(_training_words(config, name, updates)),
        (PAIRS_TRAIN, AUTOENCODER),
        effort=_computed(effort),
        budget=_updates(updates),
        products=(BUNDLE, CARD),
    )


def _inits(recipe: Recipe) -> set[str]:
    """Return which of the common initialisations a recipe starts from."""
    shared = SHARED.get(recipe.name, {})
    trained = [stage for stage in recipe.stages if stage.name not in shared]
    return {source for stage in trained for source in stage.sources} & {INIT, INIT_BI}


def _system(system: str, config: PaperConfig, effort: Effort) -> Stage:
    recipe = recipe_of(system)
    unit = config.updates_of(system)
    words = _training_words(config, system, unit)
    reads = [PAIRS_TRAIN, AUTOENCODER]
    inits = _inits(recipe)
    if INIT in inits:
        words += ["--init", f"{{{BASE}}}/{BUNDLE}"]
        reads.append(BASE)
    if INIT_BI in inits:
        words += ["--weights", f"{INIT_BI}={{{BASE_BI}}}/{BUNDLE}"]
        reads.append(BASE_BI)
    shared = SHARED.get(system, {})
    for stage, (other, folder) in shared.items():
        words += ["--weights", f"{stage}={{{train_name(other)}}}/{folder}{BUNDLE}"]
        reads.append(train_name(other))
    updates = sum(stage.updates(unit) for stage in recipe.stages if stage.name not in shared)
    return Stage(
        train_name(system),
        tuple(words),
        tuple(dict.fromkeys(reads)),
        effort=_computed(effort),
        budget=_updates(updates),
        products=(BUNDLE, CARD, *_shared_bundles(system)),
    )


def _shared_bundles(system: str) -> list[str]:
    """Return the bundles of a system's earlier stages that other systems go on from."""
    folders = {
        folder
        for shared in SHARED.values()
        for other, folder in shared.values()
        if other == system and folder
    }
    return [f"{folder}{BUNDLE}" for folder in sorted(folders)]


def _bundle(row: str) -> str:
    """Return the placeholder of the weights of a row's system."""
    return f"{{{train_name(system_of(row))}}}/{BUNDLE}"


def _variants(rows: Sequence[str]) -> list[str]:
    """Return the options of ``bench quality`` that name rows and their steps."""
    fixers = [row if row == RAW else f"{row}={_bundle(row)}" for row in rows]
    words = ["--fixer", ",".join(fixers), "--baseline", rows[0]]
    for row in rows:
        if steps := row.partition("@")[2]:
            words += ["--set", f"{row}:fixer.steps={steps}"]
    return words


def _quality(
    row: str, config: PaperConfig, weights: Path | None, effort: Effort, out: Path
) -> Stage:
    words = ["bench", "quality", f"{{{PAIRS_TEST}}}", "--split", config.test.split]
    words += [*_variants([row]), "--frames", str(config.frames), "--pictures", "0"]
    extra = ["--jobs", str(effort.jobs), "--device", effort.device]
    extra += ["--truth-rows", str(out / TRUTH_ROWS)]
    if weights is not None:
        extra += ["--metric-weights", str(weights)]
    detectors = []
    if trains_detectors(config, weights):
        detectors.append(DETECTORS)
        words += ["--detectors", f"{{{DETECTORS}}}"]
    networks = metric_digests(weights, weights)
    return Stage(
        quality_name(row),
        (*words, "--out", "{out}"),
        (PAIRS_TEST, *detectors, *_trained([row])),
        {"version": VERSION, "networks": networks, "device": effort.device},
        tuple(extra),
        f"{config.test.scenes} clips of up to {config.frames} frames",
        (QUALITY_FILE,),
    )


def _trained(rows: Sequence[str]) -> list[str]:
    return list(dict.fromkeys(train_name(system_of(row)) for row in rows if row != RAW))


def _times(config: PaperConfig, effort: Effort) -> Stage:
    """Return the stage that measures the times of all rows side by side, one process at a time."""
    assert config.times is not None
    rows = [row for row in config.labels if row != RAW]
    words = ["bench", "quality", f"{{{PAIRS_TEST}}}", "--split", config.test.split]
    words += [*_variants(rows), "--frames", str(config.times.frames), "--pictures", "0"]
    words += ["--clips", str(config.times.scenes), "--jobs", "1", "--threads", "1"]
    return Stage(
        TIMES,
        (*words, "--out", "{out}"),
        (PAIRS_TEST, *_trained(rows)),
        {"version": VERSION, "device": effort.device},
        ("--device", effort.device),
        f"{len(rows)} rows, {config.times.scenes} clips of {config.times.frames} frames",
        (QUALITY_FILE,),
    )


def _drives(config: PaperConfig, effort: Effort) -> list[Stage]:
    drive = config.drive
    assert drive is not None
    sets = {f"scenes-{DRIVE}-{i}": scenes for i, scenes in enumerate(drive.scenes)}
    rows = [row for row in drive.renderers if row != RAW]
    words = ["run", "--renderer", ",".join([RAW, *(_renderer(row) for row in rows)])]
    words += ["--baseline", RAW, "--policy", drive.policy, "--seeds", str(drive.seeds)]
    words += ["--preset", drive.preset, "--images", "none", "--out", f"{{out}}/{RUN}"]
    words += [f"{{{name}}}/{scenes.split}" for name, scenes in sets.items()]
    count = sum(scenes.scenes for scenes in drive.scenes)
    run = Stage(
        DRIVE,
        tuple(words),
        (*sets, *_trained(rows)),
        {
            "policy": resolve("policy", drive.policy).digest,
            "device": effort.device,
        },
        ("--workers", str(effort.jobs), "--device", effort.device),
        f"{len(rows) + 1} renderers, {count} scenes, {drive.seeds} seeds",
        (f"{RUN}/{SUMMARY_FILE}",),
    )
    return [*(_scenes(name, scenes) for name, scenes in sets.items()), run]


def drive_rows(config: PaperConfig) -> list[str]:
    """Return the rows of the closed loop in the order of the run's renderers."""
    rows = config.drive.renderers if config.drive else ()
    return [RAW, *(row for row in rows if row != RAW)]


def _renderer(row: str) -> str:
    steps = row.partition("@")[2]
    name = recipe_of(system_of(row)).fixer + (f"@{steps}" if steps else "")
    return f"{name}[weights.bundle={_bundle(row)}]+{RAW}"


def _updates(count: int) -> str:
    return f"{count} update{'' if count == 1 else 's'}"
