"""What surrounds a training scene, what its camera is, and how its reconstruction is damaged; the
test of unseen looks has its own ranges.

| | training, validation, known test | unseen test |
|---|---|---|
| light | clear, overcast | dusk in half of the scenes |
| texture | 0.35 to 1 | bare (0 to 0.15) in half |
| buildings | up to 26 m, 4 m at least | sheds below 3.6 m or towers of 32 to 60 m in two thirds |
| trees | up to 9 per 100 m | 13 to 18 per 100 m in a third |
| damage | `KNOWN_DAMAGE` | one of `UNSEEN_DAMAGE`, always |
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from alpasim_plugin.lab.training.scene_draws import Rng, Spec, log_number, number, pick, sign

Range = tuple[float, float]
CYCLE_SHARE = 0.4  # of the scenes, the others are reconstructions of the logged path
SIZES = {(256, 144): 0.8, (384, 216): 0.1, (512, 288): 0.1}  # of training cameras, and their shares
OWN_CAMERA_SHARE = 0.5  # of training cameras of 256x144: drawn; the others are the default camera


@dataclass(frozen=True)
class DamageRanges:
    """From where the keys of ``degradation`` are drawn.

    Attributes:
        share: Of the fit's schedule; its logarithm is uniform.
        views_per_s: Views per second of log; its logarithm is uniform.
        depth_error: Spread of the depth of the first points.
        pose_error_m: Spread of the views' poses; half of the scenes have none where the range
            begins at 0.
        shift_m: Cycle: lateral offset of the fitted views, to either side.
    """

    share: Range = (0.05, 0.5)
    views_per_s: Range = (3.0, 8.0)
    depth_error: Range = (0.03, 0.15)
    pose_error_m: Range = (0.0, 0.06)
    shift_m: Range = (0.5, 1.25)


KNOWN_DAMAGE = DamageRanges()
UNSEEN_DAMAGE = (
    replace(KNOWN_DAMAGE, share=(0.025, 0.04), shift_m=(1.6, 2.2)),
    replace(KNOWN_DAMAGE, views_per_s=(1.5, 2.2), shift_m=(1.6, 2.2)),
    replace(KNOWN_DAMAGE, depth_error=(0.2, 0.3), shift_m=(1.6, 2.2)),
    replace(KNOWN_DAMAGE, pose_error_m=(0.1, 0.18), shift_m=(1.6, 2.2)),
)


def draw_damage(rng: Rng, ranges: DamageRanges, kind: str | None = None) -> Spec:
    """Return the section ``degradation`` of a scene, of a kind that is drawn where none is
    given.
    """
    random_kind = "cycle" if rng.random() < CYCLE_SHARE else "reconstruction"
    out: Spec = {"kind": kind or random_kind, "share": log_number(rng, *ranges.share)}
    out |= {
        "views_per_s": log_number(rng, *ranges.views_per_s, digits=2),
        "depth_error": number(rng, *ranges.depth_error, digits=3),
    }
    posed = rng.random() < 0.5
    pose_error_m = number(rng, *ranges.pose_error_m, digits=3)
    out["pose_error_m"] = pose_error_m if posed or ranges.pose_error_m[0] > 0 else 0.0
    shift_m = sign(rng) * number(rng, *ranges.shift_m)
    return out | ({"shift_m": shift_m} if out["kind"] == "cycle" else {})


def draw_camera(rng: Rng) -> Spec:
    """Return a camera of training: mostly small, of several sizes, fields of view and mounts."""
    sizes: Mapping[tuple[int, int], float] = SIZES
    width, height = list(sizes)[int(rng.choice(len(sizes), p=list(sizes.values())))]
    varies_mount = rng.random() < OWN_CAMERA_SHARE
    fov = number(rng, 55, 100, 1)
    z_m = number(rng, 1.2, 2.2)
    pitch = number(rng, 0, 8, 1)
    x_m = number(rng, 0.8, 2.0)
    mount = (
        {"hfov_deg": fov, "z_m": z_m, "pitch_down_deg": pitch, "x_m": x_m} if varies_mount else {}
    )
    return {"width": width, "height": height} | mount


def draw_rig(rng: Rng) -> list[Spec]:
    """Return three cameras: front, left and right, of several mounts, the sides alike."""
    front = {"name": "front", "hfov_deg": number(rng, 72, 85, 1), "z_m": number(rng, 1.3, 1.7)}
    front["pitch_down_deg"] = number(rng, 0, 6, 1)
    side = {"width": 200, "height": 100, "hfov_deg": number(rng, 78, 90, 1)}
    side |= {"x_m": number(rng, 1.4, 2.2), "z_m": number(rng, 1.1, 1.6)}
    yaw_deg = number(rng, 55, 65, 1)
    out_m = number(rng, 0.4, 0.95)
    left = {"name": "left", "y_m": out_m, "yaw_deg": yaw_deg}
    right = {"name": "right", "y_m": -out_m, "yaw_deg": -yaw_deg}
    return [front, left | side, right | side]


def known_surroundings(rng: Rng) -> Spec:
    """Return surroundings of training."""
    low = number(rng, 4, 10, 1)
    return {
        "buildings": number(rng, 0, 1),
        "building_height_m": [low, min(26.0, low + number(rng, 2, 18, 1))],
        "trees_per_100m": number(rng, 0, 9, 1),
        "poles_spacing_m": pick(rng, 0, 20, 25, 30, 40),
        "sky": pick(rng, "clear", "overcast"),
        "texture": number(rng, 0.35, 1.0),
    }


def unseen_surroundings(rng: Rng) -> Spec:
    """Return surroundings that training never sees, by one key or more."""
    out = known_surroundings(rng)
    dusk = rng.random() < 0.5
    bare = rng.random() < 0.5
    style = int(rng.integers(3))
    woods = rng.random() < 1 / 3
    if dusk:
        out["sky"] = "dusk"
    if bare:
        out["texture"] = number(rng, 0.0, 0.15)
    if style == 1:
        out |= {
            "buildings": number(rng, 0.7, 1.0),
            "building_height_m": [number(rng, 2.4, 2.8, 1), number(rng, 2.9, 3.6, 1)],
        }
    if style == 2:
        out |= {
            "buildings": number(rng, 0.8, 1.0),
            "building_height_m": [number(rng, 32, 38, 1), number(rng, 45, 60, 1)],
        }
    if woods or not (dusk or bare or style):
        out["trees_per_100m"] = number(rng, 13, 18, 1)
    return out
