"""Make the pictures and tables of docs/experiments/clean-and-3dgs.md.

    python docs/scripts/results.py DATA [RUNS]

DATA is the folder of third-party data sets (av2, commonroad, cosmos-drive-dreams); RUNS (default:
runs/results) keeps the run folders, so a second call continues an interrupted first one. Pictures
go to docs/img/, tables between the page's markers.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow.parquet as pq

from evaluators import aggregate, paired

DOCS = Path(__file__).resolve().parents[1]
SHOWN = (
    "collision_at_fault",
    "collision_any",
    "offroad",
    "route_distance_m",
    "progress",
    "min_distance_to_obstacle_m",
)
STRIP_PICK = (0, 1, 2)  # three of the strip's four frames


def inputs(data: Path) -> dict[str, str]:
    """Return picture name -> scenario argument."""
    return {
        "yaml-lead-car": "smoke/lead_car",
        "av2-7fab2350": str(data / "av2/7fab2350"),
        "av2-adcf7d18": str(data / "av2/adcf7d18"),
        "av2-3bffdcff": str(data / "av2/3bffdcff"),
        "commonroad-us101": str(data / "commonroad/USA_US101-3_3_T-1.xml"),
        "commonroad-lanker": str(data / "commonroad/USA_Lanker-1_1_T-1.xml"),
        "cosmos-clip": str(data / "cosmos-drive-dreams/example"),
    }


def simrun(out: Path, *args: str) -> dict[str, Any]:
    """Run simrun and return its summary."""
    command = [sys.executable, "-m", "alpasim_plugin.cli.main", *args, "--out", str(out)]
    print("+", "simrun", *args, flush=True)
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    summary: dict[str, Any] = json.loads((out / "summary.json").read_text())
    return summary


def picture(run: Path, scene: str, to: Path) -> None:
    """Write three frames of each renderer, clean above 3dgs, the same times in a column."""
    rows = []
    for renderer in ("clean", "3dgs"):
        strip = cv2.imread(
            str(run / "rollouts" / renderer / "lane-camera" / scene / "0" / "strip.jpg")
        )
        frames = np.array_split(strip, 4, axis=1)
        rows.append(
            np.concatenate(
                [
                    cv2.resize(frames[i], (512, 288), interpolation=cv2.INTER_CUBIC)
                    for i in STRIP_PICK
                ],
                axis=1,
            )
        )
    to.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(to), np.concatenate(rows, axis=0), [cv2.IMWRITE_JPEG_QUALITY, 82])


def number(entry: dict[str, Any], rate: bool) -> str:
    """Write mean, the paper's half-width, and the clustered interval."""
    if entry["mean"] is None:
        return "-"
    scale, digits = (100.0, 1) if rate else (1.0, 3)
    half = "" if entry["ci95"] is None else f" ± {scale * entry['ci95']:.{digits}f}"
    low_high = entry["ci95_clustered"]
    clustered = (
        ""
        if low_high is None
        else f" [{scale * low_high[0]:.{digits}f}, {scale * low_high[1]:.{digits}f}]"
    )
    return f"{scale * entry['mean']:.{digits}f}{half}{clustered}"


def table(summary: dict[str, Any]) -> str:
    """Return metrics x renderers, and the paired difference of the last renderer from the first."""
    names = list(summary["metrics"])
    lines = [
        "| metric | " + " | ".join(names) + " | paired difference, 95 % over scenes | p |",
        "|---" * (len(names) + 3) + "|",
    ]
    for metric in SHOWN:
        entries = [summary["metrics"][name][metric] for name in names]
        rate = entries[0]["unit"] == ""
        cells = [number(entry, rate) for entry in entries]
        pair = summary["paired"].get(names[-1], {}).get(metric)
        diff = p = "-"
        if pair and pair["diff"] is not None:
            scale, digits = (100.0, 1) if rate else (1.0, 3)
            bounds = (
                ""
                if pair["ci95"] is None
                else f" [{scale * pair['ci95'][0]:+.{digits}f}, {scale * pair['ci95'][1]:+.{digits}f}]"
            )
            diff = f"{scale * pair['diff']:+.{digits}f}{bounds}"
            p = "-" if pair["p_value"] is None else f"{pair['p_value']:.3f}"
        unit = " (%)" if rate else f" ({entries[0]['unit']})" if entries[0]["unit"] else ""
        lines.append(f"| `{metric}`{unit} | " + " | ".join(cells) + f" | {diff} | {p} |")
    return "\n".join(lines)


def pooled(runs: list[Path]) -> dict[str, Any]:
    """Return the tables of several runs of the same cells' kind taken together, as one summary."""
    rows = [row for run in runs for row in pq.read_table(run / "rollouts.parquet").to_pylist()]
    return {"metrics": aggregate(rows), "paired": paired(rows, "clean")}


def scene_table(run: Path) -> str:
    """Return one row per scene and renderer, averaged over seeds."""
    rows = pq.read_table(run / "rollouts.parquet").to_pylist()
    keys = list(dict.fromkeys((row["scene"], row["renderer"]) for row in rows))
    head = (
        "scene",
        "renderer",
        "at fault",
        "any contact",
        "off-road",
        "route distance (m)",
        "progress (%)",
    )
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for scene, renderer in keys:
        mine = [row for row in rows if (row["scene"], row["renderer"]) == (scene, renderer)]

        def count(metric: str, mine: list[dict[str, Any]] = mine) -> str:
            known = [row[metric] for row in mine if row[metric] is not None]
            return f"{int(sum(known))} of {len(known)}"

        def mean(metric: str, scale: float, mine: list[dict[str, Any]] = mine) -> str:
            known = [row[metric] for row in mine if row[metric] is not None]
            return f"{scale * float(np.mean(known)):.3f}" if known else "-"

        lines.append(
            f"| {scene} | {renderer} | {count('collision_at_fault')} | {count('collision_any')} | {count('offroad')} | "
            f"{mean('route_distance_m', 1)} | {mean('progress', 100)} |"
        )
    return "\n".join(lines)


def speed_table(summaries: dict[str, dict[str, Any]]) -> str:
    """Return time per camera frame by run and renderer."""
    stages = ("render", "policy", "control", "actors", "log")
    lines = [
        "| run | renderer | ms a frame, mean | p95 | frames/s | "
        + " | ".join(f"{s} p50" for s in stages)
        + " | pool frames/s |"
    ]
    lines.append("|---" * (6 + len(stages)) + "|")
    for name, summary in summaries.items():
        for renderer, speed in summary["speed"].items():
            cells = [
                f"{speed['stages'][s]['p50_ms']:.2f}" if s in speed["stages"] else "-"
                for s in stages
            ]
            pool = summary["pool"]["frames_per_s_total"]
            lines.append(
                f"| {name} | {renderer} | {speed['ms_per_frame_mean']} | {speed['ms_per_frame_p95']} | {speed['frames_per_s']} | "
                + " | ".join(cells)
                + f" | {pool} |"
            )
    return "\n".join(lines)


def replace(text: str, marker: str, content: str) -> str:
    """Replace what stands between a marker's two comments."""
    pattern = re.compile(rf"(<!-- begin {marker} -->\n).*?(<!-- end {marker} -->)", re.S)
    if not pattern.search(text):
        raise SystemExit(f"the page has no marker {marker}")
    return pattern.sub(lambda match: f"{match[1]}{content}\n{match[2]}", text)


def main() -> None:
    """Run everything and fill in the page."""
    data = Path(sys.argv[1])
    runs = Path(sys.argv[2] if len(sys.argv) > 2 else "runs/results")
    given = inputs(data)
    both = ("--renderer", "clean,3dgs", "--policy", "lane-camera", "--seeds", "3")
    real = simrun(runs / "real", *both, *given.values())
    simrun(
        runs / "replay", "--renderer", "clean", "--policy", "log-replay", *list(given.values())[1:]
    )
    suites = {
        name: simrun(runs / name, *both, f"suites/{name}")
        for name in ("smoke", "urban", "highway", "hard")
    }
    one = simrun(
        runs / "one",
        "--renderer",
        "clean,3dgs",
        "--policy",
        "lane-camera",
        "--workers",
        "1",
        "suites/smoke",
    )
    scenes = list(
        dict.fromkeys(
            row["scene"] for row in pq.read_table(runs / "real" / "rollouts.parquet").to_pylist()
        )
    )
    for name, scene in zip(given, scenes, strict=True):
        picture(runs / "real", scene, DOCS / "img" / f"drive-{name}.jpg")
    page = DOCS / "experiments" / "clean-and-3dgs.md"
    text = page.read_text()
    text = replace(text, "real", table(real) + "\n\n" + scene_table(runs / "real"))
    text = replace(text, "replay", scene_table(runs / "replay"))
    together = pooled([runs / name for name in suites])
    suites_text = [
        f"**{name}**\n\n{table(summary)}"
        for name, summary in {"all four together": together, **suites}.items()
    ]
    text = replace(text, "suites", "\n\n".join(suites_text))
    text = replace(
        text, "speed", speed_table({"one rollout at a time": one, "pooled": suites["smoke"]})
    )
    page.write_text(text)


if __name__ == "__main__":
    main()
