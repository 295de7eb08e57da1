"""Renderers side by side: strips of one cell at the same times, and the cells whose outcome differs from the baseline's."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.io.limits import SOURCE_BYTES
from alpasim_plugin.io.reading import read_bytes
from alpasim_plugin.io.reading.images import decode_image
from alpasim_plugin.run_folder.reader import read_json
from alpasim_plugin.run_folder.rows import Rollout
from evaluators.opening import Run
from evaluators.report.numbers import Cell, fixed, missing, short

MAX_WIDTH = 1600  # pixels of an inlined strip
MAX_BYTES = 90_000  # above this a strip is encoded again


@dataclass(frozen=True)
class Strip:
    """One renderer's frames."""

    renderer: str
    src: str  # data: address
    width: int
    height: int
    clip: str | None
    folder: str | None


@dataclass(frozen=True)
class Comparison:
    """Strips of one scene, policy and seed."""

    scene: str
    policy: str
    seed: int
    times: tuple[str, ...]
    strips: tuple[Strip, ...]
    absent: tuple[str, ...]  # renderers without a strip in this cell
    differing_times: bool

    @property
    def n_bytes(self) -> int:
        """Give the size of the inlined pictures."""
        return sum(len(s.src) for s in self.strips)


def comparisons(run: Run, scenes: Sequence[str], limit: int, budget_bytes: int) -> tuple[list[Comparison], list[str]]:
    """Pick one cell per scene, the one that most renderers finished, and inline its strips.

    Args:
        scenes: Candidate scenes, the most telling first.
        limit: Most scenes to inline.
        budget_bytes: Most bytes of pictures to inline; the first scene is always shown.

    Returns:
        The comparisons and the scenes that have strips but were left out.
    """
    shown: list[Comparison] = []
    left_out: list[str] = []
    spent = 0
    for scene in scenes:
        cells: dict[tuple[str, int], list[Rollout]] = {}
        for rollout in run.by_scene.get(scene, ()):
            if run.file_of(rollout, "strip.jpg") is not None:
                cells.setdefault((rollout.policy, rollout.seed), []).append(rollout)
        if not cells:
            continue
        (policy, seed), members = max(cells.items(), key=lambda item: len(item[1]))  # the first of equals
        if shown and (len(shown) >= limit or spent >= budget_bytes):
            left_out.append(scene)
            continue
        comparison = _comparison(run, scene, policy, seed, members)
        if comparison is None:
            continue
        if shown and spent + comparison.n_bytes > budget_bytes:
            left_out.append(scene)
            continue
        shown.append(comparison)
        spent += comparison.n_bytes
    return shown, left_out


def _comparison(run: Run, scene: str, policy: str, seed: int, members: list[Rollout]) -> Comparison | None:
    by_renderer = {r.renderer: r for r in members}
    strips, absent, times = [], [], []
    for renderer in run.renderers:
        rollout = by_renderer.get(renderer)
        path = run.file_of(rollout, "strip.jpg") if rollout else None
        encoded = inline_jpeg(path) if path else None
        if rollout is None or encoded is None:
            absent.append(renderer)
            continue
        strips.append(Strip(renderer, *encoded, run.href(rollout, "front.mp4"), run.href(rollout)))
        times.append(tuple(int(t) for t in run.manifest(rollout).get("strip_t_us") or ()))
    if not strips:
        return None
    differing = len(set(times)) > 1
    zero = int((run.scene_data(scene) or {}).get("start_us") or 0)
    printed = () if differing else tuple(f"t = {fixed((t - zero) * 1e-6, 1)}\u00a0s" for t in times[0])
    return Comparison(scene, policy, seed, printed, tuple(strips), tuple(absent), differing)


def inline_jpeg(path: Path) -> tuple[str, int, int] | None:
    """Encode a picture as a ``data:`` address, smaller where it is large; None where it is not a readable picture."""
    try:
        data = read_bytes(path, "reading a picture of a run", SOURCE_BYTES)
        image = decode_image(data, path, "reading a picture of a run")
    except InputError:
        return None  # the report says that the picture is absent
    height, width = image.shape[:2]
    if len(data) > MAX_BYTES or width > MAX_WIDTH:
        scale = min(1.0, MAX_WIDTH / width)
        image = cv2.resize(image, (round(width * scale), round(height * scale)), interpolation=cv2.INTER_AREA) if scale < 1.0 else image
        done, buffer = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 80])
        if done and buffer.size < len(data):
            data = buffer.tobytes()
            height, width = image.shape[:2]
    return "data:image/jpeg;base64," + base64.b64encode(data).decode(), width, height


FLIPS_NAME = "flips.json"
OUTCOMES = {  # metric -> word, most severe first
    "collision_at_fault": "at-fault collision",
    "collision_any": "collision",
    "offroad": "off-road",
}
MAX_FLIP_ROWS = 400


@dataclass(frozen=True)
class Flip:
    """One scene, policy and seed with two outcomes.

    Attributes:
        base, other: The rollouts behind the baseline and behind the other renderer.
        was, now: Their outcomes in words.
        tone: "worse" where an event came and none went, "better" where one went and none came, else "mixed".
    """

    base: Rollout
    other: Rollout
    was: str
    now: str
    tone: str

    @property
    def key(self) -> tuple[str, str, str, int]:
        """Give renderer, policy, scene and seed of the other side."""
        return self.other.cell


def find_flips(run: Run) -> tuple[list[Flip], int]:
    """Find every flip of a run.

    Returns:
        The flips, worse ones first and then as in ``rollouts.parquet``, and the number of pairs compared.
    """
    base = baseline_of(run)
    partners = {r.cell[1:]: r for r in run.rollouts if r.renderer == base and r.ok}
    flips: list[Flip] = []
    compared = 0
    for rollout in run.rollouts:
        partner = partners.get(rollout.cell[1:])
        if rollout.renderer == base or not rollout.ok or partner is None:
            continue
        compared += 1
        was, now = events(partner), events(rollout)
        if was != now:
            tone = "worse" if was < now else "better" if now < was else "mixed"
            flips.append(Flip(partner, rollout, in_words(was), in_words(now), tone))
    order = {"worse": 0, "mixed": 1, "better": 2}
    return sorted(flips, key=lambda flip: order[flip.tone]), compared


def baseline_of(run: Run) -> str | None:
    """Return the renderer that the others are compared with: as in the paired differences, else the first one."""
    for pairs in (run.summary.get("paired") or {}).values():
        for entry in pairs.values():
            if entry.get("baseline") in run.renderers:
                return str(entry["baseline"])
    return next(iter(run.renderers), None)


def events(rollout: Rollout) -> frozenset[str]:
    """Return which of the `OUTCOMES` a rollout had."""
    return frozenset(name for name in OUTCOMES if rollout.flag(name))


def in_words(had: frozenset[str]) -> str:
    """Name an outcome."""
    said = [word for name, word in OUTCOMES.items() if name in had and not (name == "collision_any" and "collision_at_fault" in had)]
    return " and ".join(said) or "no event"


@dataclass(frozen=True)
class FlipRow:
    """One flip as the report shows it.

    Attributes:
        time: When the plans diverged, since the first frame.
        gap: How far apart they were then.
        pictures: (renderer, variant, data address, width, height) at that time.
        why_not: Why there are no pictures.
        links: (renderer, variant, clip, folder).
    """

    flip: Flip
    time: Cell
    gap: Cell
    source: str
    pictures: tuple[tuple[str, int, str, int, int], ...]
    why_not: str
    links: tuple[tuple[str, int, str | None, str | None], ...]


def flip_rows(run: Run, budget_bytes: int) -> tuple[list[FlipRow], int, int]:
    """Lay out the flips with their pictures, as far as a budget goes.

    Args:
        run: The run; ``flips.json`` holds when plans diverged and where the frames of that time are.
        budget_bytes: Most bytes of pictures to inline.

    Returns:
        The rows, how many more flips there are, and the number of pairs compared.
    """
    flips, compared = find_flips(run)
    path = run.folder / FLIPS_NAME
    told: dict[tuple[str, str, str, int], Mapping[str, Any]] = {}
    if path.is_file():
        told = {(c["renderer"], c["policy"], c["scene"], c["seed"]): c for c in read_json(path).get("cells") or []}
    spent, rows = 0, []
    for flip in flips[:MAX_FLIP_ROWS]:
        entry = told.get(flip.key)
        row = _row(run, flip, entry, spent < budget_bytes)
        spent += sum(len(picture[2]) for picture in row.pictures)
        rows.append(row)
    return rows, len(flips) - len(rows), compared


def _row(run: Run, flip: Flip, entry: Mapping[str, Any] | None, room: bool) -> FlipRow:
    index = {name: i for i, name in enumerate(run.renderers)}
    sides = (flip.base, flip.other)
    links = tuple((r.renderer, index[r.renderer], run.href(r, "front.mp4"), run.href(r)) for r in sides)
    if entry is None:
        looked = (run.folder / FLIPS_NAME).is_file()
        why = "not looked for: there are too many flips" if looked else "the run folder has no logs to look for it in"
        return FlipRow(flip, missing(why), missing(why), "", (), why, links)
    if entry.get("t_us") is None:
        why = str(entry.get("reason") or "the plans never diverge by more than the threshold")
        return FlipRow(flip, missing(why), missing(why), "", (), why, links)
    seconds = float(entry["after_us"]) * 1e-6
    time, gap = Cell(f"{fixed(seconds, 1)}\u00a0s", sort=seconds), Cell(short(float(entry["gap_m"]), "m"), sort=float(entry["gap_m"]))
    pictures = []
    for rollout in sides if room else ():
        name = (entry.get("frames") or {}).get(rollout.renderer)
        file = run.folder / name if name else None
        inside = file is not None and file.is_file() and file.resolve().is_relative_to(run.folder.resolve())
        encoded = inline_jpeg(file) if file is not None and inside else None
        if encoded is not None:
            pictures.append((rollout.renderer, index[rollout.renderer], *encoded))
    why = "" if pictures else str(entry.get("frames_reason") or "left out to keep this file small; they are in flips/")
    return FlipRow(flip, time, gap, str(entry.get("source") or ""), tuple(pictures), why, links)
