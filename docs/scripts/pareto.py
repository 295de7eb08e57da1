"""Closed-loop error against cost: every setting that trades one for the other, from one record.

    python docs/scripts/pareto.py drive DRIVES.json [SCENE...] [--deep FILE]   # 20 shipped scenes by default; what the file has is kept
    python docs/scripts/pareto.py table DRIVES.json                # table and figure of docs/experiments/speed-and-error.md

A scene is driven with every setting in turn, in one process, so that a busy machine slows all
alike. The error of a drive is how far its headline numbers are from those of the same scene without
a reconstruction, at the finest setting. The network that is twice as deep is that of
docs/experiments/references.md, trained by the command there; its weights do not ship.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from error_budget import camera, mean_with_bounds, one_drive, ratio_of, scenes
from headline import BASELINE, DISTANCE, EVENT, FIXED, TRUE
from results import DOCS
from results import replace as put

from alpasim_plugin.core.atomic import write_json
from evaluators.statistics.intervals import exact_rate

LARGE, FINE = camera(512, 288), "Gaussian budget"


@dataclass(frozen=True)
class Setting:
    """What is driven: the renderer, its fixer's settings, the camera, and what is halved as in
    `error_budget.STEPS`.
    """

    renderer: str
    given: tuple[str, ...] = ()
    size: str = ""
    halved: str = ""


# name -> setting; what a name does not say is 256x144, cells of 3.5 pixels, fp32, two references
SETTINGS = {
    "3dgs": Setting(BASELINE),
    "3dgs, 512x288": Setting(BASELINE, size=LARGE),
    "3dgs, cells of 1.75 px": Setting(BASELINE, halved=FINE),
    "onefixer": Setting(FIXED),
    "onefixer, 512x288": Setting(FIXED, size=LARGE),
    "onefixer, cells of 1.75 px": Setting(FIXED, halved=FINE),
    "onefixer, bf16": Setting(FIXED, halved="fixer precision"),
    "onefixer, references 0": Setting(FIXED, given=("references=0",)),
    "onefixer, references 1": Setting(FIXED, given=("references=1",)),
    "onefixer, references 4": Setting(FIXED, given=("references=4",)),
    "onefixer, twice as deep": Setting(FIXED, given=("weights.bundle=DEEP",)),
}
FINEST = Setting(TRUE, size=LARGE, halved=FINE)
PAGE, FIGURE = DOCS / "experiments" / "speed-and-error.md", DOCS / "img" / "closed-loop-pareto.png"


def drive(out: Path, paths: Sequence[Path], deep: Path) -> None:
    """Add drives to a file, all settings of a scene before the next scene."""
    known = json.loads(out.read_text()) if out.exists() else {}
    compiled = set[str]()
    for path in paths:
        rows, warm = known.setdefault(f"{path.parent.name}/{path.stem}", {}), set[str]()
        for name, one in {"": FINEST, **SETTINGS}.items():
            if name in rows:
                continue
            # The first drive loads, compiles, degrades the scene and draws what was recorded.
            if name and (one.size not in warm or one.halved not in compiled):
                one_drive(path, 0, one.halved, FIXED, 0.0, (), one.size)
                warm.add(one.size)
                compiled.add(one.halved)
            given = tuple(word.replace("DEEP", str(deep.resolve())) for word in one.given)
            rows[name] = one_drive(path, 0, one.halved, one.renderer, 0.0, given, one.size)
            print(path.stem, name, rows[name], flush=True)
            write_json(out, known)


@dataclass(frozen=True)
class Point:
    """One setting: ``(n,)`` scenes' processor milliseconds per frame and metres of error, and in
    how many its event is another.
    """

    ms: np.ndarray
    error_m: np.ndarray
    flips: int


def points_of(known: Mapping[str, Mapping[str, Any]]) -> dict[str, Point]:
    """Return the settings' points over the scenes that have all of them."""
    wanted = ("", *SETTINGS)
    whole = [
        rows
        for rows in known.values()
        if rows.keys() >= {*wanted} and None not in [rows[name][DISTANCE] for name in wanted]
    ]
    out = {}
    for name in SETTINGS:
        off = np.array([abs(rows[name][DISTANCE] - rows[""][DISTANCE]) for rows in whole])
        flips = sum(rows[name][EVENT] != rows[""][EVENT] for rows in whole)
        out[name] = Point(np.array([rows[name]["ms"] for rows in whole]), off, flips)
    return out


def less(here: np.ndarray, there: np.ndarray) -> int:
    """Return 1 if ``(n,)`` paired values are shown to be less than others (95 % t interval), -1 if
    greater, 0 if neither.
    """
    mean, half = mean_with_bounds(here - there)
    return int(np.sign(-mean)) if abs(mean) > half else 0


def place(name: str, points: Mapping[str, Point]) -> str:
    """Say where a setting stands, scene by scene against every other one.

    Returns:
        ``behind``: another one is shown to be cheaper and to err less. ``front``: every other one
            is shown to be dearer, or to err more.
        ``undecided``: else, with how many others.
    """
    one, open_ = points[name], 0
    for other in (point for key, point in points.items() if key != name):
        cost, error = less(np.log(other.ms), np.log(one.ms)), less(other.error_m, one.error_m)
        if cost > 0 and error > 0:
            return "behind"
        open_ += min(cost, error) >= 0
    return f"undecided ({open_})" if open_ else "front"


def table(points: Mapping[str, Point]) -> str:
    """Return the table of the page."""
    base = points[FIXED]
    n = len(base.ms)
    lines = [
        f"| setting | processor ms a frame | over `{FIXED}` | change of `{DISTANCE}`, m | event is another in | place |",
        "|---|---:|---:|---:|---:|---|",
    ]
    for name, one in sorted(points.items(), key=lambda pair: pair[1].ms.mean()):
        (ms, ms_half), (off, off_half) = mean_with_bounds(one.ms), mean_with_bounds(one.error_m)
        ratio = (
            "" if name == FIXED else "{:.2f} ± {:.2f}".format(*ratio_of(np.log(one.ms / base.ms)))
        )
        low, high = exact_rate(one.flips, n)
        flips = f"{one.flips} of {n} ({100 * low:.0f} to {100 * high:.0f} %)"
        lines.append(
            f"| {name} | {ms:.1f} ± {ms_half:.1f} | {ratio} | {off:.3f} ± {off_half:.3f} | {flips} | {place(name, points)} |"
        )
    return "\n".join([*lines, "", f"{n} scenes."])


def draw(points: Mapping[str, Point], out: Path) -> None:
    """Draw both axes with their intervals; filled: on the front, hollow: undecided, a cross:
    behind.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(11, 5), sharex=True, layout="constrained")
    for k, (name, one) in enumerate(sorted(points.items(), key=lambda pair: pair[1].ms.mean())):
        ms, half = mean_with_bounds(one.ms)
        n, where = len(one.ms), place(name, points)
        low, high = exact_rate(one.flips, n)
        error, error_half = mean_with_bounds(one.error_m)
        rate = 100 * one.flips / n
        spans = ((error, error_half, error_half), (rate, rate - 100 * low, 100 * high - rate))
        look = {
            "marker": "X" if where == "behind" else "o",
            "mfc": "white" if where.startswith("undecided") else None,
        }
        for ax, (y, down, up) in zip(axes, spans, strict=True):
            ax.errorbar(
                ms,
                y,
                [[down], [up]],
                [[half], [half]],
                color=f"C{k}" if k < 10 else "black",
                capsize=3,
                lw=1,
                ls="",
                label=name,
                **look,
            )
    for ax, what in zip(
        axes, (f"|change of {DISTANCE}|, m", "drives whose event is another, %"), strict=True
    ):
        ax.set(
            xlabel="processor ms a frame",
            ylabel=what,
            ylim=(None if "event" in what else 0, None),
            xlim=(0, None),
        )
        ax.grid(alpha=0.3)
    how = "filled: on the front; hollow: undecided; X: behind"
    handles = axes[0].get_legend_handles_labels()
    figure.legend(
        *handles,
        loc="outside lower center",
        ncols=5,
        fontsize=8,
        title=how,
        title_fontsize=8,
        frameon=False,
    )
    figure.savefig(out, dpi=110)


def main() -> None:
    """Drive, or write table and figure."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("drive", "table"))
    parser.add_argument("files", type=Path, nargs="+", help="As above.")
    parser.add_argument(
        "--deep",
        type=Path,
        default=Path("deep.safetensors"),
        help="Weights of the network twice as deep.",
    )
    given = parser.parse_args()
    if given.what == "drive":
        drive(given.files[0], given.files[1:] or [Path(one) for one in scenes()], given.deep)
        return
    points = points_of(json.loads(given.files[0].read_text()))
    PAGE.write_text(
        put(PAGE.read_text(encoding="utf-8"), "pareto", table(points)), encoding="utf-8"
    )
    draw(points, FIGURE)


if __name__ == "__main__":
    main()
