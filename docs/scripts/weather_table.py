"""Drive the shipped policies of cameras in every weather, and print how their rollouts ended.

Usage: python docs/scripts/weather_table.py OUT smoke/straight [SCENE...]

The shipped policies without a camera drive the same in any weather and are left out. The same
command continues after an interruption.
"""

from __future__ import annotations

import sys
from pathlib import Path

from alpasim_plugin.cli.main import run_command
from evaluators.metrics.outcomes import OUTCOMES
from evaluators.opening import read_run

RENDERERS = ("clean", "3dgs", "onefixer")
POLICIES = ("lane-camera", "learned")
WEATHER = ("time=day", "time=low_sun", "time=night", "rain=20", "fog_visibility_m=100")


def drive(out: Path, weather: str, scenes: list[str]) -> Path:
    """Drive all variants in one weather, and return the run's folder."""
    folder = out / weather.partition("=")[2]
    command = ["--renderer", ",".join(RENDERERS), "--policy", ",".join(POLICIES), *scenes]
    options = ["--set", f"environment.{weather}", "--video", "none", "--workers", "1"]
    run_command([*command, *options, "--out", str(folder)])
    return folder


def cells(folder: Path) -> dict[tuple[str, str], str]:
    """Return for each policy and renderer how many drives had no event, and their distance."""
    found = {}
    rollouts = read_run(folder).rollouts
    for policy in POLICIES:
        for renderer in RENDERERS:
            mine = [one for one in rollouts if (one.policy, one.renderer) == (policy, renderer)]
            clear = [one for one in mine if not any(one.metrics.get(name) for name in OUTCOMES)]
            metres = [one.metrics["lateral_distance_m"] for one in mine]
            known = [value for value in metres if value is not None]
            mean_m = f"{sum(known) / len(known):.2f} m" if known else "no distance"
            found[policy, renderer] = f"{len(clear)} of {len(mine)}, {mean_m}"
    return found


if __name__ == "__main__":
    out, scenes = Path(sys.argv[1]), sys.argv[2:]
    columns = {weather: cells(drive(out, weather, scenes)) for weather in WEATHER}
    print("| policy | renderer |", " | ".join(WEATHER), "|")
    print("|---|---|" + "---|" * len(WEATHER))
    for policy, renderer in columns[WEATHER[0]]:
        shown = [column[policy, renderer] for column in columns.values()]
        print(f"| {policy} | {renderer} |", " | ".join(shown), "|")
