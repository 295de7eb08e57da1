"""What a reader must know of the policies and the renderers of a run, whether a rollout failed or
not.
"""

from evaluators.statistics.numbers import plural, short
from evaluators.statistics.opening import Run

MOST_BREACHES = 3  # of one policy that are said on the first screen


def policy_cautions(run: Run) -> list[str]:
    """Say what the check before the run found in each policy, and whose plans take longer and
    longer.
    """
    cautions = []
    for policy, check in run.info.policy_checks.items():
        sentences = [sentence for _, sentence in check.breaches]
        cautions += [
            f"The check of {policy} before the run: {sentence}"
            for sentence in sentences[:MOST_BREACHES]
        ]
        n_left_out = len(sentences[MOST_BREACHES:])
        if n_left_out:
            cautions.append(
                f"{plural(n_left_out, 'more breach', 'more breaches')} of {policy}: "
                f"simrun check policy {policy} names all."
            )
    for policy, slowing in run.summary.slowing.items():
        cautions.append(
            f"{policy} takes longer and longer: {short(slowing.early_ms)} ms for a plan in the first "
            f"quarter of a rollout, {short(slowing.late_ms)} ms in the last "
            f"(in {plural(slowing.n_rollouts, 'rollout')})."
        )
    return cautions


def drive_call_lines(run: Run, late: bool) -> list[str]:
    """Say how the drive calls of AlpaSim's drivers stand to the challenge's budget: of those with
    late calls, or of the others.
    """
    return [
        f"{policy}: {plural(calls.calls, 'drive call')} took {short(calls.seconds)} s of the "
        f"challenge's budget of {short(calls.budget_s)} s; "
        f"{calls.late} took longer, the longest {short(calls.longest_s)} s."
        for policy, calls in run.summary.drive_calls.items()
        if (calls.late > 0) == late
    ]


def unlit_lines(run: Run) -> list[str]:
    """Say which renderers gave no depth, so that no traffic light was drawn into their frames."""
    return [
        f"{renderer} gives no depth, so no traffic light was drawn into {plural(count, 'frame')} "
        "that look at one: a policy sees a lit one only where the renderer shows it by itself."
        for renderer, count in run.summary.unlit_frames.items()
    ]
