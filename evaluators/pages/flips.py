"""The rollouts whose outcome differs from the baseline's, with both images when the plans part."""

import base64
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from alpasim_plugin.core.files import inside, parsing, read_bytes
from alpasim_plugin.core.files.limits import SOURCE_BYTES
from alpasim_plugin.core.json_types import JsonView
from alpasim_plugin.log.run_folder.reader import read_json
from alpasim_plugin.log.run_folder.rows import Rollout
from alpasim_plugin.log.run_folder.schema import AGAIN, VIDEO_NAME
from evaluators.metrics.outcomes import has_ended, in_words, outcomes_of
from evaluators.statistics.opening import Run
from evaluators.statistics.variants import Base, Variant, axis_bases

FLIPS_NAME = "flips.json"
MAX_FLIP_ROWS = 400
TOO_MANY = "left out to keep this file small; they are in flips/"
# renderer, policy, scene, seed, log of the other side; RENDERER/POLICY of the baseline's
FlipKey = tuple[str, str, str, int, str, str]


def colours_of(run: Run) -> dict[tuple[str, str], tuple[int, int]]:
    """Return (renderer, policy) -> (colour, dash): a colour for each renderer, or for each policy
    where there is one renderer.
    """
    if len(run.renderers) == 1:
        return {(run.renderers[0], policy): (i, 0) for i, policy in enumerate(run.policies)}
    return {
        (renderer, policy): (i, j)
        for i, renderer in enumerate(run.renderers)
        for j, policy in enumerate(run.policies)
    }


@dataclass(frozen=True)
class Flip:
    """One scene and seed that end differently in two variants.

    Attributes:
        base, other: The rollouts of the baseline and of the other variant.
        was, now: Their outcomes in words.
        tone: "worse" where an event came and none went, "better" where one went and none came, else
            "mixed".
    """

    base: Rollout
    other: Rollout
    was: str
    now: str
    tone: str

    @property
    def key(self) -> FlipKey:
        """Give what names it among the flips of a run."""
        return (*self.other.key, self.base.variant)

    @property
    def sides(self) -> tuple[str, str]:
        """Give what the two sides are called: by their renderers, their policies, or both."""
        base = self.base
        other = self.other
        if base.policy == other.policy:
            return base.renderer, other.renderer
        return (
            (base.policy, other.policy)
            if base.renderer == other.renderer
            else (base.variant, other.variant)
        )


def find_flips(run: Run) -> tuple[list[Flip], int]:
    """Find every flip of a run: between renderers with the same policy, and between policies behind
    the same renderer.

    Returns:
        The flips, worse ones first and then as in ``rollouts.parquet``, and the number of pairs
        compared.
    """
    bases = flip_bases(run)
    takes = takes_of(run.rollouts)
    by_take = {
        (*rollout.cell, take): rollout
        for rollout, take in zip(run.rollouts, takes, strict=True)
        if has_ended(rollout)
    }
    flips = []
    compared = 0
    for rollout, take in zip(run.rollouts, takes, strict=True):
        for base in bases if has_ended(rollout) else ():
            variant = Variant(rollout.renderer, rollout.policy)
            other = base.of(variant)
            partner = by_take.get((other.renderer, other.policy, rollout.scene, rollout.seed, take))
            if other == variant or partner is None or not (rollout.ok or partner.ok):
                continue
            compared += 1
            was = outcomes_of(partner)
            now = outcomes_of(rollout)
            if was != now:
                tone = "worse" if was < now else "better" if now < was else "mixed"
                flips.append(Flip(partner, rollout, in_words(was), in_words(now), tone))
    order = {"worse": 0, "mixed": 1, "better": 2}
    return sorted(flips, key=lambda flip: order[flip.tone]), compared


def takes_of(rollouts: Sequence[Rollout]) -> list[int]:
    """Return for each rollout how many of its cell come before it: 0, but for several logs of one
    cell, of which the first is compared with the first, the second with the second.
    """
    counts: Counter[tuple[str, str, str, int]] = Counter()
    takes = []
    for rollout in rollouts:
        takes.append(counts[rollout.cell])
        counts[rollout.cell] += 1
    return takes


def flip_bases(run: Run) -> list[Base]:
    """Return what outcomes are compared with: the baseline's renderer, and its policy where there
    are several.
    """
    named = run.info.baseline
    _, by_policy = axis_bases(
        [Variant(renderer, policy) for renderer in run.renderers for policy in run.policies], named
    )
    bases = [Base(renderer=baseline_of(run))] if len(run.renderers) > 1 else []
    return [*bases, *([by_policy] if by_policy else [])]


def baseline_of(run: Run) -> str | None:
    """Return the renderer that the others are compared with: as in the paired differences, else the
    first one.
    """
    for pairs in run.summary.paired.values():
        for entry in pairs.values():
            if entry.baseline in run.renderers:
                return entry.baseline
    return next(iter(run.renderers), None)


@dataclass(frozen=True)
class FlipRow:
    """One flip as the report shows it.

    Attributes:
        entry: What ``flips.json`` says of it.
        images: (side, colour, data address) when the plans diverged.
        why_not: Why there are no images.
        links: (side, colour, clip, folder).
    """

    flip: Flip
    entry: JsonView
    images: Sequence[tuple[str, int, str]]
    why_not: str
    links: Sequence[tuple[str, int, str | None, str | None]]


def flip_rows(run: Run, budget_bytes: int) -> tuple[list[FlipRow], int, int]:
    """Lay out the flips with their images, as far as a budget goes.

    Args:
        run: The run; ``flips.json`` holds when plans diverged and where the frames of that time
            are.
        budget_bytes: Most bytes of images to inline.

    Returns:
        The rows, how many more flips there are, and the number of pairs compared.
    """
    flips, compared = find_flips(run)
    entries = {key_of_entry(entry): entry for entry in flip_entries(run)}
    unknown = "the run folder has no logs to look for it in"
    if entries:
        unknown = "not looked for: there are too many flips"
    colours = colours_of(run)
    spent = 0
    rows = []
    for flip in flips[:MAX_FLIP_ROWS]:
        entry: JsonView = entries.get(flip.key) or {"t_us": None, "reason": unknown}
        why_not = entry.get("reason") or entry.get("frames_reason") or TOO_MANY
        images = []
        links = []
        for name, rollout in zip(flip.sides, (flip.base, flip.other), strict=True):
            colour, _ = colours[rollout.renderer, rollout.policy]
            links.append((name, colour, run.href(rollout, VIDEO_NAME), run.href(rollout)))
            path = inside(run.folder, str((entry.get("frames") or {}).get(name)))
            if spent < budget_bytes and path is not None and os.path.isfile(path):
                data = base64.b64encode(read_bytes(path, SOURCE_BYTES)).decode()
                images.append((name, colour, f"data:image/jpeg;base64,{data}"))
        spent += sum(len(src) for _, _, src in images)
        rows.append(FlipRow(flip, entry, images, "" if images else why_not, links))
    return rows, len(flips) - len(rows), compared


def flip_entries(run: Run) -> list[JsonView]:
    """Read the entries of ``flips.json``; none where there is no such file.

    Raises:
        InputError: It is damaged.
    """
    path = run.folder / FLIPS_NAME
    if not os.path.lexists(path):
        return []
    with parsing(path, AGAIN, "not what simrun wrote"):
        return list(read_json(path)["cells"])


def key_of_entry(entry: JsonView) -> FlipKey:
    """Return the key of an entry of ``flips.json``."""
    cell = entry["renderer"], entry["policy"], entry["scene"], entry["seed"]
    return *cell, entry.get("log", ""), entry["against"]
