"""``simrun refine``: apply a fixer to a video file or a folder of images."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from alpasim_plugin.cli.options import Json, Overwrite, fixer_overrides
from alpasim_plugin.cli.output import Progress, show, warn
from alpasim_plugin.core.errors import Stopped
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.core.interfaces import Fixer
from alpasim_plugin.fixers import fixer_settings, make_fixer
from alpasim_plugin.fixers.refine import UNLIKE, ChangeLimit
from alpasim_plugin.runs.refine import RefineFiles, RefineSummary, refine_video

LARGE_CHANGE_DB = 30.0
SCENE = "video"  # key of the noise, the same for every file: a renamed video gives the same result

EPILOG = """
Examples:

- `simrun refine drive.mp4 -o refined.mp4 --compare side.mp4`

- `simrun refine frames -o refined`: folders of PNG, without a codec between

- `simrun refine render.mp4 --opacity alpha.mp4 --sdmap map.mp4 --set fixer.holes=render -o refined.mp4`
"""


def refine(
    source: Annotated[Path, Positional("A video, or a folder of PNG.", metavar="IN")],
    out: Annotated[Path, Flag("The refined video (MP4) or folder of PNG.", also="-o")],
    opacity: Annotated[
        Path | None, Flag("Grey, white where the input is reliable; in the input's form.")
    ] = None,
    sdmap: Annotated[
        Path | None, Flag("Semantic map (docs/how-the-fixer-works.md), in the input's form.")
    ] = None,
    fixer: Annotated[str, Flag("A fixer (`simrun list fixers`), or NAME@STEPS.")] = "onefixer",
    overrides: Annotated[
        tuple[str, ...], Flag("Override a setting: fixer.key=value. Repeatable.", "--set")
    ] = (),
    seed: Annotated[int, Flag("Seed of the fixer's noise.", min=0)] = 0,
    device: Annotated[str, Flag("Where the fixer computes: cpu, cuda or cuda:N.")] = "cpu",
    compare: Annotated[Path | None, Flag("Also write input and result side by side.")] = None,
    anyway: Annotated[bool, Flag("Take the result, however much it changes.")] = False,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """Refine a video with a fixer, at any length in constant memory.

    Frame times, size and colours are kept; sound is dropped. The result gets its name once
    complete: an interrupted command leaves no file.
    """
    settings = fixer_settings(fixer, fixer_overrides(overrides))

    def session() -> Fixer:
        made = make_fixer(fixer, settings, scene_id=SCENE, seed=seed, device=device)
        if not made.trained and not as_json:
            warn(f"UNTRAINED: {made.label}. The result only shows that the pipeline runs.")
        return made

    limited = not (anyway or opacity or sdmap)
    files = RefineFiles(source, out, opacity, sdmap, compare, overwrite)
    try:
        with Progress(as_json) as progress:
            summary = refine_video(
                files,
                session,
                lambda done, total: progress.show("refining, frames", done, total),
                ChangeLimit() if limited else None,
            )
    except Stopped as stop:
        stop.kept = "nothing was written; the same command starts again"
        raise
    facts = {"input": str(source), "output": str(out), "compare": compare and str(compare)}
    show(as_json, facts | asdict(summary), *summary_lines(summary, out))
    if not as_json:
        for line in warnings(summary):
            warn(line)


def warnings(summary: RefineSummary) -> list[str]:
    """Say what was found on a video that the fixer does not know, or may not know."""
    if summary.refused_psnr_db is not None:
        kept = summary.events.get(UNLIKE, 0)
        return [
            f"warning: {summary.fixer} changes this video too much for a repair: PSNR "
            f"{summary.refused_psnr_db:.1f} dB against a frame that was given as reliable.",
            f"{kept} of {summary.frames} frames of the result are the input's own.",
            "--opacity says what is reliable; --anyway takes what the fixer makes.",
        ]
    if summary.psnr_db is not None and summary.psnr_db < LARGE_CHANGE_DB:
        change = f"PSNR {summary.psnr_db:.1f} dB, mean {summary.mean_levels:.1f} grey levels"
        return [
            f"warning: the fixer changed this video by much ({change}): look at it with --compare"
        ]
    return []


def summary_lines(summary: RefineSummary, out: Path) -> list[str]:
    """Return the summary as lines of text."""
    rate = "" if summary.fps is None else f" at {summary.fps:g} frames per second"
    psnr = "equal" if summary.psnr_db is None else f"PSNR {summary.psnr_db:.2f} dB"
    events = (
        ", ".join(f"{name} {count}" for name, count in sorted(summary.events.items())) or "none"
    )
    times = f"p50 {summary.ms_per_frame_p50:.1f}, p95 {summary.ms_per_frame_p95:.1f}, first block {summary.ms_per_frame_first:.1f}"
    return [
        f"     fixer  {summary.fixer}" + ("" if summary.trained else "   UNTRAINED"),
        f"    frames  {summary.frames} of {summary.width}x{summary.height}{rate}",
        f"  ms/frame  {times}; with the files {summary.wall_s * 1e3 / summary.frames:.1f}",
        f"  to input  {psnr}, mean {summary.mean_levels:.2f} and at most {summary.max_levels} grey levels",
        f"    events  {events}",
        f"    output  {out}"
        + (f"   (without the input's {', '.join(summary.left_out)})" if summary.left_out else ""),
    ]
