"""The reports of a run folder, written together, and what they show of outcomes that flipped."""

from pathlib import Path

from alpasim_plugin.core.errors import SimrunError
from alpasim_plugin.core.files import real
from alpasim_plugin.core.files.atomic import write_bytes, write_json
from alpasim_plugin.core.json_types import JsonObject, JsonView
from alpasim_plugin.core.types import U8, RolloutLog
from alpasim_plugin.log import decode_image, encode_image
from alpasim_plugin.log.images import smaller
from alpasim_plugin.log.run_folder.checksums import state_files
from alpasim_plugin.log.run_folder.rows import Rollout
from alpasim_plugin.log.run_folder.schema import LOG_NAME, PAGES, REPORTS
from alpasim_plugin.runs.film import beside
from evaluators.metrics.outcomes import outcomes_of
from evaluators.metrics.plan import DIVERGED_M, HORIZON_US, first_divergence
from evaluators.pages.cause import log_so_far, write_cause
from evaluators.pages.cells import read_log
from evaluators.pages.ci import write_junit, write_summary_md
from evaluators.pages.flips import (
    FLIPS_NAME,
    Flip,
    find_flips,
    flip_entries,
    key_of_entry,
)
from evaluators.pages.html import write_report
from evaluators.pages.images import frame_rows
from evaluators.pages.run_list import write_run_list
from evaluators.pages.runs import find_runs
from evaluators.statistics.cause import Cause, cause_of
from evaluators.statistics.history import PastRun, changes_between
from evaluators.statistics.opening import Run, read_run

RUNS = Path("runs")  # below the working folder: where runs go whose command names no folder


def write_reports(root: Path, page: bool = True) -> Path | None:
    """Write ``summary.md``, ``junit.xml`` and ``report.html`` of a run folder and
    return the path of the last. Where it lies below `RUNS`, the list of runs is written too.

    Args:
        root: A run folder whose tables are written.
        page: Write ``report.html`` and the flips that it shows and links to, which scored logs of
            others do not have. Otherwise those of an earlier command are removed, and None is
            returned.
    """
    run = read_run(root)
    if page and not run.info.is_of_logs:
        write_flips(run)
        failed = {
            rollout.cell[:3]: rollout for rollout in reversed(run.rollouts) if outcomes_of(rollout)
        }
        for rollout in list(failed.values())[::-1][:MAX_CAUSES]:
            write_cause(run, failure_cause(run, rollout))
    write_summary_md(run)
    write_junit(run)
    report = None
    if page:
        report = write_report(run)
    else:
        for name in PAGES:
            (root / name).unlink(missing_ok=True)
    state_files(root, REPORTS)
    update_run_list(root)
    return report


def update_run_list(root: Path) -> None:
    """Write the list of the runs below `RUNS` again where a run folder is one of them."""
    if real(RUNS) in real(root).parents:
        list_runs(RUNS)


def list_runs(root: Path) -> Path | None:
    """Write the list of the runs below a folder into it; see `write_run_list`."""
    entries = find_runs([root])
    finished = [
        PastRun(entry.info, entry.summary) if entry.info and entry.summary else None
        for entry in entries
    ]
    return write_run_list(root, entries, changes_between(finished))


MAX_CAUSES = 12  # a run must not wait for its pages; `simrun why` writes any other


def divergences_of(run: Run, rollout: Rollout) -> list[JsonView]:
    """Return the entries of ``flips.json`` about a rollout; none where the file is absent."""
    return [entry for entry in flip_entries(run) if key_of_entry(entry)[:5] == rollout.key]


def failure_cause(run: Run, rollout: Rollout) -> Cause:
    """Return what the files of a run say of how a rollout ended."""
    entries = divergences_of(run, rollout)
    return cause_of(run, rollout, entries, log_so_far(run, rollout), frame_rows(run, rollout))


MAX_FLIPS = 60  # rollouts whose logs are read
IMAGE_WIDTH = 560


def write_flips(run: Run) -> None:
    """Find the first plan divergence of every flipped rollout of a run folder and write
    ``flips.json``.

    The two logs are compared; their poses are equal until the plans diverge.
    """
    root = run.folder
    flips, compared = find_flips(run)
    cells = []
    for number, flip in enumerate(flips[:MAX_FLIPS]):
        key = {
            "renderer": flip.other.renderer,
            "policy": flip.other.policy,
            "scene": flip.other.scene,
            "seed": flip.other.seed,
        }
        key |= {"log": flip.other.log} if flip.other.log else {}
        cells.append(
            key
            | {"baseline": flip.base.renderer, "against": flip.base.variant}
            | _divergence(root, flip, f"flips/{number:03d}")
        )
    about = {
        "threshold_m": DIVERGED_M,
        "horizon_s": HORIZON_US * 1e-6,
        "n_flips": len(flips),
        "n_pairs": compared,
    }
    write_json(root / FLIPS_NAME, about | {"cells": cells})


def _divergence(root: Path, flip: Flip, name: str) -> JsonObject:
    if not (flip.base.ok and flip.other.ok):
        return {"t_us": None, "reason": "the policy broke off one of the drives"}
    try:
        logs = {
            name: read_log(root / rollout.path / LOG_NAME)
            for name, rollout in zip(flip.sides, (flip.base, flip.other), strict=True)
        }
    except SimrunError as error:
        return {"t_us": None, "reason": f"a log could not be read: {error.message}"}
    first_log, second_log = logs.values()
    if not first_log.plans or not second_log.plans:
        return {"t_us": None, "reason": "a log without plans"}
    divergence = first_divergence(first_log.plans, second_log.plans)
    if divergence is None:
        return {"t_us": None, "reason": f"the plans never diverge by more than {DIVERGED_M} m"}
    facts: JsonObject = {
        "t_us": divergence.t_us,
        "after_us": divergence.t_us - first_log.render_start_us,
        "gap_m": round(divergence.gap_m, 4),
    }
    frames = {
        side: _image(root, log, divergence.t_us, f"{name}-{i}.jpg")
        for i, (side, log) in enumerate(logs.items())
    }
    if None in frames.values():
        facts["frames_reason"] = (
            "a log without camera images (--images none, or a policy without cameras)"
        )
    return facts | {
        "source": "logs",
        "ahead_us": divergence.ahead_us,
        "frames": {side: path for side, path in frames.items() if path},
    }


def _image(root: Path, log: RolloutLog, t_us: int, name: str) -> str | None:
    """Save the cameras' newest frames at a query and return their path; None where the log has
    none.
    """
    image = shown_at(log, t_us)
    if image is None:
        return None
    write_bytes(root / name, encode_image(image, "jpeg", 85))
    return name


def shown_at(log: RolloutLog, t_us: int) -> U8 | None:
    """Return the newest frame of each camera at an instant ``(H, W, 3)``, beside one another; None
    where a log has none.
    """
    newest = {image.camera: image for image in log.images if image.end_us <= t_us}
    images = [
        smaller(
            decode_image(frame.data, f"camera {frame.camera!r} at {frame.end_us} us"), IMAGE_WIDTH
        )
        for frame in newest.values()
    ]
    return beside(images) if images else None
