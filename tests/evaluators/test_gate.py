"""Gates: what they ask for, against what, and the one outcome that follows."""

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from evaluators.results import EXIT_CODES, Failures, Outcome
from evaluators.statistics.gate import (
    GateSpec,
    MetricRule,
    check_gate,
    load_gate,
    shipped_gates,
)
from evaluators.statistics.power import chance_seen
from evaluators.statistics.verdicts import SEVERITY, outcome_of_failures, worst, worst_code
from tests.evaluators.gate_tables import SCENES, add, rows, table_of

RULES = {
    "lateral_distance_m": MetricRule(margin=0.1),
    "progress": MetricRule(margin=0.05),
    "collision_at_fault": MetricRule(margin=0.1),
    "offroad": MetricRule(margin=0.1),
    "wrong_lane": MetricRule(margin=0.1, must_decide=False),
    "img_is_black": MetricRule(max=0.0),
}
Rows = list[dict[str, Any]]


def judged(run, spec, stored=None, name="", **fields):
    base = None if stored is None else table_of(stored)
    return check_gate(table_of(run), spec, base, name, **fields)


def invalid(metric, where=slice(None)):
    def changed(candidate):
        for row in candidate[where]:
            row[metric], row[f"{metric}_valid"] = None, False
        return candidate

    return changed


def both(*changes):
    def changed(candidate):
        for change in changes:
            candidate = change(candidate)
        return candidate

    return changed


def same(candidate):
    return candidate


ONE = slice(4, 5)
THREE = slice(5, 8)
NEW = add(1.0, "collision_at_fault", ONE)


def gate(**fields):
    return GateSpec(**{"version": 1, "metrics": RULES, **fields})


def code(now, before=same, spec=None, is_noisy=False, **size):
    """Return the exit code of a change of the run and one of its baseline."""
    stored = before(rows(renderer="clean", **size))
    return judged([*stored, *now(rows(**size))], spec or gate(), repeatable=not is_noisy).exit_code


@pytest.mark.parametrize(
    ("now", "before", "wanted"),
    [
        (same, same, 0),
        (add(1e-15), same, 0),  # another processor
        (add(0.101), same, 1),
        (add(-0.3), same, 0),  # better
        (add(0.3, where=ONE), same, 0),  # one scene, by three margins
        (add(0.301, where=ONE), same, 1),
        (add(-0.06, "progress"), same, 1),
        (NEW, same, 1),
        (same, NEW, 0),  # gone
        (NEW, NEW, 0),
        (NEW, add(1.0, "collision_at_fault", THREE), 1),  # 1 new, 3 gone
        (add(1.0, "wrong_lane", ONE), same, 1),  # it need not decide, and is shown
        (lambda run: run[1:], same, 2),  # a scene is missing
        (invalid("offroad", ONE), same, 2),
        (invalid("progress", ONE), invalid("progress", ONE), 0),  # on neither side
        (invalid("progress"), same, 2),
        (invalid("progress"), invalid("progress"), 2),  # nowhere
        (invalid("img_is_black"), same, 2),
        (add(1.0, "img_is_black", ONE), same, 1),
        (both(NEW, lambda run: run[1:]), same, 2),
    ],
)
def test_a_suite_is_green_where_nothing_is_new_and_distances_are_within_their_margins(
    now, before, wanted
):
    assert code(now, before) == wanted


@pytest.mark.parametrize("is_noisy", [False, True])
@pytest.mark.parametrize("scenes", [1, 3, SCENES])
def test_equal_runs_of_any_size_are_green(scenes, is_noisy):
    assert code(same, scenes=scenes, is_noisy=is_noisy) == 0


def test_seeds_of_a_scene_are_averaged_and_each_must_have_its_pair():
    assert code(add(0.4, where=ONE), seeds=2) == 0  # of two seeds: the scene by two margins
    assert code(add(0.7, where=ONE), seeds=2) == 1
    assert code(NEW, seeds=2) == 1
    assert code(lambda run: run[1:], seeds=2) == 2


def test_new_events_are_accepted_by_number_and_margins_by_size():
    accepting = RULES | {"collision_at_fault": MetricRule(max_new=1)}
    assert code(NEW, spec=gate(metrics=accepting)) == 0
    assert code(NEW, spec=gate(max_new=1)) == 0
    assert code(add(1.0, "offroad", THREE), spec=gate(max_new=2)) == 1
    wide = RULES | {"lateral_distance_m": MetricRule(margin=1.0)}
    assert code(add(0.9), spec=gate(metrics=wide)) == 0
    assert code(same, spec=gate(min_scenes=15)) == 2
    assert code(lambda run: run[1:], spec=gate(max_missing=0.1)) == 0
    none = RULES | {"lateral_distance_m": MetricRule(margin=0.0)}
    assert code(add(1e-15), spec=gate(metrics=none)) == 0
    assert code(add(1e-3, where=ONE), spec=gate(metrics=none)) == 1


def test_without_a_better_side_a_change_to_either_is_worse():
    def biased(bias):
        return lambda run: [
            row | {"lateral_bias_m": bias, "lateral_bias_m_valid": True} for row in run
        ]

    spec = gate(metrics={"lateral_bias_m": MetricRule(margin=0.1)})
    assert [code(biased(bias), biased(0.0), spec) for bias in (0.05, -0.05, 0.2, -0.2)] == [
        0,
        0,
        1,
        1,
    ]


def test_a_distance_that_an_event_cut_short_is_compared_with_none():
    """A rollout that ends early is near its path for as long as it lasts."""
    short = both(add(1.0, "collision_any", ONE), add(-0.3, where=ONE))
    spec = gate(metrics={"lateral_distance_m": RULES["lateral_distance_m"]})
    assert code(short, spec=spec) == 1  # the event ends the scored part, though it has no rule
    verdict = judged([*short(rows("clean")), *rows()], spec)
    assert verdict.exit_code == 0
    assert (verdict.checks[0].entry["diff"], verdict.checks[0].entry["cut"]) == (
        0.0,
        ["s004 seed 0"],
    )
    assert code(short, spec=gate(max_new=1)) == 0
    ended = judged([*short(rows("clean")), *short(rows())], spec).checks[0]
    assert (ended.cause, ended.entry["n_short"], ended.entry["n_cells"]) == ("pass", 1, SCENES)
    everywhere = add(1.0, "collision_any")
    gone = judged([*everywhere(rows("clean")), *rows()], spec)
    assert (gone.exit_code, gone.checks[0].cause) == (2, "incomplete")  # nothing was compared
    assert gone.checks[0].entry["diff"] is None
    assert "mean" not in gone.checks[0].text
    assert "at least" not in gone.checks[0].text
    assert code(everywhere, spec=spec) == 1  # the new event decides
    driven_on = judged([*rows("clean"), *short(rows())], spec, preset="nuplan")
    assert driven_on.exit_code == 0  # its rollouts go on after an event


def test_a_verdict_counts_and_names_what_changed():
    stored = add(1.0, "collision_at_fault", THREE)(rows("clean"))
    verdict = judged([*stored, *both(NEW, add(0.4, where=ONE))(rows())], gate())
    checks = {check.metric: check for check in verdict.checks}
    event = checks["collision_at_fault"]
    distance = checks["lateral_distance_m"]
    assert event.entry["counts"] == {"equal": 10, "new": 1, "gone": 3}
    assert event.entry["worst"] == [{"scene": "s004", "seed": 0, "was": 0.0, "now": 1.0}]
    assert distance.entry["counts"] == {
        "equal": 13,
        "worse": 1,
        "better": 0,
        "within the margin": 0,
    }
    assert [pair["scene"] for pair in distance.entry["worst"]] == ["s004"]
    for check in (event, distance):
        assert check.cause == "regression"
        assert "s004" in check.text
    assert "1 new, 3 gone" in event.text


def test_the_counts_of_a_line_add_up_to_its_pairs():
    now = both(add(0.05, where=slice(0, 5)), add(-0.4, where=slice(5, 7)), add(0.2, where=ONE))
    verdict = judged([*rows("clean"), *now(rows())], gate())
    for check in verdict.checks:
        if "counts" in check.entry:
            assert sum(check.entry["counts"].values()) == check.entry["n_cells"] == SCENES
    (line,) = (c.text for c in verdict.checks if c.metric == "lateral_distance_m")
    line = line.replace("\u00a0", " ")
    assert "m, margin 0.1 m; 1 worse, 2 better, 4 within the margin, 7 equal of 14 pairs" in line


LIMITS = GateSpec(version=1, metrics={"offroad": MetricRule(max=0.0)})


@pytest.mark.parametrize(
    ("fields", "wanted"),
    [({}, 2), ({"max_missing": 0.8}, 2), ({"max_missing": 0.95}, 0), ({"min_scenes": 20}, 2)],
)
def test_a_limit_needs_the_values_and_the_scenes_that_a_margin_needs(fields, wanted):
    spec = LIMITS.model_copy(update=fields)
    run = rows() if "min_scenes" in fields else invalid("offroad", slice(1, None))(rows())
    verdict = judged(run, spec)
    assert verdict.exit_code == wanted
    if not fields:
        assert "valid in 1 of 14" in verdict.checks[0].text
    assert judged(rows(), LIMITS).exit_code == 0


def test_a_variant_that_the_stored_baseline_has_and_the_run_has_lost_is_incomplete():
    stored = [*rows("clean"), *rows("3dgs")]
    lost = judged(rows("clean"), gate(), stored, "before")
    assert lost.exit_code == 2
    assert "3dgs/p" in " ".join(lost.outcome.reasons)
    assert judged(rows("clean"), gate(renderers=("clean",)), stored, "before").exit_code == 0
    policies = [*rows("clean"), *rows("clean", policy="q")]
    assert judged(rows("clean"), gate(), policies, "before").exit_code == 2
    renamed = judged(rows("clean", policy="new"), gate(), rows("clean", policy="old"), "before")
    assert renamed.exit_code == 0


def test_with_a_stored_baseline_the_variant_that_a_gate_compares_with_is_tested_too():
    run = [*add(1.0, "collision_at_fault")(rows("clean")), *rows("3dgs")]
    verdict = judged(run, gate(baseline="clean"), rows("clean"), "before")
    assert verdict.exit_code == 1
    assert {check.renderer for check in verdict.checks} == {"clean", "3dgs"}


def test_sentences_name_the_policy_where_there_are_several():
    run = [*rows("clean"), *rows("clean", policy="q"), *rows("3dgs"), *rows("3dgs", policy="q")]
    texts = [check.text for check in judged(run, gate()).checks]
    assert any(text.startswith("3dgs/q: ") for text in texts)


# --- policies that are not repeatable


def often(share, key):
    """Return rows in which an event happens at random."""

    def changed(candidate):
        rng = np.random.Generator(np.random.Philox(key))
        for row in candidate:
            row["collision_at_fault"] = float(rng.random() < share)
            row["lateral_distance_m"] += rng.normal(0.0, 0.05)
        return candidate

    return changed


@pytest.mark.parametrize(
    ("now", "before", "seeds", "wanted"),
    [
        (NEW, same, 1, 3),  # one event may be chance
        (often(0.0, 1), often(0.0, 2), 1, 3),  # 14 pairs cannot exclude one event in ten
        (often(0.0, 1), often(0.0, 2), 4, 0),
        (often(0.3, 1), often(0.3, 2), 1, 3),
        (often(0.8, 1), often(0.2, 2), 2, 1),
        (add(1.0, "offroad", slice(0, 6)), same, 6, 1),  # one scene alone takes six seeds
        (add(1.0, "offroad", slice(0, 5)), same, 5, 3),
        (both(often(0.0, 1), add(0.4)), often(0.0, 2), 2, 1),
        (both(often(0.0, 1), add(4.0, where=slice(0, 1))), often(0.0, 2), 4, 1),  # far beyond noise
        (both(often(0.0, 1), add(0.5, where=slice(0, 1))), often(0.0, 2), 4, 3),  # or not so far
        (lambda run: often(0.0, 1)(run)[1:], same, 4, 2),
    ],
)
def test_a_policy_that_is_not_repeatable_is_tested_over_its_seeds(now, before, seeds, wanted):
    assert code(now, before, is_noisy=True, seeds=seeds) == wanted


def test_a_gate_of_distances_says_what_it_bounds_and_what_lies_beyond():
    verdict = judged([*rows("clean"), *often(0.0, 1)(rows())], gate(), repeatable=False)
    text = next(check.text for check in verdict.checks if check.metric == "lateral_distance_m")
    text = text.replace("\u00a0", " ")
    assert "mean of drives cut at 0.3 m: " in text
    assert "0 of 14 drives beyond 0.3 m: at most 19 %" in text


def test_scenes_that_are_too_few_for_a_cut_mean_are_never_green():
    """A rare far drive that was not drawn leaves every one of nine drives in its margin."""
    noisy = [*rows("clean", scenes=3, seeds=3), *often(0.0, 1)(rows(scenes=3, seeds=3))]
    spec = GateSpec(version=1, metrics={"lateral_distance_m": MetricRule(margin=0.1)})
    verdict = judged(noisy, spec, repeatable=False)
    assert verdict.exit_code == 3
    assert verdict.checks[0].entry["seeds"] == 4


def test_an_undecided_gate_says_how_many_seeds_would_decide():
    verdict = judged([*rows("clean"), *often(0.0, 1)(rows())], gate(), repeatable=False)
    undecided = {check.metric: check for check in verdict.checks if check.cause == "undecided"}
    assert undecided["offroad"].entry["seeds"] == 3
    assert "3 seeds" in undecided["offroad"].text.replace("\u00a0", " ")
    assert code(often(0.0, 1), seeds=3, is_noisy=True) == 0


# --- what a suite of this size can show


def test_a_gate_says_what_as_many_pairs_as_were_compared_can_show():
    def sizes(spec=None, repeatable=None, **size):
        run = [*rows("clean", **size), *rows(**size)]
        verdict = judged(run, spec or gate(), repeatable=repeatable)
        assert verdict.as_dict()["sizes"] == list(verdict.sizes)
        return [text.replace("\u00a0", " ") for text in verdict.sizes]

    seen = "an event that is new in 5, 10, 20 % of drives is seen with a chance of"
    assert sizes() == [f"14 pairs: {seen} 51, 77, 96 %"]
    assert sizes(scenes=3, seeds=2) == [f"6 pairs: {seen} 26, 47, 74 %"]
    assert sizes(gate(max_new=1)) == [f"14 pairs: {seen} 15, 42, 80 % (it takes 2 new ones)"]
    noisy = sizes(repeatable=False, scenes=42)
    assert noisy == [f"42 pairs: {seen} 2, 24, 87 % (it takes 6 new ones and none gone)"]
    limits = gate(metrics={"img_is_black": MetricRule(max=0.0)})
    assert sizes(limits) == []
    others = {name: rule for name, rule in RULES.items() if rule.must_decide}
    (claim,) = sizes(gate(population="scenes", metrics=others), scenes=200)
    assert claim.endswith("its rate in others has risen by less than 1.8 points")


def test_the_chances_under_a_gate_are_those_of_drawn_gates():
    rng = np.random.Generator(np.random.Philox(4))
    red = np.mean([rng.random(14).min() < 0.05 for _ in range(2000)])
    assert chance_seen(0.05, 14) == pytest.approx(red, abs=0.03)
    red = np.mean([np.sum(rng.random(42) < 0.2) >= 6 for _ in range(2000)])
    assert chance_seen(0.2, 42, 6) == pytest.approx(red, abs=0.03)


# --- what scenes stand for


def test_a_gate_about_other_scenes_is_refused_where_they_are_too_few_and_else_decides():
    others = {name: rule for name, rule in RULES.items() if rule.must_decide}
    spec = gate(population="scenes", metrics=others)
    with pytest.raises(InputError) as caught:
        code(same, spec=spec)
    assert "146" in caught.value.message
    assert code(same, spec=spec, scenes=400) == 0
    assert code(add(0.5), spec=spec, scenes=400) == 1
    assert code(add(0.1), spec=spec, scenes=400) == 3
    assert code(lambda run: run[1:], spec=spec, scenes=400) == 2
    for margin, number in ((0.9, "6"), (0.0, "no number")):
        wide = gate(population="scenes", metrics={"progress": MetricRule(margin=margin)})
        with pytest.raises(InputError) as caught:
            code(same, spec=wide, scenes=5)
        assert number in caught.value.message
    wide = gate(population="scenes", metrics={"progress": MetricRule(margin=0.9)})
    assert code(same, spec=wide, scenes=6) == 0


# --- what is compared with what


def test_failed_rollouts_are_infrastructure_and_unscored_ones_the_evaluators():
    def failed(kind):
        return lambda run: [run[0] | {"status": "failed", "failure_class": kind}, *run[1:]]

    assert code(failed("renderer")) == 4
    assert code(failed("renderer"), spec=gate(max_failed=0.05, max_missing=0.1)) == 0
    assert code(failed("renderer"), spec=gate(max_failed=0.05)) == 2
    assert code(failed("evaluator")) == 5


def test_renderers_and_policies_are_judged_one_by_one():
    both_renderers = [*rows("clean"), *rows("good"), *add(0.5)(rows("worse one"))]
    verdict = judged(both_renderers, gate())
    distances = [c for c in verdict.checks if c.metric == "lateral_distance_m"]
    assert {(c.renderer, c.cause) for c in distances} == {
        ("good", "pass"),
        ("worse one", "regression"),
    }
    assert judged(both_renderers, gate(renderers=("good",))).exit_code == 0
    other = [*rows("clean", policy="q"), *add(0.5)(rows("good", policy="q"))]
    arms = judged([*both_renderers, *other], gate(renderers=("good",))).checks
    assert {(c.policy, c.cause) for c in arms if c.metric == "lateral_distance_m"} == {
        ("p", "pass"),
        ("q", "regression"),
    }


def test_a_stored_baseline_meets_the_renderer_of_the_same_name():
    stored = [*rows("clean"), *rows()]
    verdict = judged([*rows("clean"), *add(0.5)(rows())], gate(), stored, "main.json")
    assert {(c.renderer, c.cause) for c in verdict.checks if c.metric == "lateral_distance_m"} == {
        ("clean", "pass"),
        ("3dgs", "regression"),
    }
    assert verdict.baseline == "main.json"


def with_beyond(shares):
    run = rows()
    for row, share in zip(run, itertools.cycle(shares), strict=False):
        row["beyond_measured_share"] = share
        row["beyond_measured_share_valid"] = share is not None
    return run


@pytest.mark.parametrize(
    ("shares", "wanted"), [([0.0, 0.2], 0), ([0.1, 0.2], 1), ([0.0, None], 2), ([None], 2)]
)
def test_a_gate_limits_how_much_lies_beyond_what_was_compared(shares, wanted):
    spec = GateSpec(version=1, max_beyond_measured=0.1)
    codes = (0, EXIT_CODES["regression"], EXIT_CODES["incomplete"])
    assert judged(with_beyond(shares), spec).exit_code == codes[wanted]
    assert judged(rows(), spec).exit_code == codes[2], "a run without the metric is no pass"
    lenient = spec.model_copy(update={"max_missing": 0.9})
    assert judged(with_beyond(shares), lenient).exit_code == codes[wanted], (
        "where it is not known, nothing says that it lies within"
    )
    rule = {"beyond_measured_share": MetricRule(max=0.1)}
    for fields in ({"metrics": rule}, {"boundary_margin": 0.1}):
        with pytest.raises(ValueError, match="max_beyond_measured"):
            GateSpec(version=1, max_beyond_measured=0.1, **fields)


def test_a_gate_of_limits_names_a_new_collision_where_there_is_a_baseline():
    stored = rows()
    collided = add(1.0, "collision_any", ONE)(rows())
    limits = gate(metrics={"lateral_distance_m": MetricRule(max=9.0)})
    assert judged(collided, limits, stored, "main.json").exit_code == 1
    assert judged(rows(), limits, stored, "main.json").exit_code == 0
    assert judged(collided, limits).baseline == "limits alone"
    accepted = judged(collided, limits.model_copy(update={"max_new": 1}), stored, "main.json")
    assert accepted.exit_code == 0
    assert any("collision_any" in check.text for check in accepted.checks)


def test_names_that_are_not_there_are_refused():
    one = rows("clean")
    for run, spec in (
        (one, gate()),
        ([*one, *rows()], gate(renderers=("onefixer",))),
        ([*one, *rows()], gate(baseline="onefixer")),
    ):
        with pytest.raises(InputError):
            judged(run, spec)
    limits = gate(metrics={"img_is_black": MetricRule(max=0.0)})
    assert judged(one, limits).exit_code == 0  # limits need no second renderer


def test_text_and_exit_code_come_from_one_object_and_the_worst_cause_decides():
    assert EXIT_CODES == {
        "pass": 0,
        "regression": 1,
        "incomplete": 2,
        "policy": 2,
        "renderer": 2,
        "fixer": 2,
        "undecided": 3,
        "infrastructure": 4,
        "evaluator": 5,
    }
    for one, other in itertools.product(SEVERITY, SEVERITY):
        assert worst([Outcome(one), Outcome(other)]).cause == min(one, other, key=SEVERITY.index)
    mixed = Failures(n_failed=2, n_rollouts=9, by_class={"evaluator": 1, "policy": 1})
    assert outcome_of_failures(mixed).exit_code == 5
    for by_class, wanted in (({"input": 2}, 2), ({"renderer": 1, "evaluator": 1}, 5)):
        assert outcome_of_failures(replace(mixed, by_class=by_class)).exit_code == wanted
    assert worst_code([1, 3, 2, 0]) == 2
    assert outcome_of_failures(replace(mixed, by_class={"policy": 2})).exit_code == 2
    assert outcome_of_failures(replace(mixed, n_failed=0, by_class={})).exit_code == 0


# --- files


@pytest.mark.parametrize("name", shipped_gates())
def test_shipped_gates_load_by_name(name):
    assert load_gate(name)[0].metrics


@pytest.mark.parametrize(
    ("text", "place", "mention"),
    [
        ("version: 1\nmetrics:\n  offroad: {margn: 0.1}\n", ":3:", "did you mean 'margin'?"),
        (
            "version: 1\nmin_scene: 3\nmetrics: {offroad: {margin: 0.1}}\n",
            ":2:",
            "did you mean 'min_scenes'?",
        ),
        ("version: 1\nmetrics:\n  offraod: {margin: 0.1}\n", ":3:", "did you mean 'offroad'?"),
        ("version: 1\nmetrics:\n  offroad: {margin: -0.1}\n", ":3:", "greater than or equal to 0"),
        (
            "version: 1\nmetrics:\n  offroad: {must_decide: false}\n",
            ":3:",
            "a rule without margin, max_new, max or min",
        ),
        ("version: 1\nmetrics:\n  dist_traveled_m: {margin: 0}\n", ":3:", "no better side"),
        ("version: 1\nmetrics:\n  progress: {max_new: 1}\n", ":3:", "which is no event"),
        (
            "version: 1\npreset: papr\nmetrics: {offroad: {margin: 0.1}}\n",
            ":2:",
            "did you mean 'paper'?",
        ),
        ("version: 2\nmetrics: {offroad: {margin: 0.1}}\n", ":1:", "version"),
        (
            "version: 1\npopulation: scenes\nmetrics: {progress: {min: 0.5}}\n",
            ":1:",
            "without a margin",
        ),
        ("version: 1\nmetrics: {}\n", ":2:", "at least 1"),
        ("version: 1\nmetrics:\n  progress: {max: 1, min: 5}\n", ":3:", "min 5 is above max 1"),
        ("version: 1\nmetrics: {offroad: {margin: 0.1}\n", ":2:", "not valid YAML"),
    ],
)
def test_a_bad_gate_file_is_refused_with_its_line_and_a_hint(tmp_path, text, place, mention):
    path = tmp_path / "gate.yaml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        load_gate(path)
    assert f"gate.yaml{place}" in caught.value.message or "not valid YAML" in caught.value.message
    assert mention in f"{caught.value.message} {caught.value.hint}"


def test_an_unknown_gate_lists_the_shipped_ones():
    with pytest.raises(InputError, match="default"):
        load_gate("nightly")
