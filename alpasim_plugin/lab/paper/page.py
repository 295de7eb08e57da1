"""All arms of a clip side by side on one offline page: one clock, a slider, a wipe, and the metric
curves below.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.lab.video_metrics.facts import KNOWN
from evaluators.report.html import asset
from evaluators.report.numbers import plural

DIGITS = {"psnr_db": 1, "ssim": 3, "perceptual-syn": 3, "warp_l1": 4}


@dataclass(frozen=True)
class ShownClip:
    """One clip under every arm.

    Args:
        name: Of the clip.
        films: ARM -> JPEG of every frame, all of one length.
        curves: METRIC -> ARM -> value of every frame; a metric of pairs of frames has one value
            less and begins at frame 1.
    """

    name: str
    films: Mapping[str, Sequence[bytes]]
    curves: Mapping[str, Mapping[str, Sequence[float]]]


def render_side_by_side(clips: Sequence[ShownClip], size: tuple[int, int]) -> str:
    """Return the page.

    Args:
        clips: At least one; all with the same arms in the same order.
        size: Height and width of a frame, pixels.

    Raises:
        EvaluatorError: No clip, clips with other arms, or films of other lengths.
    """
    _, do = (
        "laying out arms side by side",
        "give clips with the same arms, each with every frame of every arm",
    )
    if not clips:
        raise EvaluatorError("clips: none", do)
    arms = list(clips[0].films)
    for clip in clips:
        lengths = {len(film) for film in clip.films.values()}
        if list(clip.films) != arms or len(lengths) != 1:
            raise EvaluatorError(
                f"{clip.name}: arms {', '.join(clip.films)}, lengths {sorted(lengths)}", do
            )
    environment = Environment(
        loader=PackageLoader("evaluators.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    style = "\n".join(
        asset(environment, name) for name in ("theme.css", "report.css", "side_by_side.css")
    )
    script = "\n".join(asset(environment, name) for name in ("theme.js", "side_by_side.js"))
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    data = json.dumps({"clips": [_data(clip, arms) for clip in clips]}).replace("</", "<\\/")
    height, width = size
    return environment.get_template("side_by_side.html.j2").render(
        style=Markup(style),
        script=Markup(script),
        script_hash=digest,
        plural=plural,
        arms=arms,
        clips=clips,
        data=Markup(data),
        width=width,
        height=height,
    )


def _data(clip: ShownClip, arms: Sequence[str]) -> dict[str, object]:
    frames = len(clip.films[arms[0]])
    curves = []
    for metric, by_arm in clip.curves.items():
        digits = DIGITS.get(metric, 3)
        lines = [_line(by_arm[arm], frames, digits + 2) if arm in by_arm else None for arm in arms]
        curves.append(
            {"title": metric, "unit": KNOWN.info(metric).unit, "digits": digits, "lines": lines}
        )
    films = [[base64.b64encode(jpeg).decode() for jpeg in clip.films[arm]] for arm in arms]
    return {"name": clip.name, "frames": frames, "films": films, "curves": curves}


def _line(values: Sequence[float], frames: int, digits: int) -> list[float | None]:
    """Return one value a frame; what begins later than frame 0 begins with None."""
    return [None] * (frames - len(values)) + [round(float(v), digits) for v in values]
