"""The stages of the comparison: scenes, pairs, networks, quality, and the closed loop."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import file_sha256
from alpasim_plugin.core.parts import resolve
from alpasim_plugin.core.parts.source import package_digest
from alpasim_plugin.lab.bench.quality import VERSION, metric_digests
from alpasim_plugin.lab.paper.config import RAW, PaperConfig, SceneSet, system_of
from alpasim_plugin.lab.paper.stages import Stage
from alpasim_plugin.lab.training.recipes.ablation import BASE, BASE_BI
from alpasim_plugin.lab.training.recipes.recipe import INIT, INIT_BI, Recipe
from alpasim_plugin.lab.training.recipes.registry import recipe_of

BUNDLE = "fixer.safetensors"
PAIRS_TRAIN = "pairs-train"
PAIRS_TEST = "pairs-test"
AUTOENCODER = "autoencoder"
DRIVE = "drive"
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
    """How the commands are run; the results do not depend on it.

    Attributes:
        device: Where networks compute.
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


@dataclass(frozen=True)
class Network:
    """Where a system's weights come from.

    Attributes:
        path: The bundle, or a placeholder for the folder of the stage that trains it and its name.
        reads: That stage; none where the weights are given.
        digests: SHA-256 of given weights by system.
    """

    path: str
    reads: tuple[str, ...] = ()
    digests: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))


def network_of(system: str, kept: Path | None) -> Network:
    """Return a system's weights: those of the stage that trains it, or kept ones.

    Args:
        system: The recipe.
        kept: Folder of `keep_weights`; None: the system is trained.

    Raises:
        InputError: The folder does not have them.
    """
    if kept is None:
        name = train_name(system)
        return Network(f"{{{name}}}/{BUNDLE}", (name,))
    path = kept / f"{system}.safetensors"
    if not path.is_file():
        raise InputError(
            f"--weights {kept}: no {path.name}",
            "Name a folder that --keep-weights has filled with the same configuration.",
        )
    return Network(str(path), digests={system: file_sha256(path)})


def comparison(
    config: PaperConfig, weights: Path | None, effort: Effort, kept: Path | None = None
) -> list[Stage]:
    """Return the stages, each after those that it reads.

    Args:
        config: What is compared, at which budget.
        weights: Folder of the metrics' weights.
        effort: How the commands are run.
        kept: Folder of trained systems, which are then not trained; None: all are.

    Raises:
        InputError: The folder lacks a system.
    """
    stages = [] if kept is not None else _trainings(config, effort)
    stages += _pairs(PAIRS_TEST, config.test, effort)
    for label in config.labels:
        network = Network("") if label == RAW else network_of(system_of(label), kept)
        stages.append(_quality(label, config, network, weights, effort))
    if config.drive is not None:
        stages += _drives(config, effort, kept)
    return stages


def _trainings(config: PaperConfig, effort: Effort) -> list[Stage]:
    """Return the stages that end with the weights of all systems."""
    stages = [*_pairs(PAIRS_TRAIN, config.train, effort), _autoencoder(config, effort)]
    systems = systems_of(config)
    needed = {source for system in systems for source in _inits(recipe_of(system))}
    for base, source in ((BASE, INIT), (BASE_BI, INIT_BI)):
        if source in needed:
            stages.append(_base(base, config, effort))
    return stages + [_system(system, config, effort) for system in systems]


def systems_of(config: PaperConfig) -> list[str]:
    """Return the recipes to train, each after those whose weights it shares."""
    rows = [*config.systems, *config.ablation]
    if config.drive is not None:
        rows += [row for row in config.drive.renderers if row != RAW]
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
    )


def _quality(
    label: str, config: PaperConfig, network: Network, weights: Path | None, effort: Effort
) -> Stage:
    fixer = label if label == RAW else f"{label}={network.path}"
    words = ["bench", "quality", f"{{{PAIRS_TEST}}}", "--split", config.test.split]
    words += ["--fixer", fixer, "--baseline", label, "--frames", str(config.frames)]
    words += ["--pictures", "0", "--out", "{out}"]
    if steps := label.partition("@")[2]:
        words += ["--set", f"{label}:fixer.steps={steps}"]
    extra = ["--jobs", str(effort.jobs), "--device", effort.device]
    if weights is not None:
        extra += ["--metric-weights", str(weights)]
    return Stage(
        quality_name(label),
        tuple(words),
        (PAIRS_TEST, *network.reads),
        {
            "version": VERSION,
            "networks": metric_digests(weights),
            "weights": dict(network.digests),
        },
        tuple(extra),
        f"{config.test.scenes} clips of up to {config.frames} frames",
    )


def _drives(config: PaperConfig, effort: Effort, kept: Path | None) -> list[Stage]:
    drive = config.drive
    assert drive is not None
    sets = {f"scenes-{DRIVE}-{i}": scenes for i, scenes in enumerate(drive.scenes)}
    rows = [row for row in drive.renderers if row != RAW]
    networks = {row: network_of(system_of(row), kept) for row in rows}
    renderers = [_renderer(row, networks[row]) for row in rows]
    words = ["run", "--renderer", ",".join([RAW, *renderers])]
    words += ["--baseline", RAW, "--policy", drive.policy, "--seeds", str(drive.seeds)]
    words += ["--preset", drive.preset, "--images", "none", "--out", f"{{out}}/{RUN}"]
    words += [f"{{{name}}}/{scenes.split}" for name, scenes in sets.items()]
    count = sum(scenes.scenes for scenes in drive.scenes)
    run = Stage(
        DRIVE,
        tuple(words),
        (*sets, *dict.fromkeys(name for network in networks.values() for name in network.reads)),
        {
            "program": package_digest(),  # a run reuses no rollout of another program either
            "policy": resolve("policy", drive.policy).digest,
            "weights": {row: dict(network.digests) for row, network in networks.items()},
        },
        ("--workers", str(effort.jobs), "--device", effort.device),
        f"{len(rows) + 1} renderers, {count} scenes, {drive.seeds} seeds",
    )
    return [*(_scenes(name, scenes) for name, scenes in sets.items()), run]


def drive_rows(config: PaperConfig) -> list[str]:
    """Return the rows of the closed loop in the order of the run's renderers."""
    rows = config.drive.renderers if config.drive else ()
    return [RAW, *(row for row in rows if row != RAW)]


def _renderer(row: str, network: Network) -> str:
    steps = row.partition("@")[2]
    name = recipe_of(system_of(row)).fixer + (f"@{steps}" if steps else "")
    return f"{name}[weights.bundle={network.path}]+{RAW}"


def _updates(count: int) -> str:
    return f"{count} update{'' if count == 1 else 's'}"
