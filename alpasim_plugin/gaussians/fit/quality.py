"""Measure a reconstruction on posed views, and show it beside them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.image_metrics import psnr_db, ssim
from alpasim_plugin.gaussians.fit.views import PosedView
from alpasim_plugin.gaussians.scene.scene_graph import SceneGraph


@dataclass(frozen=True, eq=False)
class Comparison:
    """One view and what the model shows there.

    Attributes:
        name: Of the view.
        shown: ``(H, W, 3)`` uint8, the model's image, 8 bits as a file would hold it.
        truth: ``(H, W, 3)`` uint8.
        psnr_db: Over the pixels that count.
        ssim: Mean over the image, masked pixels taken from the truth.
    """

    name: str
    shown: npt.NDArray[np.uint8]
    truth: npt.NDArray[np.uint8]
    psnr_db: float
    ssim: float


def compare(model: SceneGraph, views: Sequence[PosedView], threads: int | None = None) -> list[Comparison]:
    """Render a model where views were taken; actors that it lacks are left out."""
    return [_compare(model, view, threads) for view in views]


def summary(rows: Sequence[Comparison]) -> dict[str, Any]:
    """Return mean PSNR (dB) and SSIM over views, and PSNR by view.

    Raises:
        InputError: There is none.
    """
    if not rows:
        raise InputError("measuring a reconstruction", "no view", "nothing to measure", "hold views out, or leave the measurement out")
    by_view = {row.name: round(row.psnr_db, 3) for row in rows}
    return {
        "views": len(rows), "psnr_db": float(np.mean([r.psnr_db for r in rows])), "ssim": float(np.mean([r.ssim for r in rows])),
        "psnr_db_by_view": by_view,
    }  # fmt: skip


def write_pictures(folder: Path, rows: Sequence[Comparison]) -> None:
    """Write one PNG a view: truth left, model right."""
    folder.mkdir(parents=True, exist_ok=True)
    for row in rows:
        cv2.imwrite(str(folder / f"{row.name}.png"), np.concatenate([row.truth, row.shown], axis=1)[..., ::-1])


def _compare(model: SceneGraph, view: PosedView, threads: int | None) -> Comparison:
    known = {name: T for name, T in view.actors.items() if name in model.actors}
    shown = model.render(view.camera, known, threads).to_uint8()
    counted = shown if view.mask is None else np.where(view.mask[..., None], shown, view.rgb)
    share = 1.0 if view.mask is None else max(float(view.mask.mean()), 1e-9)
    return Comparison(view.name, shown, view.rgb, psnr_db(counted, view.rgb) + 10 * float(np.log10(share)), ssim(counted, view.rgb))
