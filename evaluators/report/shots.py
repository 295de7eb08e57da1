"""The three pictures at the head of the report: what the camera saw where drives failed, or in the most telling scene."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass

import cv2

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.io.limits import SOURCE_BYTES
from alpasim_plugin.io.reading import read_bytes
from alpasim_plugin.io.reading.images import decode_image
from alpasim_plugin.run_folder.rows import Rollout
from alpasim_plugin.run_folder.schema import STRIP_NAME, WHY_NAME
from evaluators.metrics.outcomes import OUTCOMES, in_words, outcomes_of
from evaluators.opening import Run
from evaluators.report.numbers import fixed

MOST = 3
USUAL_FRAME = 2  # of the strip, where nothing happened
WIDTH_PX = 420
DOING = "reading a picture of a run"


@dataclass(frozen=True)
class Shot:
    """One picture.

    Attributes:
        said: How the drive ended, and when.
        src: data: address.
        link: Where the drive is shown.
    """

    arm: str
    scene: str
    said: str
    src: str
    link: str | None


def shots(run: Run, interesting: Sequence[str]) -> list[Shot]:
    """Pick at most three pictures: of drives that failed, one an arm first; else of the arms in the most telling scene.

    Args:
        run: The run.
        interesting: Its scenes, the most telling first.
    """
    rank = {scene: i for i, scene in enumerate(interesting)}
    order = list(OUTCOMES)
    done = [one for one in run.rollouts if one.ok]
    failed = sorted((one for one in done if outcomes_of(one)), key=lambda r: (min(order.index(o) for o in outcomes_of(r)), rank[r.scene]))
    firsts = {one.variant: one for one in reversed(failed)}.values()
    rest = [one for one in done if interesting and one.scene == interesting[0]]
    found: list[Shot] = []
    for rollout in dict.fromkeys(one.cell for one in [*list(firsts)[::-1], *failed, *(rest if not failed else [])]):
        shot = _shot(run, next(one for one in done if one.cell == rollout)) if len(found) < MOST else None
        found += [shot] if shot else []
    return found


def _shot(run: Run, rollout: Rollout) -> Shot | None:
    path = run.file_of(rollout, STRIP_NAME)
    manifest = run.manifest(rollout)
    times = [int(t) for t in manifest.get("strip_t_us") or ()]
    if path is None or not times:
        return None
    events = [event for event in manifest.get("events") or () if event["metric"] in OUTCOMES]
    first = min(events, key=lambda event: event["t_us"], default=None)
    k = min(USUAL_FRAME, len(times) - 1)
    if first is not None:
        k = min(range(len(times)), key=lambda i: abs(times[i] - int(first["t_us"])))
    try:
        strip = decode_image(read_bytes(path, DOING, SOURCE_BYTES), path, DOING)
    except InputError:
        return None  # the report says elsewhere that the picture is absent
    width = strip.shape[1] // len(times)
    picture = strip[:, k * width : (k + 1) * width]
    picture = cv2.resize(picture, (WIDTH_PX, round(picture.shape[0] * WIDTH_PX / width)), interpolation=cv2.INTER_AREA)
    done, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 80])
    said = in_words(outcomes_of(rollout)) + (f" at {fixed(float(first['t_s']), 1)}\u00a0s" if first is not None else "")
    arm = rollout.policy if len(run.renderers) == 1 else rollout.renderer if len(run.policies) == 1 else rollout.variant
    link = run.href(rollout, WHY_NAME) or run.href(rollout)
    return Shot(arm, rollout.scene, said, "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode(), link) if done else None
