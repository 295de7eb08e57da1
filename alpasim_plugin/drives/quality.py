"""How good an imported drive is: photographs that the fit did not see, coverage on and beside the
path, ground, what is missing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import cv2
import numpy as np

from alpasim_plugin.core.atomic import write_bytes, write_json, write_text
from alpasim_plugin.core.escape import markdown as escape
from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.image_metrics import psnr_db, ssim
from alpasim_plugin.core.types import F32, F64, U8
from alpasim_plugin.drives.obstacles import Standing
from alpasim_plugin.drives.placing import PlacedDrive
from alpasim_plugin.drives.source import SourceDrive
from alpasim_plugin.gaussians.fit.lens import gain_between
from alpasim_plugin.gaussians.fit.quality import Comparison
from alpasim_plugin.gaussians.fit.reconstruction import Reconstruction
from alpasim_plugin.gaussians.fit.views import PosedView
from alpasim_plugin.gaussians.scene.scene_graph import SceneGraph
from scenarios.drive import Obstacle

ASIDE_M = (0.0, 1.0, -1.0, 2.0, -2.0)  # to the left of the path
OPAQUE = 0.5
SHOWN, COVERED = 6, 8  # photographs of the page; views that coverage is measured on
PLAN_PX, PLAN_M = (
    900,
    70.0,
)  # the view from above: its width, and how much of the world it shows at most across
PICTURES = "pictures"
Report = Callable[[str, int, int], None]


def measure(
    model: Reconstruction,
    views: Mapping[str, Sequence[PosedView]],
    exposures: Mapping[str, tuple[float, float, float]],
    tell: Report,
) -> tuple[dict[str, list[Comparison]], dict[float, float]]:
    """Render the model where photographs were taken that it did not see, in the exposure of those
    near by, and beside the path.

    Returns:
        Use of the photographs to their comparisons; and metres to the left of the path to the share
        of the lower half of the image that the model covers.
    """
    graph = model.graph()
    known = [view for view in views["fitted"] if view.name in exposures]
    centres = np.array([view.camera.centre_world for view in known]).reshape(-1, 3)
    gains = np.array([exposures[view.name] for view in known]).reshape(-1, 3)
    rows = {}
    for use in ("held-out", "never-fitted"):
        chosen = [views[use][i] for i in _spread(len(views[use]), 12)]
        if chosen:
            tell(f"measuring {use} photographs", 0, 1)
            rows[use] = [
                _compared(graph, view, gain_between(centres, gains, view.camera.centre_world))
                for view in chosen
            ]
    some = [views["fitted"][i] for i in _spread(len(views["fitted"]), COVERED)]
    coverage = {
        aside: float(np.mean([_covered(graph, view, aside) for view in some])) for aside in ASIDE_M
    }
    return rows, coverage


def _compared(graph: SceneGraph, view: PosedView, gain: F32) -> Comparison:
    known = {name: T for name, T in view.actors.items() if name in graph.actors}
    out = graph.render(view.camera, known)
    shown = replace(out, rgb=np.clip(out.rgb * gain, 0.0, 1.0)).to_uint8()
    return Comparison(view.name, shown, view.rgb, psnr_db(shown, view.rgb), ssim(shown, view.rgb))


def _spread(count: int, most: int) -> list[int]:
    return (
        [int(i) for i in np.unique(np.linspace(0, count - 1, min(count, most)).round())]
        if count
        else []
    )


def _covered(graph: SceneGraph, view: PosedView, aside_m: float) -> float:
    """Return the share of the picture's lower half that the model covers, seen from beside where a
    view was taken.
    """
    shift = np.eye(4)
    pose = inverse(view.camera.T_camera_world)
    shift[:3, 3] = -aside_m * pose[:3, 0]  # the camera's own left
    camera = type(view.camera).from_pose(
        view.camera.width, view.camera.height, view.camera.K, shift @ pose
    )
    alpha = graph.render(camera, {}).alpha
    return float((alpha[camera.height // 2 :] > OPAQUE).mean())


def _plan(placed: PlacedDrive, obstacles: Sequence[Obstacle]) -> U8:
    """Draw points, path and obstacles from above, the drive's heading to the right."""
    path = placed.ego.xyz[:, :2]
    low, high = path.min(axis=0) - 15.0, path.max(axis=0) + 15.0
    high = np.maximum(high, low + 20.0)
    metres = float(min(max(high - low), 10 * PLAN_M))
    scale = PLAN_PX / metres
    size = np.ceil((high - low).clip(0, metres) * scale).astype(int)
    image = np.full((size[1], size[0], 3), 255, np.uint8)

    def at(xy: F64) -> F64:
        return np.column_stack([(xy[:, 0] - low[0]) * scale, (high[1] - xy[:, 1]) * scale])

    order = np.argsort(placed.points.xyz[:, 2])
    cells = at(placed.points.xyz[order]).astype(np.int64)
    inside = ((cells >= 0) & (cells < size)).all(axis=1)
    image[cells[inside, 1], cells[inside, 0]] = np.rint(
        placed.points.rgb[order][inside] * 200
    ).astype(np.uint8)
    cv2.polylines(image, [np.rint(at(path)).astype(np.int32)], False, (30, 90, 220), 2, cv2.LINE_AA)
    for one in obstacles:
        c = np.cos(one.yaw_rad)
        s = np.sin(one.yaw_rad)
        half = np.array([one.box.length_m, one.box.width_m]) / 2
        corners = (
            np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * half @ np.array([[c, s], [-s, c]])
            + one.xyz[:2]
        )
        cv2.polylines(
            image, [np.rint(at(corners)).astype(np.int32)], True, (200, 40, 30), 2, cv2.LINE_AA
        )
    return image


def write_page(
    folder: Path,
    drive: SourceDrive,
    placed: PlacedDrive,
    standing: Standing,
    fitted: int,
    comparisons: Mapping[str, Sequence[Comparison]],
    coverage: Mapping[float, float],
) -> dict[str, Any]:
    """Write ``quality.json``, ``quality.md`` and the images.

    Args:
        folder: Of the imported drive.
        drive, placed: The recording, as read and in the world.
        standing: Obstacles.
        fitted: How many photographs the model was fitted to.
        comparisons, coverage: From `measure`.

    Returns:
        What ``quality.json`` holds.
    """
    (folder / PICTURES).mkdir(exist_ok=True)
    shown = []
    for use, rows in comparisons.items():
        for row in [rows[i] for i in _spread(len(rows), SHOWN // 2)]:
            name = f"{PICTURES}/{use}-{row.name}.jpg"
            _write(folder / name, np.concatenate([row.truth, row.shown], axis=0))
            shown.append((use, row, name))
    _write(folder / PICTURES / "plan.png", _plan(placed, standing.obstacles))
    spread = [one.uncertainty_m for one in standing.obstacles]
    quality = {
        "source": drive.kind,
        "photographs": {use: len(rows) for use, rows in comparisons.items()},
        "fitted": fitted,
        **{
            use: {"psnr_db": _mean(rows, "psnr_db"), "ssim": _mean(rows, "ssim")}
            for use, rows in comparisons.items()
        },
        "coverage": [
            {"aside_m": aside, "share": round(share, 4)} for aside, share in coverage.items()
        ],
        "obstacles": {
            "boxes": len(spread),
            "uncertainty_m": round(float(np.median(spread)), 2) if spread else None,
            "cleared_cells": standing.cleared,
        },
        **placed.facts,
        "T_world_source": placed.T_world_source.tolist(),
        "notes": [*drive.notes, *placed.notes],
    }
    write_json(folder / "quality.json", quality)
    write_text(folder / "quality.md", _page(drive, quality, shown))
    return quality


def _mean(rows: Sequence[Comparison], name: str) -> float:
    return round(float(np.mean([getattr(row, name) for row in rows])), 3)


def _write(path: Path, rgb: U8) -> None:
    write_bytes(path, cv2.imencode(path.suffix, np.ascontiguousarray(rgb[..., ::-1]))[1].tobytes())


def _page(
    drive: SourceDrive, quality: Mapping[str, Any], shown: Sequence[tuple[str, Comparison, str]]
) -> str:
    rows = "\n".join(
        f"| {use} | {count} | {quality[use]['psnr_db']:.2f} | {quality[use]['ssim']:.3f} |"
        for use, count in quality["photographs"].items()
    )
    covered = "\n".join(
        f"| {row['aside_m']:g} | {100 * row['share']:.1f} % |" for row in quality["coverage"]
    )
    notes = [*quality["notes"], "no tracks of other road users: nobody moves"]
    boxes, ground = quality["obstacles"], quality["ground"]
    sides = (
        f", whose sides are known to {boxes['uncertainty_m']} m (median)" if boxes["boxes"] else ""
    )
    sections = [
        f"# Quality of {escape(drive.scene_id)}",
        "## What is missing or assumed",
        "\n".join(f"- {escape(note)}" for note in notes),
        f"## Photographs that the fit never saw, of {quality['fitted']} that it saw",
        f"| photographs | number | PSNR, dB | SSIM |\n|---|---|---|---|\n{rows}".rstrip(),
        "## Coverage of the lower half of the picture",
        f"| metres to the left of the path | covered |\n|---|---|\n{covered}",
    ]
    if ground:
        errors = "-"
        if ground["sections"]:
            errors = f"median {100 * ground['median_error_m']:.1f} cm, worst {100 * ground['worst_error_m']:.1f} cm"
        sections.append(
            f"Ground: {ground['points']} points, camera {ground['camera_height_m']:.2f} m above it; against them by section: {errors}."
        )
    sections += [
        f"Standing obstacles: {boxes['boxes']} boxes{sides}. On the driven path {boxes['cleared_cells']} cells of 0.2 m were opaque\n"
        "by mistake and were taken as free.",
        "## From above",
        f"![from above]({PICTURES}/plan.png)",
        "## Photograph above, reconstruction below",
    ]
    for use, row, name in shown:
        title = escape(row.name)
        sections += [f"{use}, {title}: {row.psnr_db:.2f} dB", f"![{title}]({quote(name)})"]
    return "\n\n".join(sections) + "\n"
