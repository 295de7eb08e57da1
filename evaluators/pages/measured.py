"""What the first screen says of steps beyond what was compared with the truth."""

from alpasim_plugin.core.json_types import JsonView
from alpasim_plugin.log.run_folder.rows import Rollout
from evaluators.metrics.measured import BEYOND, ON_PATH_M, UNKNOWN
from evaluators.statistics.numbers import plural
from evaluators.statistics.opening import Run
from evaluators.statistics.sentences import beyond_reason


def measured_cautions(run: Run) -> list[str]:
    """Return a sentence for each variant that drove where nothing was compared with the truth, and
    one for each of which it is not known.
    """
    cautions = []
    for variant, means in run.summary.metrics.items():
        share = means[BEYOND].mean if BEYOND in means else None
        if share:
            cautions.append(
                f"{variant}: {_percent(share)} of its steps lie {_beyond_text(run, variant)}."
            )
        censoring = run.summary.censoring.get(variant)
        invalid = None if censoring is None else censoring.invalid.get(BEYOND)
        for reason, rollouts in ({} if invalid is None else invalid.reasons).items():
            if reason in UNKNOWN:
                cautions.append(f"{variant}, {plural(rollouts, 'rollout')}: {reason}.")
    return cautions


def _beyond_text(run: Run, variant: str) -> str:
    """Say beyond which distance from the path nothing was compared in the scenes of a variant."""
    limits_m = set()
    reasons = set()
    for rollout in run.rollouts_of(variant):
        if rollout.metrics.get(BEYOND) is None:
            continue
        scene = run.scene_data(rollout.scene)
        limits_m.add(limit_m(scene, rollout))
        reasons.add(beyond_reason(scene))
    stated_m = sorted(limit for limit in limits_m if limit is not None)
    texts = [f"{limit:.2g}" for limit in stated_m]
    distance = f"beyond {' to '.join(texts[:1] + texts[1:][-1:])} m" if texts else "too far"
    return (
        f"{distance} beside the recorded path, turned away from it or behind its end, "
        f"{' or '.join(sorted(reasons))}"
    )


def limit_m(scene: JsonView | None, rollout: Rollout) -> float | None:
    """Return the distance from the path up to which a scene's file says that it was compared with the
    truth, metres; None where the run has no such file, or it says nothing.

    Args:
        scene: The file.
        rollout: Whose renderer and policy count on a built scene.
    """
    if scene is None:
        return None
    measured = scene.get("measured")
    if measured is not None:
        return max(float(measured["lateral_m"]), ON_PATH_M) if measured["n_photographs"] else 0.0
    for entry in scene.get("plan_ranges", ()):
        if (entry["renderer"], entry["policy"]) == (rollout.renderer, rollout.policy):
            near_to_m = entry["near_to_m"]
            return 0.0 if near_to_m is None else max(float(near_to_m), ON_PATH_M)
    return None


def _percent(share: float) -> str:
    """Return a share that is not 0 in percent, never as 0."""
    return f"{100 * share:.0f} %" if share >= 0.01 else "less than 1 %"
