"""Measure what fog leaves of a contrast at 60 m, before and after the fixer.

Usage: python docs/scripts/fog_contrast.py smoke/curve smoke/straight smoke/lead_car
"""

from __future__ import annotations

import sys

import numpy as np

from alpasim_plugin import load_scenario, make_renderer
from alpasim_plugin.runs.gpu_check import frame_request

VISIBILITY_M = 100
BAND_M = (50.0, 70.0)


def contrasts(scene: str) -> dict[str, float]:
    """Return the spread of grey levels at 50 to 70 m behind each renderer."""
    scenario = load_scenario(scene, overrides=[f"environment.fog_visibility_m={VISIBILITY_M}"])
    request = frame_request(scenario, 512, 288)
    frames = {
        name: make_renderer(name, scenario).render(request)
        for name in ("clean", "3dgs", "onefixer")
    }
    depth = frames["clean"].depth
    assert depth is not None, "clean gives depth"
    at_60_m = (depth > BAND_M[0]) & (depth < BAND_M[1])
    return {name: float(frame.rgb.mean(axis=2)[at_60_m].std()) for name, frame in frames.items()}


if __name__ == "__main__":
    kept = []
    for scene in sys.argv[1:]:
        spread = contrasts(scene)
        kept.append(spread["onefixer"] / spread["3dgs"])
        print(scene, {name: round(value, 1) for name, value in spread.items()})
    print(f"onefixer keeps {np.mean(kept):.2f} of its input's contrast")
