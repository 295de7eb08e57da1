"""The paper's numbers, our measurements beside them, and the verdict on each claim."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from alpasim_plugin.errors import EvaluatorError, InputError
from evaluators.paper.claims import CLAIMS, Claim, Contest
from evaluators.paper.document import by_position, document
from evaluators.paper.measured import Measured, from_rows
from evaluators.paper.page import ShownClip, render_side_by_side
from evaluators.paper.published import Published, published
from evaluators.paper.tables import paper_against_ours
from evaluators.paper.verdict import judge_claims

CLIPS = [f"clip-{i}" for i in range(12)]


def arms(**shift: float) -> Measured:
    """Return arms whose PSNR is a clip's own level plus the arm's shift and a little noise."""
    rng = np.random.default_rng(0)
    level = {clip: 24 + 3 * rng.normal() for clip in CLIPS}
    return Measured({arm: {c: {"psnr_db": level[c] + by + 0.1 * rng.normal()} for c in CLIPS} for arm, by in shift.items()})


def verdict_of(measured: Measured, *contests: Contest) -> str:
    return judge_claims({"cycle": measured}, [Claim(1, "it is so", "here", contests)])[0].verdict


def test_every_table_is_read_whole() -> None:
    found = published()
    cycle = found.tables["cycle"]
    assert len(cycle.rows) == 13
    assert (cycle.rows["V9"]["fvd"].value, cycle.rows["V9"]["lpips"].half_width) == (5.83, 0.013)
    assert found.tables["under-trained"].rows["difix"]["psnr_db"].value == 19.3
    assert found.tables["closed-loop"].rows["3dgs"]["offroad_percent"].half_width == 1.3
    for table in found.tables.values():
        assert all(set(row) == set(table.metrics) for row in table.rows.values())


@pytest.mark.parametrize(("row", "found"), [("13.5 .1", "2 cells for 1 metrics"), ("13,5", "cell '13,5'"), ("13.5±x", "cell '13.5±x'")])
def test_a_row_that_is_not_a_row_is_named(tmp_path: Path, row: str, found: str) -> None:
    path = tmp_path / "numbers.yaml"
    path.write_text(
        "version: 1\nsource: here\nmetrics:\n  fvd: {heading: FVD, better: lower, ours: null}\n"
        f"tables:\n  one: {{title: T, protocol: P, metrics: [fvd], rows: {{difix: '{row}'}}}}\n"
    )
    with pytest.raises(InputError) as caught:
        published(path)
    assert found in caught.value.found
    assert "row difix" in caught.value.with_what


def test_a_difference_is_paired_and_says_whom_it_favours() -> None:
    measured = arms(a=0.0, b=-0.5)
    found = measured.difference("psnr_db", "a", "b")
    assert found.low is not None
    assert found.high is not None
    assert found.low < 0.5 < found.high < found.low + 0.2  # levels spread by 3 dB cancel
    assert (found.favours, measured.difference("psnr_db", "b", "a").favours) == (1, -1)


def test_arms_without_common_clips_are_not_compared() -> None:
    with pytest.raises(EvaluatorError, match="comparing arms"):
        Measured({"a": {"x": {"psnr_db": 1.0}}, "b": {"y": {"psnr_db": 1.0}}}).difference("psnr_db", "a", "b")


def test_a_distance_of_sets_is_tested_by_swapping_clips() -> None:
    rng = np.random.default_rng(1)
    truth = {clip: {"fd_syn_16": rng.normal(size=(8, 4))} for clip in CLIPS}
    moved = {arm: {c: {"fd_syn_16": x["fd_syn_16"] + by} for c, x in truth.items()} for arm, by in (("near", 0.1), ("far", 1.0))}
    measured = Measured({"near": {}, "far": {}, "truth": {}}, {"truth": truth, **moved})
    found = measured.difference("fd_syn_16", "near", "far")
    assert found.p_value is not None
    assert found.p_value < 0.01
    assert (found.favours, found.n) == (1, 12)
    assert measured.mean("near", "fd_syn_16").centre == pytest.approx(4 * 0.1**2, abs=1e-9)


@pytest.mark.parametrize(
    ("relation", "shift", "verdict"),
    [
        ("better", 0.5, "holds"), ("better", -0.5, "does not hold"), ("better", 0.0, "undecided at our scale"),
        ("not better", -0.5, "holds"), ("not better", 0.0, "holds"), ("not better", 0.5, "does not hold"),
        ("close", 0.2, "holds"), ("close", 9.0, "does not hold"), ("close", 2.4, "undecided at our scale"),
    ],
)  # fmt: skip
def test_a_claim_has_the_verdict_of_its_contest(relation: str, shift: float, verdict: str) -> None:
    measured = arms(a=shift, b=0.0)
    assert verdict_of(measured, Contest("cycle", "psnr_db", "a", "b", relation)) == verdict  # type: ignore[arg-type]


def test_one_lost_contest_refutes_and_a_missing_arm_leaves_it_open() -> None:
    measured = arms(a=0.5, b=0.0)
    won, lost = Contest("cycle", "psnr_db", "a", "b"), Contest("cycle", "psnr_db", "b", "a")
    absent = Contest("cycle", "psnr_db", "a", "nobody")
    assert verdict_of(measured, won, absent) == "not measured"
    assert verdict_of(measured, won, absent, lost) == "does not hold"
    assert verdict_of(measured, Contest("closed-loop", "offroad", "a", "b")) == "not measured"


def test_claims_name_arms_and_metrics_that_there_are() -> None:
    known = {arm for table in published().tables.values() for arm in table.rows} | {"3dgs"}
    measured_as = {metric.ours for metric in published().metrics.values()} | {"ms_per_frame"}
    for claim in CLAIMS:
        assert claim.contests
        for contest in claim.contests:
            assert {contest.first.partition(",")[0], contest.second} <= known, claim.number
            assert contest.metric in measured_as
    assert [claim.number for claim in CLAIMS] == list(range(1, 13))


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
    text = document(found, {"under-trained": Measured(from_rows(rows))}, {"under-trained": rows}, {}, {}, "simrun bench paper")
    assert text.count("Not run.") == 6
    assert "Claim 3** was not measured: protocol cycle" in text
    windows = by_position(rows).splitlines()
    assert "| 0 to 92 | 93 to 189 |" in windows[0]
    assert windows[2].startswith("| 3dgs | 25.50 ± ")


def test_the_first_frame_waits_for_look_ahead_and_the_whole_block() -> None:
    timed = Measured({"V9": {clip: {"ms_per_frame": 20.0} for clip in CLIPS}, "3dgs": {}})
    unit = {"frames": 8, "lookahead_frames": 7, "calls_per_frame": 0.125}
    text = document(published(), {"cycle": timed}, {}, {"V9": unit, "3dgs": None}, {}, "simrun bench paper")
    assert "| V9 | 20.0 ± 0.0 | 0.125 | 7 | 860 |" in text  # 7 x 100 ms and 8 x 20 ms


def test_a_page_holds_every_frame_and_refuses_films_of_other_lengths() -> None:
    clip = ShownClip("one", {"3dgs": [b"a", b"b"], "truth": [b"c", b"d"]}, {"psnr_db": {"3dgs": [20.0, 21.0]}, "warp_l1": {"3dgs": [0.1]}})
    page = render_side_by_side([clip], (9, 16))
    assert '"lines": [[20.0, 21.0], null]' in page
    assert '"lines": [[null, 0.1], null]' in page
    assert "http://" not in page.replace("http://www.w3.org/2000/svg", "")
    with pytest.raises(EvaluatorError, match="lengths"):
        render_side_by_side([ShownClip("one", {"3dgs": [b"a"], "truth": [b"c", b"d"]}, {})], (9, 16))
    with pytest.raises(EvaluatorError, match="none"):
        render_side_by_side([], (9, 16))
