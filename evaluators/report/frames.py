"""Put the strips of one cell side by side for all renderers: same scene, same seed, same times."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.io.limits import SOURCE_BYTES
from alpasim_plugin.io.reading import read_bytes
from alpasim_plugin.io.reading.images import decode_image
from alpasim_plugin.run_folder.rows import Rollout
from evaluators.opening import Run
from evaluators.report.numbers import fixed

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
        found = _best_cell(run, scene)
        if found is None:
            continue
        policy, seed, members = found
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


def _best_cell(run: Run, scene: str) -> tuple[str, int, list[Rollout]] | None:
    cells: dict[tuple[str, int], list[Rollout]] = {}
    for rollout in run.by_scene.get(scene, ()):
        if run.file_of(rollout, "strip.jpg") is not None:
            cells.setdefault((rollout.policy, rollout.seed), []).append(rollout)
    if not cells:
        return None
    (policy, seed), members = max(cells.items(), key=lambda item: len(item[1]))  # the first of equals
    return policy, seed, members


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
    zero = _start_us(run, scene)
    printed = () if differing else tuple(f"t = {fixed((t - zero) * 1e-6, 1)}\u00a0s" for t in times[0])
    return Comparison(scene, policy, seed, printed, tuple(strips), tuple(absent), differing)


def _start_us(run: Run, scene: str) -> int:
    content = run.scene_data(scene) or {}
    return int(content.get("start_us") or 0)


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
