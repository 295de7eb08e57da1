"""Measure how the errors of the fitted degradations and of the surrogate look: ``python
docs/scripts/degradations.py SCENARIO...``.

Prints Markdown: for every kind the PSNR, SSIM, share of fine detail kept, spectrum of the error,
holes and how the error changes from frame to frame, on the logged path and beside it; means over
scenes and frames. ``--picture FILE`` also writes what the kinds show of the first scene.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from alpasim_plugin.core.image_metrics import psnr_db, ssim
from alpasim_plugin.core.interfaces import Renderer
from alpasim_plugin.core.types import F64, U8, Degradation, Frame, RenderRequest, Scenario
from alpasim_plugin.gaussians.scene.degrade import log_actors
from alpasim_plugin.lab.training.pair_sheet import HOLE_BELOW
from alpasim_plugin.lab.training.pairs import offset_from_log
from alpasim_plugin.renderers import make_renderer
from scenarios.load import load_scenario

KINDS = {
    "reconstruction": Degradation("reconstruction"),
    "cycle": Degradation("cycle"),
    "surrogate": Degradation("surrogate"),
}
OFFSETS_M = (0.0, 0.75, 1.5, 3.0)
BANDS = ((0.0, 1 / 16), (1 / 16, 1 / 6), (1 / 6, 0.75))  # cycles a pixel
FRAMES, STEP_US = 6, 100_000


@dataclass(frozen=True)
class Row:
    """Numbers of one kind at one distance: see `measure`."""

    psnr_db: float
    ssim: float
    detail: float
    spectrum: tuple[float, ...]
    holes: float
    flicker: float


def frame(renderer: Renderer, scenario: Scenario, t_us: int, left_m: float) -> Frame:
    """Render what the first camera sees from a place beside the log."""
    camera = scenario.cameras[0]
    T = offset_from_log(scenario, t_us, left_m) @ camera.T_rig_camera
    return renderer.render(
        RenderRequest(t_us, camera, np.stack([T, T]), log_actors(scenario, t_us))
    )


class Remembered:
    """A renderer whose frames are kept by time and place, because every kind is held against the
    same ones.
    """

    def __init__(self, renderer: Renderer) -> None:
        self.renderer = renderer
        self.frames: dict[tuple[int, bytes], Frame] = {}

    def render(self, request: RenderRequest) -> Frame:
        """Render a frame, or return the one rendered before."""
        key = (request.t_us, request.T_world_camera.tobytes())
        if key not in self.frames:
            self.frames[key] = self.renderer.render(request)
        return self.frames[key]


def measure(bad: Renderer, clean: Renderer, scenario: Scenario, left_m: float) -> Row:
    """Measure at moments spread over the drive.

    Detail is the gradient energy of the render over that of the truth; the spectrum is the error's
    power by spatial frequency, as shares; flicker is the mean absolute change of the error between
    frames 0.1 s apart, in grey levels.
    """
    times = (
        np.linspace(scenario.start_us, scenario.end_us - STEP_US, FRAMES).astype(np.int64).tolist()
    )
    rows = []
    for t_us in times:
        a, b = frame(bad, scenario, t_us, left_m), frame(clean, scenario, t_us, left_m)
        later = [
            frame(r, scenario, t_us + STEP_US, left_m).rgb.astype(np.float64) for r in (bad, clean)
        ]
        error = a.rgb.astype(np.float64) - b.rgb
        assert a.alpha is not None
        rows.append(
            [
                psnr_db(a.rgb, b.rgb),
                ssim(a.rgb, b.rgb),
                _detail(a.rgb) / _detail(b.rgb),
                *_spectrum(error),
                float(np.mean(a.alpha < HOLE_BELOW / 255)),
                float(np.mean(np.abs(later[0] - later[1] - error))),
            ]
        )
    mean = np.mean(rows, axis=0)
    return Row(mean[0], mean[1], mean[2], tuple(mean[3:-2]), mean[-2], mean[-1])


def _detail(rgb: U8) -> float:
    grey = cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY).astype(np.float64)
    return float(np.mean(np.diff(grey, axis=0) ** 2) + np.mean(np.diff(grey, axis=1) ** 2))


def _spectrum(error: F64) -> list[float]:
    grey = error.mean(axis=2)
    power = np.abs(np.fft.fft2(grey - grey.mean())) ** 2
    radius = np.hypot(
        *np.meshgrid(np.fft.fftfreq(grey.shape[0]), np.fft.fftfreq(grey.shape[1]), indexing="ij")
    )
    return [
        float(power[(radius >= low) & (radius < high)].sum() / power.sum()) for low, high in BANDS
    ]


def main() -> None:
    """Measure the scenarios of the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenarios", nargs="+")
    parser.add_argument("--picture", help="write a picture here")
    args = parser.parse_args()
    rows: dict[tuple[str, float], list[Row]] = {}
    for number, name in enumerate(args.scenarios):
        scenario = load_scenario(name)
        clean: Renderer = Remembered(make_renderer("clean", scenario, threads=1))
        renderers = {
            kind: make_renderer("3dgs", replace(scenario, degradation=amount), threads=1)
            for kind, amount in KINDS.items()
        }
        for kind, renderer in renderers.items():
            for left_m in OFFSETS_M:
                sides = (left_m,) if left_m == 0 else (left_m, -left_m)
                rows.setdefault((kind, left_m), []).extend(
                    measure(renderer, clean, scenario, side) for side in sides
                )
        if args.picture and number == 0:
            cv2.imwrite(args.picture, picture({**renderers, "clean": clean}, scenario)[..., ::-1])
    print(table(rows))


def picture(renderers: dict[str, Renderer], scenario: Scenario) -> U8:
    """Return one row a kind; columns: on the path early and late, 1.5 m beside it, and the opacity
    there.
    """
    t = [
        int(scenario.start_us + share * (scenario.end_us - scenario.start_us))
        for share in (0.15, 0.6)
    ]
    lines = []
    for renderer in renderers.values():
        frames = [
            frame(renderer, scenario, t[0], 0.0),
            frame(renderer, scenario, t[1], 0.0),
            frame(renderer, scenario, t[1], 1.5),
        ]
        alpha = np.asarray(frames[-1].alpha) * 255
        tiles = [f.rgb for f in frames] + [np.repeat(alpha.astype(np.uint8)[..., None], 3, axis=2)]
        lines.append(np.concatenate(tiles, axis=1))
    return np.concatenate(lines)


def table(rows: dict[tuple[str, float], Sequence[Row]]) -> str:
    """Return the means as a Markdown table."""
    lines = [
        "| kind | beside the path | PSNR, dB | SSIM | detail kept | error low / middle / high | holes | flicker |",
        "|---" * 8 + "|",
    ]
    for (kind, left_m), measured in rows.items():
        mean = [
            np.mean([getattr(r, name) for r in measured], axis=0)
            for name in Row.__dataclass_fields__
        ]
        bands = " / ".join(f"{share:.0%}" for share in mean[3])
        lines.append(
            f"| {kind} | {left_m:g} m | {mean[0]:.1f} | {mean[1]:.3f} | {mean[2]:.0%} | {bands} | {mean[4]:.1%} | {mean[5]:.1f} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
