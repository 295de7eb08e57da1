"""What the first screen says of steps beyond what a reconstruction was compared with."""

from evaluators.metrics.measured import BEYOND
from evaluators.results import Summary


def measured_cautions(summary: Summary) -> list[str]:
    """Return a sentence for each variant that drove where no render was compared with a photograph."""
    cautions = []
    for variant, means in summary.metrics.items():
        share = means[BEYOND].mean if BEYOND in means else None
        if share:
            cautions.append(
                f"{variant}: {_percent(share)} of its steps in reconstructed drives lie farther from the "
                "recorded path than any photograph that a render was compared with."
            )
    return cautions


def _percent(share: float) -> str:
    """Return a share that is not 0 in percent, never as 0."""
    return f"{100 * share:.0f} %" if share >= 0.01 else "less than 1 %"
