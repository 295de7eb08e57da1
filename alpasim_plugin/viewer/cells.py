"""Which cells of a run a page replays: changed outcomes first, then events, then a few quiet ones, the most different drives first."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.flags import Flag
from alpasim_plugin.run_folder.rows import Rollout
from evaluators.metrics.outcomes import has_ended, in_words, outcomes_of
from evaluators.opening import Run
from evaluators.report.flips import Flip, baseline_of, find_flips

DOING = "choosing rollouts to watch"
QUIET_CELLS = 3  # cells in which nothing happened, shown by default

Interest = Literal["flip", "event", "failure", "quiet"]
ORDER: tuple[Interest, ...] = ("flip", "event", "failure", "quiet")


@dataclass(frozen=True)
class WatchedCell:
    """The rollouts of one scene, policy and seed, one for each renderer, which are replayed side by side.

    Attributes:
        policy: The policy; where policies stand side by side, their renderer.
        take: 0, except where several logs of one renderer have the same scene, policy and seed.
        rollouts: In the order of the run's renderers; the failed ones too.
        flips: Changed outcomes among them.
    """

    scene: str
    policy: str
    seed: int
    take: int
    rollouts: tuple[Rollout, ...]
    flips: tuple[Flip, ...]
    by_policy: bool = False  # one renderer's rollouts, one for each policy

    def side(self, rollout: Rollout) -> str:
        """Give what a rollout is called beside the others."""
        return rollout.policy if self.by_policy else rollout.renderer

    @property
    def id(self) -> str:
        """Give a name for addresses and elements: letters and digits."""
        return hashlib.sha256(repr((self.scene, self.policy, self.seed, self.take)).encode()).hexdigest()[:12]

    @property
    def name(self) -> str:
        """Give the name for people."""
        return f"{self.scene}, {self.policy}, seed {self.seed}" + (f", log {self.take + 1}" if self.take else "")

    @property
    def interest(self) -> Interest:
        """Say why somebody would look at it."""
        if self.flips:
            return "flip"
        if any(outcomes_of(rollout) for rollout in self.rollouts if rollout.ok):
            return "event"
        return "quiet" if all(rollout.ok for rollout in self.rollouts) else "failure"

    @property
    def apart_m(self) -> float:
        """Say how different the drives are: between the longest and the shortest, and the largest distance from the recorded path."""
        driven = [m for r in self.rollouts if (m := r.metrics.get("dist_traveled_m")) is not None]
        aside = [m for r in self.rollouts if (m := r.metrics.get("lateral_distance_m")) is not None]
        return max(driven, default=0.0) - min(driven, default=0.0) + max(aside, default=0.0)

    @property
    def watchable(self) -> bool:
        """Tell whether any of its rollouts ran to its end."""
        return any(rollout.ok for rollout in self.rollouts)

    def outcomes(self) -> dict[str, str]:
        """Give the outcome of each rollout in words, by what it is called."""
        failed = {self.side(r): f"failed: {r.failure_class or 'unknown'}" for r in self.rollouts if not has_ended(r)}
        return {self.side(r): failed.get(self.side(r)) or in_words(outcomes_of(r)) for r in self.rollouts}


@dataclass(frozen=True)
class Wanted:
    """What was asked for; an empty tuple is everything. A scene may be named as when it was driven: smoke/curve is smoke-curve."""

    scenes: Annotated[tuple[str, ...], Flag("Scene to show. Repeatable.", "--scene")] = ()
    policies: Annotated[tuple[str, ...], Flag("Policy to show. Repeatable.", "--policy")] = ()
    seeds: Annotated[tuple[int, ...], Flag("Seed to show. Repeatable.", "--seed")] = ()
    renderers: Annotated[tuple[str, ...], Flag("Renderer to show; all by default. Repeatable.", "--renderer")] = ()

    @property
    def is_all(self) -> bool:
        """Tell whether nothing was asked for."""
        return not (self.scenes or self.policies or self.seeds or self.renderers)


def check_wanted(run: Run, wanted: Wanted) -> None:
    """Refuse what the run neither has nor plans.

    Raises:
        InputError: Something of that kind was asked for.
    """
    for flag, asked, known in (
        ("--scene", wanted.scenes, run.scenes),
        ("--policy", wanted.policies, run.policies),
        ("--renderer", wanted.renderers, run.renderers),
        ("--seed", wanted.seeds, sorted({*(run.info.get("seeds") or ()), *(r.seed for r in run.rollouts)})),
    ):
        strange = [one for one in asked if not _spellings(one) & {*known}]
        if strange:
            found = f"the run has none; it has {', '.join(map(str, known[:8]))}"
            raise InputError(DOING, f"{flag} {strange[0]}", found, "name one of these")


def has_policies_alone(run: Run) -> bool:
    """Tell whether a run compares policies and not renderers."""
    return len(run.renderers) == 1 and len(run.policies) > 1


def cells_of(run: Run, wanted: Wanted = Wanted(), arms: bool = False) -> list[WatchedCell]:
    """List the cells of a run that were asked for, the most telling first.

    Args:
        run: The run.
        wanted: What was asked for.
        arms: Where the run has one renderer, its policies stand side by side.
    """
    by_policy = arms and has_policies_alone(run)
    grouped: dict[tuple[str, str, int, int], list[Rollout]] = {}
    base = baseline_of(run)
    rank = {name: i for i, name in enumerate(run.policies if by_policy else sorted(run.renderers, key=lambda name: name != base))}
    scene = {name: i for i, name in enumerate(run.scenes)}
    for rollout in sorted(
        run.rollouts, key=lambda r: (scene[r.scene], *((r.seed, rank[r.policy]) if by_policy else (r.policy, r.seed, rank[r.renderer])))
    ):
        if not _asked(rollout, wanted):
            continue
        key, take = (rollout.scene, rollout.renderer if by_policy else rollout.policy, rollout.seed), 0
        while any((r.renderer, r.policy) == (rollout.renderer, rollout.policy) for r in grouped.get((*key, take), ())):
            take += 1
        grouped.setdefault((*key, take), []).append(rollout)
    flips: dict[tuple[str, str, int], list[Flip]] = {}
    for flip in find_flips(run)[0]:
        inside = flip.base.renderer == flip.other.renderer if by_policy else flip.base.policy == flip.other.policy
        if inside and _asked(flip.other, wanted):  # a cell shows one policy behind all renderers, or the other way round
            fixed = flip.other.renderer if by_policy else flip.other.policy
            flips.setdefault((flip.other.scene, fixed, flip.other.seed), []).append(flip)
    cells = [WatchedCell(*key, tuple(members), tuple(flips.get(key[:3], ())), by_policy) for key, members in grouped.items()]
    return sorted(cells, key=lambda cell: (ORDER.index(cell.interest), -cell.apart_m))  # stable: equal ones stay in the run's order


def shown_by_default(cells: Sequence[WatchedCell], wanted: Wanted, at_most: int | None) -> list[WatchedCell]:
    """Return the cells that a page tries to hold: all that are telling and `QUIET_CELLS` others, or all that were asked for.

    Args:
        cells: As `cells_of` returns them.
        wanted: What was asked for.
        at_most: Most cells; None is no limit.
    """
    watchable = [cell for cell in cells if cell.watchable]
    if wanted.is_all and at_most is None:
        quiet = [cell for cell in watchable if cell.interest == "quiet"]
        dropped = {cell.id for cell in quiet[QUIET_CELLS:]}
        watchable = [cell for cell in watchable if cell.id not in dropped]
    return watchable[:at_most]


def telling(cells: Iterable[WatchedCell], kinds: Sequence[Interest] = ("flip",)) -> list[WatchedCell]:
    """Return the watchable cells of some kinds."""
    return [cell for cell in cells if cell.interest in kinds and cell.watchable]


def _asked(rollout: Rollout, wanted: Wanted) -> bool:
    pairs: tuple[tuple[object, Sequence[object]], ...] = (
        (rollout.scene, wanted.scenes),
        (rollout.policy, wanted.policies),
        (rollout.seed, wanted.seeds),
        (rollout.renderer, wanted.renderers),
    )
    return all(not asked or any(value in _spellings(one) for one in asked) for value, asked in pairs)


def _spellings(asked: object) -> set[object]:
    """Return what a name that was asked for may be in the tables."""
    return {asked, asked.replace("/", "-")} if isinstance(asked, str) else {asked}
