"""The paper's numbers and our measurements beside them, in tables, figures and pages."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from alpasim_plugin.core.errors import EvaluatorError, InputError
from alpasim_plugin.lab.learned_metrics.swapping import swap_test
from alpasim_plugin.lab.paper.appearance import appearance_section
from alpasim_plugin.lab.paper.claims import CLAIMS, margin, within
from alpasim_plugin.lab.paper.closed_loop import METRICS
from alpasim_plugin.lab.paper.cost import Cost, Curve, Point, contested, cost_section, plot_cost
from alpasim_plugin.lab.paper.document import EqualTime, Findings, document, draw_figures
from alpasim_plugin.lab.paper.measured import Measured, from_rows
from alpasim_plugin.lab.paper.page import ShownClip, render_side_by_side
from alpasim_plugin.lab.paper.position import by_position, distance_by_position, drift
from alpasim_plugin.lab.paper.published import Published, published
from alpasim_plugin.lab.paper.tables import paper_against_ours
from alpasim_plugin.lab.paper.training import TrainedArm
from alpasim_plugin.lab.paper.verdict import Verdict, in_both, judge_claims
from tests.lab.paper.arm_cases import CLIPS, arms


def test_every_table_is_read_whole() -> None:
    found = published()
    cycle = found.tables["cycle"]
    assert len(cycle.rows) == 13
    for name, arm, metric, printed in (
        ("cycle", "V9", "fvd", "5.83"),
        ("under-trained", "difix", "psnr_db", "19.3"),
        ("closed-loop", "3dgs", "offroad_percent", "±1.3"),
    ):
        table = found.tables[name]
        assert printed in table.cells(arm)[table.metrics.index(metric)]
    assert all("-" not in table.cells(arm) for table in found.tables.values() for arm in table.rows)


@pytest.mark.parametrize(
    ("row", "found"),
    [("13.5 .1", "2 cells for 1 metrics"), ("13,5", "cell '13,5'"), ("13.5±x", "cell '13.5±x'")],
)
def test_a_row_that_is_not_a_row_is_named(tmp_path: Path, row: str, found: str) -> None:
    path = tmp_path / "numbers.yaml"
    path.write_text(
        "version: 1\nsource: here\nmetrics:\n  fvd: {heading: FVD, better: lower, ours: null}\n"
        f"tables:\n  one: {{title: T, protocol: P, metrics: [fvd], rows: {{difix: '{row}'}}}}\n"
    )
    with pytest.raises(InputError) as caught:
        published(path)
    assert found in caught.value.message
    assert "row difix" in caught.value.message


def test_a_difference_is_paired_and_says_whom_it_favours() -> None:
    measured = arms(a=0.0, b=-0.5)
    found = measured.difference("psnr_db", "a", "b")
    assert found.low is not None
    assert found.high is not None
    assert found.low < 0.5 < found.high < found.low + 0.2  # levels spread by 3 dB cancel
    assert (found.favours, measured.difference("psnr_db", "b", "a").favours) == (1, -1)


def test_arms_without_common_clips_are_not_compared() -> None:
    with pytest.raises(EvaluatorError, match="comparing arms"):
        Measured({"a": {"x": {"psnr_db": 1.0}}, "b": {"y": {"psnr_db": 1.0}}}).difference(
            "psnr_db", "a", "b"
        )


def test_a_distance_of_sets_is_tested_by_swapping_clips() -> None:
    rng = np.random.default_rng(1)
    truth = {clip: {"fd_syn_16": rng.normal(size=(8, 4))} for clip in CLIPS}
    moved = {
        arm: {c: {"fd_syn_16": x["fd_syn_16"] + by} for c, x in truth.items()}
        for arm, by in (("near", 0.1), ("far", 1.0))
    }
    measured = Measured({"near": {}, "far": {}, "truth": {}}, {"truth": truth, **moved})
    found = measured.difference("fd_syn_16", "near", "far")
    assert found.p_value is not None
    assert found.p_value < 0.01
    assert (found.favours, found.n) == (1, 12)
    assert measured.mean("near", "fd_syn_16").centre == pytest.approx(4 * 0.1**2, abs=1e-9)


def appearances(accuracy: float, lanes: float) -> dict[str, Measured]:
    """Return the protocols of the appearance experiment with given values of our arm."""
    rng = np.random.default_rng(2)
    rows = {"appearance": (accuracy, lanes), "3dgs + formula": (0.99, 0.6), "target": (1.0, 0.8)}
    values = {
        arm: {
            clip: {
                **dict.fromkeys(("style_acc_syn", "style_acc_syn.seed1"), style),
                **dict.fromkeys(("lane_f1_syn", "lane_f1_syn.seed1"), f1),
            }
            for clip, f1 in zip(CLIPS, f1 + 0.01 * rng.normal(size=len(CLIPS)), strict=True)
        }
        for arm, (style, f1) in rows.items()
    }
    return {
        name: Measured(values, reference="target")
        for name in ("appearance", "appearance-night", "appearance-fog", "appearance-snow")
    }


@pytest.mark.parametrize(
    ("accuracy", "lanes", "verdict"),
    [(0.97, 0.7, "holds"), (0.97, 0.5, "does not hold"), (0.6, 0.7, "does not hold")],
)
def test_the_claim_on_appearance_asks_for_style_and_lanes(
    accuracy: float, lanes: float, verdict: str
) -> None:
    assert (
        in_both(*(one.verdict for one in judge_claims(appearances(accuracy, lanes))[-2:]))
        == verdict
    )


def test_the_section_on_appearance_has_the_papers_rows_and_every_style() -> None:
    text = appearance_section(published(), appearances(0.97, 0.7))
    assert "| **cosmos3** | paper | .962 | .992 | .098 | .632 |" in text
    assert text.count("no counterpart here |") == 2
    for style in ("night", "fog", "snow"):
        assert f"| **{style}**, appearance | 0.970" in text
        assert f"| **{style}**, target | 1.000" in text
    assert "Fog, paired over clips" in text
    assert appearance_section(published(), {}) == ""


def test_claims_name_arms_and_metrics_that_there_are() -> None:
    known = {arm for table in published().tables.values() for arm in table.rows}
    known |= {
        "3dgs",
        "3dgs + formula",
        "harmonizer-temporal-teacher",
        "V9-still",
        "V3b-still",
        "onefixer[references=0]",
    }
    measured_as = {metric.ours for metric in published().metrics.values()}
    measured_as |= {"ms_per_frame", "drift_psnr_db", "fd_syn_16", "warp_l1_late_road", *METRICS}
    for claim in CLAIMS:
        assert claim.comparisons
        for comparison in claim.comparisons:
            assert {arm.partition(",")[0] for arm in comparison.arms} <= known, claim.text
            assert comparison.metric.removesuffix(".seed1") in measured_as
            assert comparison.bound is not None or margin(comparison.metric) > 0.0
    assert len({claim.text for claim in CLAIMS}) == len(CLAIMS)


def test_like_is_compared_with_like() -> None:
    pairs = {
        (one.first, one.second)
        for claim in CLAIMS
        for one in claim.comparisons
        if one.metric != "ms_per_frame"
    }
    assert ("V9, decoder trained", "difix") in pairs
    assert not {("V9", "difix"), ("difix", "V9")} & pairs


def test_the_table_has_the_papers_line_above_ours_and_null_where_nothing_stands_in() -> None:
    table = paper_against_ours(published(), "cycle", arms(difix=1.0, onefixer=2.0))
    lines = table.splitlines()
    paper, ours = next((a, b) for a, b in pairwise(lines) if a.startswith("| **difix**"))
    assert ".142±.015" in paper
    cells = [cell.strip() for cell in ours.split("|")[1:-1]]
    assert cells[:5] == ["", "ours", "null", "null", "-"]
    assert "±" in cells[5]
    assert sum("not run" in line for line in lines) == 12
    assert lines[-1].startswith("| **onefixer** | ours |")


def test_a_document_says_what_was_not_run() -> None:
    n = 190
    rows = [
        {
            "arm": arm,
            "clip": clip,
            "frames": n,
            "values": {"psnr_db": 20.0 + i},
            "series": {"psnr_db": [20.0 + i] * n, "perceptual-syn": [0.3] * n},
        }
        for arm in ("3dgs", "V9")
        for i, clip in enumerate(CLIPS)
    ]
    found: Published = published()
    findings = Findings({"under-trained": Measured(from_rows(rows))}, {"under-trained": rows}, {})
    text = document(found, findings, "simrun bench paper")
    assert text.count("Not run.") == 13
    assert "| protocol regime |" in text
    windows = by_position(rows).splitlines()
    assert "| 0 to 92 | 93 to 189 |" in windows[0]
    assert windows[2].startswith("| 3dgs | 25.50 ± ")


@pytest.mark.parametrize(
    ("first", "second", "both"),
    [
        ("holds", "holds", "holds"),
        ("holds", "does not hold", "does not hold"),
        ("not measured", "does not hold", "does not hold"),
        ("holds", "undecided", "undecided"),
        ("undecided", "not measured", "not measured"),
        ("holds", "not trained", "not trained"),
    ],
)
def test_a_claim_holds_only_under_both_budgets(
    first: Verdict, second: Verdict, both: Verdict
) -> None:
    assert in_both(first, second) == in_both(second, first) == both


def test_the_second_budget_has_its_own_tables_and_takes_the_rest_from_the_first() -> None:
    rng = np.random.default_rng(3)
    level = {clip: rng.normal() for clip in CLIPS}

    def fd(**mean: float) -> Measured:
        return Measured(
            {arm: {c: {"fd_syn_clip": m + level[c]} for c in CLIPS} for arm, m in mean.items()}
        )

    paper_s, equal = (
        fd(artifixer=8.0, **{"artifixer-pre@1": 19.0}),
        fd(artifixer=8.0, **{"artifixer-pre@1": 9.0}),
    )
    trained = TrainedArm(
        "artifixer", {"artifixer-pre": 40, "artifixer": 10}, 6.125, 3e-4, {1e-3: 0.31, 3e-4: 0.25}
    )
    findings = Findings(
        {"cycle": paper_s},
        {},
        {},
        training=[trained],
        equal_time=EqualTime({"cycle": equal}, [trained]),
    )
    text = document(published(), findings, "simrun bench paper")
    line = "| artifixer | artifixer-pre 40 + artifixer 10 | 6.12 | 0.0003 (0.0003: 0.250, 0.001: 0.310) |"
    assert text.count(line) == 2
    second = text[text.index("## Equal core-minutes") : text.index("## The paper's claims")]
    assert "### Cycle renders" in second
    assert "### Under-trained" not in second
    assert (
        "| 18 | holds | does not hold | **does not hold** |"
        in text[text.index("### Under both budgets") :]
    )


def test_the_first_frame_waits_for_look_ahead_and_the_whole_block() -> None:
    timed = Measured({"V9": {clip: {"ms_per_frame": 20.0} for clip in CLIPS}, "3dgs": {}})
    unit = {"frames": 8, "lookahead_frames": 7, "calls_per_frame": 0.125}
    text = document(
        published(),
        Findings({"cycle": timed}, {}, {"V9": unit, "3dgs": None}),
        "simrun bench paper",
    )
    assert "| V9 | 20.0 ± 0.0 | 0.125 | 7 | 860 |" in text  # 7 x 100 ms and 8 x 20 ms


def test_distance_by_position_compares_a_window_with_the_same_window_of_the_clean_frames() -> None:
    rng = np.random.default_rng(0)
    clean = {
        clip: rng.normal(size=(12, 3)) for clip in CLIPS
    }  # 12 vectors of 16 frames: 192 frames
    late = {clip: x + 5.0 * (np.arange(12) >= 5)[:, None] for clip, x in clean.items()}
    features = {
        arm: {clip: {"fd_syn_16": x} for clip, x in mine.items()}
        for arm, mine in (("truth", clean), ("same", clean), ("late", late))
    }
    lines = distance_by_position(Measured({"same": {}, "late": {}}, features), 192).splitlines()
    assert lines[0].split("|")[2:4] == [" 0 to 79 ", " 80 to 191 "]
    assert lines[2].split("|")[2:4] == [" 0.0 ", " 0.0 "]
    assert lines[3].split("|")[2:4] == [" 0.0 ", " 75.0 "]  # 5 in each of 3 dimensions
    assert distance_by_position(Measured({"same": {}}), 192) == ""


def test_drift_sets_both_trainings_of_the_temporal_arm_side_by_side(tmp_path: Path) -> None:
    falls = {
        "3dgs": 0.0,
        "harmonizer-temporal": 0.2,
        "harmonizer-temporal-teacher": 3.0,
        "difix": 0.0,
    }
    rows = [
        {
            "arm": arm,
            "clip": clip,
            "seed": 0,
            "frames": 198,
            "identical": 0,
            "events": {},
            "ms_per_frame": None,
            "values": {"psnr_db": 24.0 - by / 2, "drift_psnr_db": i / 100 - by},
            "series": {"psnr_db": np.linspace(24, 24 - by, 198).tolist()},
        }
        for arm, by in falls.items()
        for i, clip in enumerate(CLIPS)
    ]
    measured = Measured(from_rows(rows))
    text = drift(measured, rows)
    assert "| harmonizer-temporal-teacher | 23.76 ± 0.00 |" in text
    assert "| harmonizer-temporal-teacher | -2.9" in text
    assert "difix" not in text
    (claim,) = (one for one in judge_claims({"cycle": measured}) if "drifts" in one.claim.text)
    assert (claim.verdict, claim.results[0].outcome) == ("not measured", "for"), (
        "no oracle history was measured"
    )
    draw_figures(Findings({}, {"cycle": rows}, {}), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["drift.png"]


def test_training_time_is_compared_at_our_last_snapshot_within_half_of_the_others() -> None:
    ours = Curve(
        "V9", tuple(Point("V9", i, float(i), f"V9 after {i}") for i in (1, 2, 3, 4)), {"V9": 4.0}
    )
    student, dmd = Point("omnidreams", 1, 3.0, "student"), Point("self-forcing", 1, 5.0, "dmd")
    theirs = Curve(
        "self-forcing", (student, dmd), {"teacher": 2.0, "omnidreams": 3.0, "self-forcing": 5.0}
    )
    quick = Curve("one-forcing", (Point("one-forcing", 1, 1.5, "quick"),), {"one-forcing": 1.5})
    shift = {
        "V9 after 1": 0.0,
        "V9 after 2": 0.4,
        "V9 after 3": 0.6,
        "V9 after 4": 0.8,
        "student": 0.1,
        "dmd": 0.2,
        "quick": 0.0,
    }
    cost = Cost((ours, theirs, quick), arms(**shift), "12 clips.")
    measured = contested(cost)
    assert set(measured.arms) == {"V9", "self-forcing", "one-forcing", within("self-forcing")}, (
        "no snapshot of ours within 0.75"
    )
    assert measured.difference(
        "psnr_db", within("self-forcing"), "self-forcing"
    ).difference == pytest.approx(0.2, abs=0.1)
    text = cost_section(cost, "cost.png")
    assert "self-forcing (2.5), V9 has the snapshot of 2 updates, 2." in text
    assert "one-forcing (0.75), V9 has no snapshot." in text
    assert "- self-forcing: teacher to 2, omnidreams to 3, self-forcing to 5" in text
    assert "seed 0" not in text


def test_training_time_of_two_seeds_is_compared_in_each(tmp_path: Path) -> None:
    def curves(seed: int) -> tuple[Curve, ...]:
        ours = Curve(
            "V9",
            tuple(Point("V9", i, float(i), f"V9 {i}, {seed}") for i in (1, 2)),
            {"V9": 2.0},
            seed,
        )
        dmd = (Point("self-forcing", 1, 5.0, f"dmd, {seed}"),)
        return ours, Curve("self-forcing", dmd, {"self-forcing": 5.0}, seed)

    labels = [point.label for seed in (3, 7) for curve in curves(seed) for point in curve.points]
    shifts = {label: i / 10 for i, label in enumerate(labels)}
    shifts["dmd, 7"] = -1.0
    cost = Cost((*curves(3), *curves(7)), arms(**shifts), "12 clips.")
    assert contested(cost).values == contested(cost, 3).values
    gain = [
        contested(cost, seed).difference("psnr_db", "V9", "self-forcing").difference
        for seed in (3, 7)
    ]
    assert gain[0] < 0 < gain[1], "each seed's own arms"
    text = cost_section(cost, "cost.png")
    assert "- self-forcing, seed 7: self-forcing to 5" in text
    assert "core-minutes of self-forcing, seed 7 (2.5), V9 has the snapshot of 2 updates" in text
    assert "| comparison | seed 3 | seed 7 |" in text
    plot_cost(cost, tmp_path / "cost.png")
    assert (tmp_path / "cost.png").stat().st_size > 10_000


def test_two_arms_are_tested_once_whatever_asks(monkeypatch: pytest.MonkeyPatch) -> None:
    made = []
    monkeypatch.setattr(
        "alpasim_plugin.lab.paper.measured.swap_test",
        lambda *given: made.append(given) or swap_test(*given),
    )
    rng = np.random.default_rng(1)
    features = {
        arm: {clip: {"fd_syn_clip": rng.normal(size=(3, 2)) + by} for clip in CLIPS[:6]}
        for arm, by in (("truth", 0), ("b", 0), ("a", 2))
    }
    measured = Measured({"a": {}, "b": {}}, features)
    found, back = (
        measured.difference("fd_syn_clip", "b", "a"),
        measured.difference("fd_syn_clip", "a", "b"),
    )
    assert found.difference == -back.difference < 0
    assert (found.favours, back.favours, found.p_value) == (1, -1, back.p_value)
    assert found.p_value == pytest.approx(2 / 2**6)
    assert measured.only(["a", "b"]).difference("fd_syn_clip", "a", "b") == back
    assert len(made) == 1


def test_a_page_holds_every_frame_and_refuses_films_of_other_lengths() -> None:
    clip = ShownClip(
        "one",
        {"3dgs": [b"a", b"b"], "truth": [b"c", b"d"]},
        {"psnr_db": {"3dgs": [20.0, 21.0]}, "warp_l1": {"3dgs": [0.1]}},
    )
    page = render_side_by_side([clip], (9, 16))
    assert '"lines": [[20.0, 21.0], null]' in page
    assert '"lines": [[null, 0.1], null]' in page
    assert "http://" not in page.replace("http://www.w3.org/2000/svg", "")
    with pytest.raises(EvaluatorError, match="lengths"):
        render_side_by_side(
            [ShownClip("one", {"3dgs": [b"a"], "truth": [b"c", b"d"]}, {})], (9, 16)
        )
    with pytest.raises(EvaluatorError, match="none"):
        render_side_by_side([], (9, 16))
