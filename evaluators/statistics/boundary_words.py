"""Words for what driven points say, which the gate and pages share."""

from alpasim_plugin.core.json_types import JsonView
from evaluators.statistics.numbers import fixed, plural


def apart_text(record: JsonView) -> str:
    """Write how far apart the first points stand, such as ``0.5 m`` or ``1 m by 0.5 m/s``.

    Args:
        record: The member ``boundary`` of ``summary.json``.
    """
    if isinstance(record["unit"], list):
        sides = zip(record["spacing"], record["unit"], strict=True)
        return " by ".join(f"{spacing:.4g} {unit}".rstrip() for spacing, unit in sides)
    return f"{record['apart']:.4g} {record['unit']}".rstrip()


def difference_text(difference: JsonView, unit: str) -> str:
    """Say over how much more or less of a range a variant fails than its baseline, and at how many
    points.
    """
    more, anew = difference["more"], difference["anew"]
    parts = ""
    if difference["gained"] and difference["lost"]:
        parts = f" ({fixed(anew, 2)} anew, {fixed(anew - more, 2)} no longer)"
    return (
        f"fails over {fixed(abs(more), 2)}{unit} {'less' if more < 0 else 'more'}{parts}: of "
        f"{plural(difference['pairs'], 'paired drive')} {difference['gained']} fail anew and "
        f"{difference['lost']} no longer"
    )
