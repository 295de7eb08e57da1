"""Drive policies with cameras in every weather on 20 drawn streets, and count the rollouts without
an event; or measure what weather leaves of contrast at 50 to 70 m, before and after the fixer.

Usage: python docs/scripts/weather_table.py FOLDER | contrast; it continues when it is interrupted.
Policies without a camera drive alike in any weather and are left out.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import yaml
from pages import table

from alpasim_plugin import load_scenario, make_renderer
from alpasim_plugin.cli.main import run_command
from alpasim_plugin.log.run_folder.reader import Run
from alpasim_plugin.runs.gpu_check import frame_request
from evaluators.metrics.outcomes import OUTCOMES
from evaluators.statistics.bounded import rate_interval

RENDERERS = ("clean", "3dgs", "onefixer")
POLICIES = ("lane-camera", "learned")
STREETS = ("smoke/straight", "smoke/curve", "smoke/lead_car")
SCENES = [{"path": STREETS[i % 3], "seeds": [1 + i // 3]} for i in range(20)]
SHARES = range(0, 20, 5)  # first scene of each: a table may be read when a part is driven
WEATHER = {
    "day": "time=day",
    "snow": "snow=2",
    "night": "time=night",
    "fog": "fog_visibility_m=100",
    "rain": "rain=20",
    "low_sun": "time=low_sun",
}


def drive(out: Path, renderer: str, first: int, weather: str) -> None:
    """Drive five scenes for five seconds behind a renderer in one weather."""
    suite = out / f"scenes-{first}.yaml"
    suite.parent.mkdir(parents=True, exist_ok=True)
    suite.write_text(yaml.safe_dump({"version": 1, "scenarios": SCENES[first : first + 5]}))
    settings = [f"environment.{WEATHER[weather]}", "timing.duration_us=5000000"]
    variants = ["--renderer", renderer, "--policy", ",".join(POLICIES), str(suite)]
    options = [word for one in settings for word in ("--set", one)]
    folder = str(out / renderer / weather / str(first))
    run_command([*variants, *options, "--video", "none", "--workers", "1", "--out", folder])


def counted(out: Path, renderer: str, policy: str, weather: str) -> str:
    """Return how many rollouts had no event, with the interval of their share in percent."""
    runs = [Run.read_so_far(one) for one in (out / renderer / weather).glob("*")]
    rollouts = [one for run in runs for one in run.rollouts if one.policy == policy]
    clear = [float(not any(one.metrics.get(name) for name in OUTCOMES)) for one in rollouts]
    if len(clear) < 2:
        return "not driven"
    bounds = rate_interval(np.array(clear)).bounds or []
    interval = " to ".join(f"{100 * bound:.0f}" for bound in bounds)
    return f"{sum(clear):.0f} of {len(clear)} ({interval} %)"


def contrasts(weather: str) -> Iterator[float]:
    """Yield the spread of grey levels at 50 to 70 m behind ``onefixer`` over that behind ``3dgs``."""
    for street in STREETS:
        scenario = load_scenario(street, overrides=[f"environment.{WEATHER[weather]}"])
        request = frame_request(scenario, 512, 288)
        frames = {name: make_renderer(name, scenario).render(request) for name in RENDERERS}
        depth = frames["clean"].depth
        assert depth is not None, "clean gives depth"
        compared = (depth > 50) & (depth < 70)
        spread = {name: frame.rgb.mean(axis=2)[compared].std() for name, frame in frames.items()}
        print(weather, street, {name: round(float(value), 1) for name, value in spread.items()})
        yield float(spread["onefixer"] / spread["3dgs"])


if __name__ == "__main__":
    if sys.argv[1] == "contrast":
        kept = {weather: np.mean([*contrasts(weather)]) for weather in WEATHER}
        print({weather: f"{value:.2f}" for weather, value in kept.items()})
        sys.exit()
    folder = Path(sys.argv[1])
    for renderer in RENDERERS:
        for first in SHARES:
            for weather in WEATHER:
                drive(folder, renderer, first, weather)
    rows = [
        [renderer, policy, *(counted(folder, renderer, policy, weather) for weather in WEATHER)]
        for renderer in RENDERERS
        for policy in POLICIES
    ]
    print(table(["renderer", "policy", *WEATHER], rows))
