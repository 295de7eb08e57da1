"""The transfer beyond driving: what is measured of a clip, and the section of the comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from alpasim_plugin.core.types import F64
from alpasim_plugin.lab.learned_metrics.facts import FVMD_LK
from alpasim_plugin.lab.paper.claims import LAST, MID, OURS, PERCEPTUAL, PSNR, WARP
from alpasim_plugin.lab.paper.measured import Measured
from alpasim_plugin.lab.paper.published import Published
from alpasim_plugin.lab.paper.tables import differences, means_table, paper_against_ours

TRANSFER, PHOTOGRAPHS = "transfer", "transfer-photographs"
COMPARED = (
    OURS,
    "difix",
    "artifixer",
    "artifixer@4",
)  # the arms of the paper's table that are trained here
# ends the name of an arm that was trained on driving alone; a plain name is fine-tuned, as in the
# paper
ZERO_SHOT = " zero shot"
METRICS = (PSNR, PERCEPTUAL, MID, LAST, WARP, FVMD_LK)
HOW = f"""Arms with a plain name were fine-tuned on the 32 training scenes; `{ZERO_SHOT.strip()}` means trained on driving alone;
`onefixer` and `onefixer-dit-tiny` are as shipped. The map is black for all. The paper fine-tunes OneFixer and takes the others' published
weights; here all are fine-tuned alike. `{MID}` and `{LAST}` are means over the middle and the last tenth of a
clip's frames, as we define them; the paper does not say.
"""
PHOTOGRAPHED = """One real place: every photograph is held out in one of the clips, and PSNR and perceptual distance count held-out
photographs alone. Intervals are over the clips, which show the same place: they say how sure the numbers are for it and nothing about other
places. Between two photographs the camera moves far, so Warp L1 and `fvmd_lk` measure jumps more than flicker.
"""


def tenth(frames: int, last: bool) -> range:
    """Return the middle or the last tenth of a clip's frames, one at least.

    Example:
        >>> tenth(100, last=False), tenth(100, last=True), tenth(4, last=False)
        (range(45, 55), range(90, 100), range(2, 3))
    """
    count = max(frames // 10, 1)
    start = frames - count if last else (frames - count + 1) // 2
    return range(start, start + count)


def clip_values(
    series: Mapping[str, F64], frames: int, counted: Sequence[int] | None
) -> dict[str, float]:
    """Return a clip's values that this protocol adds or counts differently.

    Args:
        series: METRIC -> a value a frame ``(frames,)``.
        frames: Of the clip.
        counted: Indices of the frames that count for metrics of frames; None: all do.

    Returns:
        PSNR and perceptual distance over the counted frames, and the latter over those in the
        middle and in the last tenth; a value without a frame is not there.
    """
    may = range(frames) if counted is None else counted
    wanted = {PSNR: (PSNR, range(frames)), PERCEPTUAL: (PERCEPTUAL, range(frames))}
    wanted |= {
        MID: (PERCEPTUAL, tenth(frames, last=False)),
        LAST: (PERCEPTUAL, tenth(frames, last=True)),
    }
    out = {}
    for name, (metric, window) in wanted.items():
        at = [i for i in may if i in window]
        if metric in series and at:
            out[name] = float(np.mean(series[metric][at]))
    return out


def transfer_section(published: Published, measured: Mapping[str, Measured]) -> str:
    """Return the section: the paper's table above ours, then photographs, paired differences below
    each; empty where it was not run.
    """
    if TRANSFER not in measured:
        return ""
    mine = measured[TRANSFER]
    parts = [
        HOW,
        paper_against_ours(published, "transfer", mine),
        _differences(mine),
        f"\n{_clips(mine)} held-out scenes.\n",
    ]
    if PHOTOGRAPHS in measured:
        parts += [
            "### Photographs\n",
            PHOTOGRAPHED,
            means_table(measured[PHOTOGRAPHS], METRICS, {PSNR: 2, FVMD_LK: 0}, 4),
            _differences(measured[PHOTOGRAPHS]),
        ]
    return "\n".join(parts)


def _differences(measured: Measured) -> str:
    lead = next((arm for arm in (OURS, OURS + ZERO_SHOT, "onefixer") if arm in measured.arms), None)
    if lead is None:
        return ""
    metrics = [metric for metric in METRICS if measured.has(lead, metric)]
    return "\n" + differences(
        measured, lead, [arm for arm in measured.arms if arm != lead], metrics
    )


def _clips(measured: Measured) -> int:
    return max((len(clips) for clips in measured.values.values()), default=0)
