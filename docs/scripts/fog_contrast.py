"""Measure what weather leaves of contrast, before and after the fixer: in fog at 50 to 70 m,
otherwise in all of the image.

Usage: python docs/scripts/fog_contrast.py smoke/curve smoke/straight smoke/lead_car
"""

from __future__ import annotations

import sys

import numpy as np

from alpasim_plugin import load_scenario, make_renderer
from alpasim_plugin.runs.gpu_check import frame_request

EVERYWHERE_M = (0.0, 1e6)
WEATHER = {
    "fog_visibility_m=100": (50.0, 70.0),
    "time=day": EVERYWHERE_M,
    "time=night": EVERYWHERE_M,
    "time=low_sun": EVERYWHERE_M,
    "rain=20": EVERYWHERE_M,
}


def contrasts(scene: str, weather: str) -> dict[str, float]:
    """Return the spread of grey levels behind each renderer."""
    scenario = load_scenario(scene, overrides=[f"environment.{weather}"])
    request = frame_request(scenario, 512, 288)
    names = ("clean", "3dgs", "onefixer")
    frames = {name: make_renderer(name, scenario).render(request) for name in names}
    depth = frames["clean"].depth
    assert depth is not None, "clean gives depth"
    low_m, high_m = WEATHER[weather]
    compared = (depth > low_m) & (depth < high_m)
    return {name: float(frame.rgb.mean(axis=2)[compared].std()) for name, frame in frames.items()}


if __name__ == "__main__":
    for weather in WEATHER:
        kept = []
        for scene in sys.argv[1:]:
            spread = contrasts(scene, weather)
            kept.append(spread["onefixer"] / spread["3dgs"])
            print(weather, scene, {name: round(value, 1) for name, value in spread.items()})
        print(f"{weather}: onefixer keeps {np.mean(kept):.2f} of its input's contrast")
