"""Whether what a renderer does to plans on the recorded path goes with what it does to drives.

Of a built scene it is measured, for each policy and renderer, how far plans move along the recorded
path (`plan_gap`), how far its images are from those of `clean` there, how far the policy drives from
where it drove behind `clean`, and whether the outcome changed. Over many scenes, ranks of the
former are compared with ranks of the latter.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from typing import Any

import numpy as np

from alpasim_plugin.core.image_metrics import psnr_db
from alpasim_plugin.core.interfaces import Policy, Renderer, complete
from alpasim_plugin.core.parts import PartSpec, build
from alpasim_plugin.core.types import U8, CameraSpec, RolloutLog, Scenario
from alpasim_plugin.lab.bench.drawn_series import drawn_series, offset_requests
from alpasim_plugin.lab.bench.open_loop import sensors_of
from alpasim_plugin.lab.bench.plan_gap import Row, gap_rows
from alpasim_plugin.lab.bench.real import Judges, Report, rendered_images
from alpasim_plugin.lab.video_metrics.image_distance import image_distances
from alpasim_plugin.runs.recorder import Recorder
from alpasim_plugin.runs.rollout import run_rollout
from evaluators.metrics.score import score
from evaluators.statistics.intervals import Interval
from evaluators.statistics.rank_correlation import group_difference, group_spearman
from evaluators.statistics.reduce import rollout_values

Makers = Mapping[str, Callable[[], Renderer]]
TRUTH = "clean"
EVENT = "offroad_or_collision_at_fault"
IMAGE_STEP = 5  # frames between those whose images are compared: neighbours are nearly the same
# Each is worse where it is larger; of PSNR and JOD the negative is taken.
PREDICTORS = (
    "lateral_2s_m",
    "along_2s_m",
    "brakes_in_one",
    "psnr_db",
    "perceptual_syn",
    "cvvdp_jod",
)
BETTER_HIGHER = ("psnr_db", "cvvdp_jod")
OUTCOMES = ("drive_apart_m", "outcome_changed")
ANCHOR = "psnr_db"  # what the others are compared with


def measure_scene(
    scenario: Scenario,
    makers: Makers,
    policies: Sequence[PartSpec],
    judges: Judges,
    seed: int,
    report: Report | None = None,
) -> list[Row]:
    """Return what one scene says of each policy and renderer: a row of `PREDICTORS` and `OUTCOMES`;
    None where something was not measured.

    Args:
        scenario: A built scene.
        makers: Name to what makes a session of a renderer; one is `TRUTH`, the others have rows.
        policies: Each with cameras that the scene has.
        judges: Of the images.
        seed: Of the noise of policies, in both loops the same.
        report: Called with a subject, frames or drives done, and all.

    Raises:
        InputError: A policy cannot be asked in this scene.
        PolicyError: A policy raised, or broke its contract.
    """
    cameras_of = {
        policy.name: [sensor.camera for sensor in sensors_of(policy, scenario)]
        for policy in policies
    }
    by_name: dict[str, CameraSpec] = {camera.name: camera for camera in scenario.cameras}
    used = dict.fromkeys(name for names in cameras_of.values() for name in names)
    requests = {name: offset_requests(scenario, by_name[name], 0.0) for name in used}
    images = rendered_images(makers, requests, report)
    true_images = images.pop(TRUTH)
    series = drawn_series(requests, true_images, 0.0)
    rows = []
    for policy in policies:
        names = cameras_of[policy.name]
        images_of_policy = {
            renderer: {name: made[name] for name in names} for renderer, made in images.items()
        }
        gaps, _ = gap_rows(
            scenario.scene_id,
            scenario,
            policy,
            {name: series[name] for name in names},
            images_of_policy,
            seed,
        )
        drives = _drives(scenario, makers, policy, seed)
        for gap in gaps:
            renderer = gap["renderer"]
            rows.append(
                {
                    "scene": scenario.scene_id,
                    "policy": policy.name,
                    "renderer": renderer,
                    **{name: gap[name] for name in ("lateral_2s_m", "along_2s_m", "brakes_in_one")},
                    **_image_values(true_images, images_of_policy[renderer], judges),
                    **_drive_values(scenario, drives[TRUTH], drives[renderer]),
                }
            )
    return rows


def _drives(
    scenario: Scenario, makers: Makers, policy_spec: PartSpec, seed: int
) -> dict[str, RolloutLog]:
    """Return what a policy drives behind each renderer."""
    logs = {}
    for renderer, make in makers.items():
        policy = complete(build(policy_spec, scenario=scenario), Policy)
        with closing(policy), Recorder(scenario, seed, images="none") as recorder:
            run_rollout(scenario, make(), policy, seed, recorder)
            logs[renderer] = recorder.log(images=False)
    return logs


def _image_values(
    true_images: Mapping[str, Sequence[U8]], images: Mapping[str, Sequence[U8]], judges: Judges
) -> dict[str, float | None]:
    """Return the mean distance of images from the true ones, over cameras and every fifth frame."""
    truth = np.concatenate([np.stack(true_images[name][::IMAGE_STEP]) for name in images])
    made = np.concatenate([np.stack(images[name][::IMAGE_STEP]) for name in images])
    psnr = [psnr_db(image, true_image) for image, true_image in zip(made, truth, strict=True)]
    jod = None if judges.vdp is None else float(np.mean(judges.vdp.jod(made, truth)))
    return {
        "psnr_db": float(np.mean(psnr)),
        "perceptual_syn": float(np.mean(image_distances(judges.perceptual, made, truth))),
        "cvvdp_jod": jod,
    }


def _drive_values(
    scenario: Scenario, true_drive: RolloutLog, drive: RolloutLog
) -> dict[str, float | None]:
    outcomes = [
        rollout_values(score(log, scenario.scene, "strict"), "strict")[EVENT]
        for log in (true_drive, drive)
    ]
    is_scored = all(outcome.valid for outcome in outcomes)
    changed = float(outcomes[0].value != outcomes[1].value) if is_scored else None
    return {"drive_apart_m": apart_m(true_drive, drive), "outcome_changed": changed}


def apart_m(drive: RolloutLog, other: RolloutLog) -> float:
    """Return the mean distance of the egos of two drives of one scene at the same times, plan view,
    over the times that both have; the first, forced, steps count as well.
    """
    _, first, second = np.intersect1d(drive.ego.t_us, other.ego.t_us, return_indices=True)
    steps = other.ego.xyz[second, :2] - drive.ego.xyz[first, :2]
    return float(np.mean(np.hypot(*steps.T)))


def correlation_rows(units: Sequence[Row]) -> list[dict[str, Any]]:
    """Return, for each policy, outcome and predictor, the rank correlation over all scenes and
    renderers with its interval by scenes, and by how much it exceeds that of PSNR.

    Coefficients are positive where worse predictors go with worse outcomes. Of a predictor that some
    scenes lack, only those that have it count, and ``scenes`` says how many.

    Args:
        units: Rows of `measure_scene` of any number of scenes.
    """
    rows = []
    for policy in dict.fromkeys(unit["policy"] for unit in units):
        of_policy = [unit for unit in units if unit["policy"] == policy]
        for outcome in OUTCOMES:
            for predictor in PREDICTORS:
                complete_units = [
                    unit
                    for unit in of_policy
                    if None not in (unit[predictor], unit[outcome], unit[ANCHOR])
                ]
                rows.append(
                    {
                        "policy": policy,
                        "outcome": outcome,
                        "predictor": predictor,
                        "scenes": len({unit["scene"] for unit in complete_units}),
                        "units": len(complete_units),
                        "changed": sum(unit[outcome] > 0 for unit in complete_units),
                        **_correlation(complete_units, predictor, outcome),
                    }
                )
    return rows


def _correlation(units: Sequence[Row], predictor: str, outcome: str) -> dict[str, Any]:
    scenes = [unit["scene"] for unit in units]
    values = np.array([unit[outcome] for unit in units], dtype=np.float64)
    predicted = _worse(units, predictor)
    rank = group_spearman(predicted, values, scenes)
    gain = group_difference(predicted, _worse(units, ANCHOR), values, scenes)
    return {
        **_printed("spearman", rank),
        **_printed("minus_psnr", None if predictor == ANCHOR else gain),
    }


def _worse(units: Sequence[Row], predictor: str) -> Any:
    """Return the values ``(N,)`` of a predictor, larger where it is worse."""
    values = np.array([unit[predictor] for unit in units], dtype=np.float64)
    return -values if predictor in BETTER_HIGHER else values


def _printed(name: str, interval: Interval | None) -> dict[str, Any]:
    if interval is None:
        return {name: None, f"{name}_ci95": None}
    bounds = None if interval.bounds is None else [round(bound, 3) for bound in interval.bounds]
    return {name: round(interval.centre, 3), f"{name}_ci95": bounds}
