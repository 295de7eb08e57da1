"""What a run consists of: the cells renderer x policy x scene x seed, each with a content key."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from alpasim_plugin.errors import InputError
from alpasim_plugin.renderers.reconstruction import model_key
from alpasim_plugin.runtime.compose import BASE, card_of, parse_renderer
from alpasim_plugin.types import Scenario
from evaluators import EVALUATORS_VERSION
from policies.base import loaded_by
from scenarios.load import load_scenario
from scenarios.suite import ScenarioRef

if TYPE_CHECKING:
    from alpasim_plugin.fixers.card import Card

SLUG_LENGTH = 80
LOG_VERSION = 1  # raise when a rollout made by an older version must not be reused


@dataclass(frozen=True)
class RunOptions:
    """Everything but the cells that shapes a run's results."""

    preset: str = "paper"
    images: Literal["none", "jpeg", "png"] = "jpeg"  # camera frames in rollout.asl
    video: Literal["none", "failures", "all"] = "none"
    device: Literal["cpu", "cuda"] = "cpu"
    baseline: str | None = None
    fixer: tuple[str, ...] = ()  # KEY=VALUE of the fixers' settings


@dataclass(frozen=True)
class Cell:
    """One rollout to run."""

    renderer: str
    policy: str
    scene: str  # scene id
    seed: int
    ref: ScenarioRef
    rollout_key: str  # content of everything that shapes the log
    score_key: str  # rollout_key plus what shapes the scores

    @property
    def folder(self) -> Path:
        """Give the rollout's folder below the run folder."""
        return Path("rollouts", slug(self.renderer), slug(self.policy), slug(self.scene), str(self.seed))


@dataclass(frozen=True)
class RunPlan:
    """A resolved run."""

    cells: tuple[Cell, ...]
    scenarios: dict[str, Scenario]
    renderers: tuple[str, ...]
    policies: tuple[str, ...]
    seeds: tuple[int, ...]
    options: RunOptions
    cards: Mapping[str, Card] = field(default_factory=dict)  # renderer -> the fixer in its name

    @property
    def key(self) -> str:
        """Give a short hash of all rollouts and options: the same command has the same key, however its logs are scored by now."""
        return digest([[cell.rollout_key for cell in self.cells], asdict(self.options)])[:12]


def make_plan(
    refs: Sequence[ScenarioRef],
    renderers: Sequence[str],
    policies: Sequence[str],
    seeds: Sequence[int],
    options: RunOptions,
) -> RunPlan:
    """Load every scenario and lay out the cells, scene by scene so that workers reuse what they built.

    Raises:
        InputError: A scenario is bad, two scenarios share an id, or a name is given twice.
    """
    for what, values in (("renderer", renderers), ("policy", policies), ("seed", seeds)):
        twice = sorted({str(value) for value in values if list(values).count(value) > 1})
        if not values or twice:
            found = f"{', '.join(twice)} twice" if twice else "none"
            raise InputError("planning a run", f"{what}s {', '.join(map(str, values)) or '(none)'}", found, f"name every {what} once")
    same = [str(parse_renderer(name)) for name in renderers]
    if len(set(same)) != len(same):
        raise InputError("planning a run", f"renderers {list(renderers)}", f"they stand for {same}", "name every renderer once")
    cards = {name: card for name in renderers if (card := card_of(name, options.fixer)) is not None}
    if options.fixer and not cards:
        found = f"no fixer among the renderers {list(renderers)}"
        raise InputError("planning a run", f"--set fixer.{options.fixer[0]}", found, "leave it out, or name a fixer")
    scenarios: dict[str, Scenario] = {}
    origin: dict[str, ScenarioRef] = {}
    for ref in refs:
        scenario = load_scenario(ref.path, ref.seed, ref.overrides)
        other = origin.get(scenario.scene_id)
        if other is not None:
            raise InputError(
                "planning a run",
                f"{ref.path} and {other.path}",
                f"both have the scene id {scenario.scene_id!r}",
                "give one of them another id, or name it once",
            )
        scenarios[scenario.scene_id], origin[scenario.scene_id] = scenario, ref
    contents = {policy: loaded_by(policy) for policy in policies}
    models = {scene_id: model_key(scenario) for scene_id, scenario in scenarios.items()}  # what 3dgs shows, where it is fitted
    cells = []
    for scene_id, scenario in scenarios.items():
        for renderer in renderers:
            for policy in policies:
                for seed in seeds:
                    shaped_by = [LOG_VERSION, scenario.content_hash, renderer, policy, seed, options.images, options.device]
                    shaped_by += [model] if (model := models[scene_id]) and parse_renderer(renderer).base == BASE else []
                    shaped_by += [content] if (content := contents[policy]) else []
                    rollout_key = digest([*shaped_by, cards[renderer].content()] if renderer in cards else shaped_by)
                    keys = rollout_key, score_key(rollout_key, options.preset)
                    cells.append(Cell(renderer, policy, scene_id, seed, origin[scene_id], *keys))
    return RunPlan(tuple(cells), scenarios, tuple(renderers), tuple(policies), tuple(seeds), options, cards)


def score_key(rollout_key: str, preset: str) -> str:
    """Return the content key of a rollout's scores: another preset or other evaluators give another one."""
    return digest([rollout_key, preset, EVALUATORS_VERSION])


def digest(value: object) -> str:
    """Return a SHA-256 over the canonical JSON of a value."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()


def slug(name: str) -> str:
    """Return a name that is safe as one folder; different names have different slugs.

    Example:
        >>> slug("onefixer@1"), slug("nre://host:50051")
        ('onefixer@1', 'nre-host-50051-9d6a75a3')
    """
    safe = re.sub(r"[^A-Za-z0-9._@+-]+", "-", name).strip("-.")[:SLUG_LENGTH]
    return name if safe == name and safe else f"{safe}-{digest(name)[:8]}"
