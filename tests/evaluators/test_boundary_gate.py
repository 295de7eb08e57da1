"""A gate on boundaries: pass, regression, and what cannot be compared."""

import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.runs.self_test import run_self_test
from evaluators.statistics.boundary_gate import boundary_verdict
from evaluators.statistics.gate import GateSpec, load_gate
from tests.evaluators.gate_tables import rows, table_of

ENDS = [4.0, 14.0]
TABLE = table_of([*rows("clean", 1), *rows("3dgs", 1)])
GATE = GateSpec(version=1, boundary_margin=0.5)


VALUES = [4.0 + 0.5 * number for number in range(21)]


def fails(*windows):
    """Return the facts of a variant that fails in windows of the range."""
    points = [[value, any(low <= value < high for low, high in windows)] for value in VALUES]
    return {"outcomes": {"0": points}}


def area(*failing):
    points = [[x, y, (x, y) in failing] for x in (4.0, 9.0, 14.0) for y in (1.0, 2.0)]
    return {"outcomes": {"0": points}}


def record(base, variant, **more):
    made = {
        "parameter": "actors.cutter.s_m",
        "unit": "m",
        "reachable": ENDS,
        "spacing": 0.5,
        "apart": 0.5,
        "first": VALUES,
        "stopped": "",
        "variants": {"clean/p": base, "3dgs/p": variant},
    }
    return made | more


@pytest.mark.parametrize(
    ("base", "variant", "code"),
    [
        (fails((4, 7)), fails((4, 7)), 0),
        (fails((4, 7)), fails((4, 7.5)), 0),  # 0.5 m is the margin
        (fails((4, 7)), fails((4, 8)), 1),
        (fails((4, 8)), fails((4, 5)), 0),
        (fails((9, 15)), fails((7, 15)), 1),
        (fails((4, 7)), fails((4, 7), (8.5, 9.5)), 1),  # a window beside an equal boundary
        (fails((4, 7), (8.5, 9.5)), fails((4, 7)), 0),
        (fails(), fails((4, 6)), 1),
        (fails(), fails((0, 20)), 1),
        (fails((4, 7)), fails((10, 13)), 1),  # as much, elsewhere
        (fails((4, 7)), fails((6, 9)), 1),
    ],
)
def test_a_variant_may_fail_anew_over_as_much_of_the_range_as_the_margin(base, variant, code):
    verdict = boundary_verdict(TABLE, GATE, record(base, variant))
    assert verdict.exit_code == code
    (check,) = verdict.checks
    assert check.renderer == "3dgs"
    assert "points 0.5 m apart, a narrower change is not seen" in check.text


def test_what_fails_elsewhere_is_said_for_both_sides():
    (check,) = boundary_verdict(TABLE, GATE, record(fails((4, 7)), fails((10, 12)))).checks
    assert (
        "fails over 0.75 m less (2.00 anew, 2.75 no longer): of 21\xa0paired drives 4" in check.text
    )
    assert check.cause == "regression"


def test_of_a_rectangle_points_of_the_grid_are_counted():
    two = {
        "parameter": ["a", "b"],
        "unit": ["m", "m/s"],
        "reachable": [ENDS, [1.0, 2.0]],
        "spacing": [5.0, 1.0],
        "first": [[4.0, 9.0, 14.0], [1.0, 2.0]],
    }
    spec = GateSpec(version=1, boundary_margin=0.2)
    base = area((4.0, 1.0))
    for failing, code in (((4.0, 1.0), (9.0, 1.0)), 0), (((4.0, 1.0), (9.0, 1.0), (9.0, 2.0)), 1):
        variant = area(*failing)
        variant["outcomes"]["0"].append([6.5, 1.0, True])  # between points of the grid
        verdict = boundary_verdict(TABLE, spec, record(base, variant, **two))
        assert verdict.exit_code == code
    assert "of 6" in verdict.checks[0].text
    assert "5 m by 1 m/s apart" in verdict.checks[0].text


def test_an_earlier_run_is_compared_variant_by_variant():
    now = record(fails((4, 7)), fails((4, 8)))
    was = record(fails((4, 7)), fails((4, 7)))
    verdict = boundary_verdict(TABLE, GATE, now, was, "before")
    assert {check.renderer: check.cause for check in verdict.checks} == {
        "clean": "pass",
        "3dgs": "regression",
    }


def test_what_cannot_be_compared_is_bad_input():
    good = record(fails((4, 7)), fails((4, 7)))
    assert boundary_verdict(TABLE, GATE, good | {"stopped": "here"}).exit_code == 2
    other_seed = {"outcomes": {"5": fails()["outcomes"]["0"]}}
    assert boundary_verdict(TABLE, GATE, record(fails(), other_seed)).exit_code == 2
    older = {name: good[name] for name in good if name != "first"}
    elsewhere = good | {"reachable": [4.0, 12.0]}
    coarser = good | {"spacing": 1.0}
    for now, was in ((None, None), (good, {}), (good, older), (good, elsewhere), (good, coarser)):
        with pytest.raises(InputError):
            boundary_verdict(TABLE, GATE, now, was, "before")
    with pytest.raises(InputError):
        boundary_verdict(table_of(rows("clean", 1)), GATE, good)


def test_the_self_test_refuses_a_gate_whose_points_it_does_not_drive(tmp_path):
    with pytest.raises(InputError, match="boundary_margin"):
        run_self_test(GATE, tmp_path, ["simrun"], None)
    assert not list(tmp_path.iterdir())


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
