"""How good an imported drive is: photographs that the fit did not see, coverage on and beside the
path, ground, what is missing.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import cv2
import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.escape import markdown as escape
from alpasim_plugin.core.files.atomic import write_bytes, write_json, write_text
from alpasim_plugin.core.geometry import inverse, left_of, shifted, unit
from alpasim_plugin.core.image_metrics import psnr_db, ssim
from alpasim_plugin.core.types import F32, F64, MeasuredRange
from alpasim_plugin.drives.obstacles import Standing
from alpasim_plugin.drives.placing import PlacedDrive
from alpasim_plugin.drives.source import SourceDrive
from alpasim_plugin.gaussians.fit.lens import gain_near
from alpasim_plugin.gaussians.fit.quality import Comparison
from alpasim_plugin.gaussians.fit.reconstruction import Reconstruction
from alpasim_plugin.gaussians.fit.views import PosedView
from alpasim_plugin.gaussians.lens_camera import LensCamera
from alpasim_plugin.gaussians.scene.scene_graph import SceneGraph

LATERAL_M = (0.0, 1.0, -1.0, 2.0, -2.0)  # to the left of the path
OPAQUE = 0.5
STANDING_M = 0.1  # from one photograph to the next but one
EXAMPLES = 3  # photographs of each use on the page
COVERED = 8  # views that measure coverage
LEAST_COVERED = 0.3  # of the lower half of the images: a model of less is refused
IMAGES = "images"
Report = Callable[[str, int, int], None]


def measure(
    model: Reconstruction,
    views: Mapping[str, Sequence[PosedView]],
    exposures: Mapping[str, tuple[float, float, float]],
    tell: Report,
) -> tuple[dict[str, list[Comparison]], dict[float, float]]:
    """Render the model where photographs were taken that it did not see, in the exposure of those
    near by, and at a lateral offset.

    Returns:
        Use of the photographs to their comparisons; and metres to the left of the path to the share
        of the lower half of the image that the model covers.
    """
    graph = model.graph()
    exposed_views = [view for view in views["fitted"] if view.name in exposures]
    cameras = [view.camera_name for view in exposed_views]
    centres = np.array([view.camera.centre_world for view in exposed_views])
    gains = np.array([exposures[view.name] for view in exposed_views])

    def compared(view: PosedView) -> Comparison:
        place = view.camera.centre_world
        return _compared(graph, view, gain_near(view.camera_name, place, cameras, centres, gains))

    rows = {}
    for use in ("held-out", "never-fitted"):
        chosen = [views[use][i] for i in _spread(len(views[use]), 12)]
        if chosen:
            tell(f"measuring {use} photographs", 0, 1)
            rows[use] = [compared(view) for view in chosen]
    sample_views = [views["fitted"][i] for i in _spread(len(views["fitted"]), COVERED)]
    coverage = {
        lateral_m: float(
            np.mean(
                [
                    _covered(graph, view, lateral_m * _left_of_path(views["fitted"], view))
                    for view in sample_views
                ]
            )
        )
        for lateral_m in LATERAL_M
    }
    return rows, coverage


def _compared(graph: SceneGraph, view: PosedView, gain: F32) -> Comparison:
    present = {name: T for name, T in view.actors.items() if name in graph.actors}
    out = graph.render(view.camera, present)
    image = out.exposed(gain).to_uint8()
    truth = view.rgb
    if view.mask is None:
        return Comparison(view.name, image, truth, psnr_db(image, truth), ssim(image, truth))
    # What a lens does not describe counts in neither number.
    image[~view.mask] = truth[~view.mask]
    share = float(view.mask.mean())
    psnr = psnr_db(image[view.mask], truth[view.mask])
    return Comparison(view.name, image, truth, psnr, 1 - (1 - ssim(image, truth)) / share)


def _spread(count: int, most: int) -> list[int]:
    """Return up to ``most`` numbers below ``count``, evenly spread."""
    return [int(i) for i in np.unique(np.linspace(0, count - 1, min(count, most)).round())]


def _left_of_path(views: Sequence[PosedView], view: PosedView) -> F64:
    """Return the unit direction ``(3,)``, world, to the left of the way that a view's camera went;
    of one that stood, the camera's own left.
    """
    centres = [
        other.camera.centre_world for other in views if other.camera_name == view.camera_name
    ]
    away = [float(np.linalg.norm(centre - view.camera.centre_world)) for centre in centres]
    i = int(np.argmin(away))
    way = centres[min(i + 1, len(centres) - 1)] - centres[max(i - 1, 0)]
    if np.hypot(*way[:2]) < STANDING_M:
        return np.asarray(-inverse(view.camera.T_camera_world)[:3, 0], dtype=np.float64)
    return np.array([*left_of(unit(way[:2])), 0.0])


def require_covered(source: Path, covered: float, hint: str) -> None:
    """Refuse a model that covers nearly nothing of what its own drive sees.

    Args:
        source: What was imported.
        covered: Share of the lower half of the images.
        hint: What to do.

    Raises:
        InputError: It is less than `LEAST_COVERED`.
    """
    if covered < LEAST_COVERED:
        raise InputError(
            f"{source}: from the poses the model covers {100 * covered:.1f} % of the images' lower "
            f"half, less than {100 * LEAST_COVERED:.0f} %",
            hint,
        )


def _covered(graph: SceneGraph, view: PosedView, offset: F64) -> float:
    """Return the share of the image's lower half that the model covers, seen from an offset
    ``(3,)``, metres, world, of where a view was taken.
    """
    shift = shifted(*offset)
    pose = inverse(view.camera.T_camera_world)
    camera = replace(view.camera, T_camera_world=inverse(shift @ pose))
    covered = graph.render(camera, {}).alpha > OPAQUE
    lower = np.zeros(covered.shape, dtype=np.bool_)
    lower[camera.height // 2 :] = True
    if isinstance(camera, LensCamera):
        lower &= camera.visible
    return float(covered[lower].mean())


def write_page(
    folder: Path,
    drive: SourceDrive,
    placed: PlacedDrive,
    standing: Standing,
    fitted: int,
    comparisons: Mapping[str, Sequence[Comparison]],
    coverage: Mapping[float, float],
    measured: MeasuredRange | None,
) -> dict[str, Any]:
    """Write ``quality.json``, ``quality.md`` and the images.

    Args:
        folder: Of the imported drive.
        drive, placed: The recording, as read and in the world.
        standing: Obstacles.
        fitted: How many photographs the model was fitted to.
        comparisons, coverage: From `measure`.
        measured: How far from the path photographs were compared.

    Returns:
        What ``quality.json`` holds.
    """
    (folder / IMAGES).mkdir(exist_ok=True)
    examples = []
    for use, rows in comparisons.items():
        for i in _spread(len(rows), EXAMPLES):
            name = f"{IMAGES}/{use}-{rows[i].name}.jpg"
            image = np.concatenate([rows[i].truth, rows[i].image], axis=0)
            data = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]))[1].tobytes()
            write_bytes(folder / name, data)
            examples.append((use, rows[i], name))
    spread = [obstacle.uncertainty_m for obstacle in standing.obstacles]
    quality = {
        "source": drive.kind,
        "photographs": {use: len(rows) for use, rows in comparisons.items()},
        "fitted": fitted,
        **{
            use: {"psnr_db": _mean(rows, "psnr_db"), "ssim": _mean(rows, "ssim")}
            for use, rows in comparisons.items()
        },
        "coverage": [
            {"lateral_m": lateral_m, "share": round(share, 4)}
            for lateral_m, share in coverage.items()
        ],
        "measured": None if measured is None else vars(measured),
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
    write_text(folder / "quality.md", _page(drive, quality, examples))
    return quality


def _range_text(measured: Mapping[str, float] | None) -> str:
    """Say how far from the recorded path renders were compared with photographs."""
    if measured is None or not measured["n_photographs"]:
        return "No render was compared with a photograph: a run counts all its steps as `beyond_measured_share`."
    place = "on the recorded path alone"
    if measured["lateral_m"]:
        place = f"up to {measured['lateral_m']:.2f} m beside the recorded path"
    turn = (
        f" and turned by up to {measured['turn_deg']:.0f} degrees" if measured["turn_deg"] else ""
    )
    return (
        f"These lie {place}{turn}. Farther away nobody has looked: a run counts its steps there as "
        "`beyond_measured_share`."
    )


def _mean(rows: Sequence[Comparison], name: str) -> float:
    return round(float(np.mean([getattr(row, name) for row in rows])), 3)


def _page(
    drive: SourceDrive, quality: Mapping[str, Any], examples: Sequence[tuple[str, Comparison, str]]
) -> str:
    rows = "\n".join(
        f"| {use} | {count} | {quality[use]['psnr_db']:.2f} | {quality[use]['ssim']:.3f} |"
        for use, count in quality["photographs"].items()
    )
    covered = "\n".join(
        f"| {row['lateral_m']:g} | {100 * row['share']:.1f} % |" for row in quality["coverage"]
    )
    notes = list(quality["notes"])
    if not drive.actors:
        notes.append("no tracks of other road users: nobody moves")
    boxes = quality["obstacles"]
    ground = quality["ground"]
    sides = (
        f", whose sides are known to {boxes['uncertainty_m']} m (median)" if boxes["boxes"] else ""
    )
    sections = [
        f"# Quality of {escape(drive.scene_id)}",
        "## What is missing or assumed",
        "\n".join(f"- {escape(note)}" for note in notes),
        f"## Photographs that the fit never saw, of {quality['fitted']} that it saw",
        f"| photographs | number | PSNR, dB | SSIM |\n|---|---|---|---|\n{rows}".rstrip(),
        _range_text(quality["measured"]),
        "## Coverage of the lower half of the image",
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
        "## Photograph above, reconstruction below",
    ]
    for use, row, name in examples:
        title = escape(row.name)
        sections += [f"{use}, {title}: {row.psnr_db:.2f} dB", f"![{title}]({quote(name)})"]
    return "\n\n".join(sections) + "\n"
