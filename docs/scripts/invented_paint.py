"""Does a fixer paint lines that are not there when its map is wrong?

python docs/scripts/invented_paint.py data/pairs --split val --fixer
"onefixer[references=0],onefixer" --frames 31

Every clip is fixed with its own map, with none, and with the map of the next clip, which is another
street's. Prints for each: painted pixels a frame that no paint of the truth explains; their share
of all painted pixels; and the share of the truth's paint that is shown
(`alpasim_plugin.lab.bench.lane_paint`). The road is the plane below the rig around the driven path.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from gain_by_class import videos
from trust_calibration import asked_for

from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.types import U8, HeightField
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.lab.bench.lane_paint import PaintCounts, Road, compare_paint, road_of
from alpasim_plugin.lab.bench.quality import QualityClip


def roads_of(clip: QualityClip) -> list[Road]:
    """Return the road of each frame: level at the rig's height, beside the path from the first
    frame to 40 m past the last.
    """
    recorded = clip.recorded
    if recorded is None:
        raise SystemExit(f"{clip.name} has no poses: it was made without references")
    rigs = [recorded.T_world_rig(i) for i in range(len(clip.t_us))]
    ahead = rigs[-1][:3, 3] + 40.0 * rigs[-1][:3, 0]
    path = np.array([*(T[:3, 3] for T in rigs[::5]), rigs[-1][:3, 3], ahead])
    height, width = clip.truth.shape[1:3]
    roads = []
    for i, T in enumerate(rigs):
        ground = HeightField(float(T[0, 3]), float(T[1, 3]), 1.0, np.full((2, 2), T[2, 3]))
        roads.append(
            road_of(
                PinholeCamera(width, height, recorded.K, inverse(recorded.T_world_camera[i])),
                ground,
                path,
            )
        )
    return roads


def counts(video: U8, truth: U8, roads: list[Road]) -> PaintCounts:
    """Add up the painted pixels of all frames."""
    total = PaintCounts()
    for made, true, road in zip(video, truth, roads, strict=True):
        total += compare_paint(np.ascontiguousarray(made), np.ascontiguousarray(true), road)
    return total


def main() -> None:
    """Measure and print."""
    names, clips = asked_for(__doc__, "onefixer[references=0],onefixer")
    roads = [roads_of(clip) for clip in clips]
    frames = sum(len(clip.t_us) for clip in clips)
    rows: dict[tuple[str, str], PaintCounts] = {}
    for i, clip in enumerate(clips):
        others = [
            other
            for other in (*clips[i + 1 :], *clips[:i])
            if other.sdmap.shape == clip.sdmap.shape
        ]
        maps = {
            "its own": clip.sdmap,
            "none": np.zeros_like(clip.sdmap),
            "another street's": others[0].sdmap,
        }
        for word, sdmap in maps.items():
            made = videos(replace(clip, sdmap=sdmap), names)
            for name, video in zip(("3dgs", *names), made, strict=True):
                found = counts(video, np.asarray(clip.truth), roads[i])
                rows[word, name] = rows.get((word, name), PaintCounts()) + found
    print(
        "| map | renderer | invented paint, pixels a frame | share of its paint | recall |\n|---|---|---:|---:|---:|"
    )
    for (word, name), found in rows.items():
        invented = found.made - found.made_true
        print(
            f"| {word} | {name} | {invented / frames:.1f} | {invented / found.made:.1%} | {found.recall:.3f} |"
        )


if __name__ == "__main__":
    main()
