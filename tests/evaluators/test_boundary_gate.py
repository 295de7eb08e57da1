"""A gate on boundaries: pass, regression, undecided, and what cannot be compared."""

import pytest

from alpasim_plugin.core.errors import InputError
from evaluators.statistics.boundary_gate import boundary_verdict, more_that_fails
from evaluators.statistics.gate import GateSpec, load_gate
from tests.evaluators.gate_tables import rows, table_of

ENDS = [4.0, 14.0]
TABLE = table_of([*rows("clean", 1), *rows("3dgs", 1)])
GATE = GateSpec(version=1, boundary_margin=0.5)


def found(low, high, fails="below"):
    points = [[4.0, fails == "below"], [low, False], [high, False], [14.0, fails == "above"]]
    return {"fails": fails, "low": low, "high": high, "outcomes": {"0": points}}


def without(*outcomes):
    return {"reason": "", "outcomes": {"0": [[4.0 + k, one] for k, one in enumerate(outcomes)]}}


def area(low, high):
    points = [[4.0, 1.0, True], [14.0, low, False]]
    return {"areas": {}, "low": low, "high": high, "outcomes": {"0": points}}


def record(base, variant, difference=None, **more):
    between = {"baseline": "clean/p"} | dict(zip(("low", "high"), difference or (), strict=False))
    made = {
        "parameter": "actors.cutter.s_m",
        "unit": "m",
        "reachable": ENDS,
        "stopped": "",
        "variants": {"clean/p": base, "3dgs/p": variant},
        "differences": {"3dgs/p": between} if difference else {},
    }
    return made | more


@pytest.mark.parametrize(
    ("base", "variant", "difference", "code"),
    [
        (found(6.0, 6.2), found(6.1, 6.3), (-0.1, 0.3), 0),
        (found(6.0, 6.2), found(7.0, 7.2), (0.8, 1.2), 1),
        (found(6.0, 6.2), found(6.4, 6.6), (0.2, 0.6), 3),
        (found(7.0, 7.2), found(4.5, 4.7), (-2.7, -2.3), 0),
        (found(9.0, 9.2, "above"), found(7.0, 7.2, "above"), (-2.2, -1.8), 1),
        (found(6.0, 8.0), found(6.0, 8.0), (-2.0, 2.0), 0),  # equal outcomes
        (found(6.0, 6.2), without(False, False), None, 0),
        (without(False, False), found(6.0, 6.2), None, 1),
        (found(6.0, 6.2), without(True, True), None, 1),
        (found(6.0, 6.2), without(True, False, True), None, 3),
        (area(0.1, 0.2), area(0.3, 0.4), (0.6, 0.7), 1),
        (area(0.1, 0.2), area(0.3, 0.4) | {"areas": {}}, None, 0),
    ],
)
def test_a_variant_may_fail_over_more_of_the_range_by_the_margin(base, variant, difference, code):
    verdict = boundary_verdict(TABLE, GATE, record(base, variant, difference))
    assert verdict.exit_code == code
    assert [check.renderer for check in verdict.checks] == ["3dgs"]


def test_an_earlier_run_is_compared_variant_by_variant():
    now = record(found(6.0, 6.2), found(7.0, 7.2), (0.8, 1.2))
    was = record(found(6.0, 6.2), found(6.0, 6.2), (-0.2, 0.2))
    verdict = boundary_verdict(TABLE, GATE, now, was, "before")
    assert {check.renderer: check.cause for check in verdict.checks} == {
        "clean": "pass",
        "3dgs": "regression",
    }
    assert more_that_fails(found(7.0, 7.2), found(6.0, 6.2), ENDS) == pytest.approx((0.8, 1.2))


def test_what_cannot_be_compared_is_bad_input():
    good = record(found(6.0, 6.2), found(6.1, 6.3))
    assert boundary_verdict(TABLE, GATE, good | {"stopped": "here"}).exit_code == 2
    for now, was in ((None, None), (good, {}), (good, good | {"reachable": [4.0, 12.0]})):
        with pytest.raises(InputError):
            boundary_verdict(TABLE, GATE, now, was, "before")
    with pytest.raises(InputError):
        boundary_verdict(table_of(rows("clean", 1)), GATE, good)


@pytest.mark.parametrize(
    "text",
    [
        "boundary_margin: 1\nmetrics: {progress: {margin: 1}}",
        "description: none",
        "boundary_margin: -1",
    ],
)
def test_a_gate_has_metrics_or_a_boundary(text, tmp_path):
    path = tmp_path / "gate.yaml"
    path.write_text(f"version: 1\n{text}\n")
    with pytest.raises(InputError):
        load_gate(path)
