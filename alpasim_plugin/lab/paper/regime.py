"""The regime map: where a history matters and where training on the own one pays, by holes, lateral
shift and length of the rollout.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from alpasim_plugin.core.types import F64, Bool
from alpasim_plugin.lab.paper.claims import PER_FRAME
from alpasim_plugin.lab.paper.measured import ALPHA, Measured, beyond
from alpasim_plugin.lab.paper.tables import markdown_table, with_half
from alpasim_plugin.lab.video_metrics.charts import DPI
from alpasim_plugin.lab.video_metrics.facts import PSNR
from evaluators.statistics.intervals import Interval, t_interval
from evaluators.statistics.verdicts import holm

OWN, ORACLE, EMPTY = HISTORIES = ("own", "oracle", "empty")
TRAINED_ON_OWN, TRAINED_ON_CLEAN = "V9-still", "V3b-still"
AXES: Mapping[str, tuple[float, ...]] = {  # borders of bins
    "holes, share of the picture": (0.0, 0.005, 0.02, 0.05, 1.0),
    "shift, m beside the path": (0.0, 0.5, 1.25, np.inf),
    "frames before it": (0, 4, 16, np.inf),
}
LEAST_CLIPS = 5  # that a bin needs
DARK = 0.6  # share of the largest value above which a colour needs light text
HOW = f"""*Room*: PSNR of `{PER_FRAME}`, rolled out without references, with the truth in place of its own last output, minus that on its
own history. No training on histories can gain more there. *Paid*: `{TRAINED_ON_OWN}` (trained on its own history) minus
`{TRAINED_ON_CLEAN}` (trained on the clean frames before), both on their own history, mean over seeds of training; `-` without such arms.
Mean over a clip's frames in the bin, 95 % t interval over clips, dB; bold: shown, corrected by Holm for the bins of the table. A bin needs
{LEAST_CLIPS} clips.
"""


At = tuple[int | None, ...]  # a bin's place on each axis; None: all of it


@dataclass(frozen=True)
class RegimeClip:
    """One clip.

    Args:
        name: Of the clip.
        holes: ``(T,)`` share of the pixels below half opacity.
        shift_m: ``(T,)`` of the camera beside the recorded path.
        psnr_db: What `under` names -> ``(T,)``.
    """

    name: str
    holes: F64
    shift_m: F64
    psnr_db: Mapping[str, F64]


@dataclass(frozen=True)
class Bin:
    """A bin with its gain over clips, and the p-value corrected for the table."""

    gain_db: Interval
    clips: int
    p_value: float | None = None

    @property
    def shown(self) -> bool:
        """Whether the gain differs from zero."""
        return self.p_value is not None and self.p_value <= ALPHA


def under(arm: str, history: str) -> str:
    """Return the name of an arm that is rolled out on a history of a kind."""
    return arm if history == OWN else f"{arm}, {history} history"


def as_measured(clips: Sequence[RegimeClip]) -> Measured:
    """Return the mean PSNR of every clip by arm and history."""
    names = clips[0].psnr_db if clips else {}
    return Measured(
        {
            name: {clip.name: {PSNR: float(clip.psnr_db[name].mean())} for clip in clips}
            for name in names
        }
    )


def room(clip: RegimeClip) -> F64:
    """Return by frame what the truth as history would gain the shipped generator."""
    return np.asarray(clip.psnr_db[under(PER_FRAME, ORACLE)] - clip.psnr_db[PER_FRAME])


def paid(clip: RegimeClip) -> F64:
    """Return by frame what training on the own history gained over clean frames, mean over the
    seeds; empty without such arms.
    """
    seeds = [
        name.removeprefix(TRAINED_ON_OWN)
        for name in clip.psnr_db
        if name.startswith(TRAINED_ON_OWN) and "history" not in name
    ]
    pairs = [
        (clip.psnr_db[TRAINED_ON_OWN + seed], clip.psnr_db[TRAINED_ON_CLEAN + seed])
        for seed in seeds
    ]
    return (
        np.asarray(np.mean([own - clean for own, clean in pairs], axis=0)) if pairs else np.zeros(0)
    )


def bins(
    clips: Sequence[RegimeClip], gain: Callable[[RegimeClip], F64], crossed: bool
) -> dict[At, Bin]:
    """Return the bins of each axis alone, or those of all three crossed; what too few clips have is
    left out.

    Args:
        clips: All.
        gain: `room` or `paid`.
        crossed: Whether the axes are crossed.
    """
    counts = [len(borders) - 1 for borders in AXES.values()]
    alone = [
        tuple(i if j == axis else None for j in range(len(counts)))
        for axis in range(len(counts))
        for i in range(counts[axis])
    ]
    found = {}
    for at in product(*map(range, counts)) if crossed else alone:
        gains = [
            float(values[inside].mean())
            for clip in clips
            if len(values := gain(clip)) and (inside := _inside(clip, at)).any()
        ]
        if len(gains) >= LEAST_CLIPS:
            found[at] = t_interval(gains, "clips"), len(gains)
    p_values = holm([beyond(interval, 0.0, n) for interval, n in found.values()])
    return {
        at: Bin(interval, n, p)
        for (at, (interval, n)), p in zip(found.items(), p_values, strict=True)
    }


def _inside(clip: RegimeClip, at: Sequence[int | None]) -> Bool:
    inside = np.ones(len(clip.holes), dtype=bool)
    for values, borders, i in zip(
        (clip.holes, clip.shift_m, np.arange(len(clip.holes))), AXES.values(), at, strict=True
    ):
        if i is not None:
            inside &= (values >= borders[i]) & (values < borders[i + 1])
    return inside


def _label(axis: int, i: int) -> str:
    low, high = list(pairwise(list(AXES.values())[axis]))[i]
    scale, unit = ((100, " %"), (1, " m"), (1, ""))[axis]
    return (
        f"from {scale * low:g}{unit}"
        if high in (1.0, np.inf)
        else f"{scale * low:g} to {scale * high:g}{unit}"
    )


def regime_section(clips: Sequence[RegimeClip], figure: str) -> str:
    """Return the tables and what each history is worth; empty without clips."""
    if not clips:
        return ""
    measured, names = as_measured(clips), list(AXES)
    tables = []
    for crossed in (False, True):
        rooms, gains = bins(clips, room, crossed), bins(clips, paid, crossed)
        rows = []
        for at, one in rooms.items():
            place = [_label(axis, i) if i is not None else "" for axis, i in enumerate(at)]
            rows.append(
                [*place, str(one.clips), _text(one), _text(gains[at]) if at in gains else "-"]
            )
        tables.append(markdown_table([*names, "clips", "room", "paid"], rows))
    arms = [name for name in measured.arms if under(name, ORACLE) in measured.arms]
    worth = []
    for arm in arms:
        own, others = (
            measured.mean(arm, PSNR),
            [measured.difference(PSNR, under(arm, h), arm) for h in (ORACLE, EMPTY)],
        )
        worth.append(
            [
                arm,
                f"{own.centre:.2f}",
                *(
                    f"{d.difference:+.3f} ± {((d.high or 0) - (d.low or 0)) / 2:.3f}"
                    for d in others
                ),
            ]
        )
    return "\n".join(
        (
            HOW,
            tables[0],
            f"![Room by holes, shift and length]({figure})\n",
            tables[1],
            "What a history is worth to each, dB: the truth in place of the own outputs, and no history at all.\n",
            markdown_table(["arm", "own history, PSNR", "oracle history", "no history"], worth),
        )
    )


def _text(one: Bin) -> str:
    text = with_half(one.gain_db, 3, sign="+")
    return f"**{text}**" if one.shown else text


def plot_regime(clips: Sequence[RegimeClip], path: Path) -> None:
    """Draw the room in the crossed bins, a panel for each length of the rollout, and write a PNG;
    bold is shown.
    """
    found = bins(clips, room, crossed=True)
    rows, columns, panels = (len(borders) - 1 for borders in AXES.values())
    most = max((abs(one.gain_db.centre) for one in found.values()), default=0.0) or 1.0
    figure = Figure(figsize=(3.4 * panels + 0.8, 3.6), layout="constrained")
    for k, ax in enumerate(figure.subplots(1, panels, squeeze=False)[0]):
        grid = np.full((rows, columns), np.nan)
        for i, j in product(range(rows), range(columns)):
            if (one := found.get((i, j, k))) is None:
                continue
            grid[i, j] = one.gain_db.centre
            half = ((one.gain_db.high or 0) - (one.gain_db.low or 0)) / 2
            text = f"{one.gain_db.centre:+.2f}\n±{half:.2f}, {one.clips}"
            colour = "white" if abs(one.gain_db.centre) > DARK * most else "black"
            ax.text(
                j,
                i,
                text,
                ha="center",
                va="center",
                fontsize=8,
                weight="bold" if one.shown else "normal",
                color=colour,
            )
        image = ax.imshow(grid, cmap="RdBu", vmin=-most, vmax=most, aspect="auto", origin="lower")
        ax.set_xticks(range(columns), [_label(1, j) for j in range(columns)], fontsize=8)
        ax.set_yticks(
            range(rows), [_label(0, i) for i in range(rows)] if k == 0 else [""] * rows, fontsize=8
        )
        ax.set_title(f"{_label(2, k)} frames before it", fontsize=9)
    figure.supxlabel("camera beside the recorded path", fontsize=9)
    figure.supylabel("holes, share of the picture", fontsize=9)
    figure.colorbar(
        image, ax=figure.axes, label="truth as history minus own, dB; ± 95 %, clips", shrink=0.9
    )
    figure.savefig(path, dpi=DPI)
