"""The verdict on a claim: contests, power, the raw render as control, room for histories, Holm's
correction.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import scipy.stats

from alpasim_plugin.core.errors import EvaluatorError, InputError
from alpasim_plugin.lab.paper.claims import Claim, Comparison, Relation, margin
from alpasim_plugin.lab.paper.measured import Measured
from alpasim_plugin.lab.paper.record import record_of, recorded
from alpasim_plugin.lab.paper.verdict import judge_claims
from tests.lab.paper.arm_cases import CLIPS, arms


def verdict_of(measured: Measured, *comparisons: Comparison) -> str:
    return judge_claims({"cycle": measured}, [Claim("it is so", "here", comparisons)])[0].verdict


@pytest.mark.parametrize(
    ("relation", "shift", "verdict"),
    [
        ("better", 0.5, "holds"),
        ("better", -0.5, "does not hold"),
        ("better", 0.0, "does not hold"),
        ("better", 0.15, "does not hold"),
        ("better", 0.3, "holds"),
        ("not better", -0.5, "holds"),
        ("not better", 0.0, "holds"),
        ("not better", 0.5, "does not hold"),
        ("equal", 0.15, "holds"),
        ("equal", 0.9, "does not hold"),
        ("equal", 0.3, "undecided"),
    ],
)
def test_a_claim_has_the_verdict_of_its_contest(relation: str, shift: float, verdict: str) -> None:
    measured = arms(a=shift, b=0.0)  # the margin of PSNR is 0.3 dB, an interval 0.1 wide
    assert verdict_of(measured, Comparison("cycle", "psnr_db", "a", "b", relation)) == verdict  # type: ignore[arg-type]


def test_one_lost_contest_refutes_and_a_missing_arm_leaves_it_open() -> None:
    measured = arms(a=0.5, b=0.0)
    won, lost = Comparison("cycle", "psnr_db", "a", "b"), Comparison("cycle", "psnr_db", "b", "a")
    absent = Comparison("cycle", "psnr_db", "a", "nobody")
    assert verdict_of(measured, won, absent) == "not measured"
    assert verdict_of(measured, won, absent, lost) == "does not hold"
    assert verdict_of(measured, Comparison("closed-loop", "offroad", "a", "b")) == "not measured"


@pytest.mark.parametrize(
    ("render", "verdict"), [(-1.0, "holds"), (0.2, "not trained"), (0.9, "not trained")]
)
def test_an_arm_that_does_not_beat_its_own_input_is_not_beaten(render: float, verdict: str) -> None:
    measured = arms(**{"a": 0.6, "b": 0.0, "3dgs": render})
    won = Comparison("cycle", "psnr_db", "a", "b")
    assert verdict_of(measured, won) == verdict
    assert (
        verdict_of(arms(**{"a": 0.6, "3dgs": 0.0}), Comparison("cycle", "psnr_db", "a", "3dgs"))
        == "holds"
    )


def test_power_depends_on_the_width_alone_and_says_what_could_be_shown() -> None:
    def power(shift: float, noise: float, relation: Relation) -> float:
        rng = np.random.default_rng(0)
        values = {
            arm: {c: {"psnr_db": by + noise * rng.normal()} for c in CLIPS}
            for arm, by in (("a", shift), ("b", 0.0))
        }
        judged = judge_claims(
            {"cycle": Measured(values)},
            [Claim("", "", (Comparison("cycle", "psnr_db", "a", "b", relation),))],
        )
        assert judged[0].power is not None
        return judged[0].power

    assert power(0.0, 0.3, "better") == pytest.approx(power(2.0, 0.3, "better"))
    assert power(0.0, 0.01, "better") > 0.999
    assert power(0.0, 0.3, "equal") < power(0.0, 0.3, "better") < 0.8
    assert power(0.0, 3.0, "equal") == 0.0


@pytest.mark.parametrize(
    ("gain", "verdict"), [(None, "not measured"), (0.1, "no room for a history"), (0.8, "holds")]
)
def test_a_claim_on_histories_needs_room_for_them(gain: float | None, verdict: str) -> None:
    measured = arms(a=0.5, b=0.0, **({} if gain is None else {"a, oracle history": 0.5 + gain}))
    claim = Claim("", "", (Comparison("cycle", "psnr_db", "a", "b"),), of_history=True)
    assert judge_claims({"cycle": measured}, [claim])[0].verdict == verdict


def test_a_record_judges_as_what_it_was_made_of(tmp_path: Path) -> None:
    shifts = {"3dgs": -2.0, "V9": 0.0, "V7": 0.05, "difix": -1.0, "self-forcing": 0.4}
    measured = {"cycle": arms(**shifts)}
    path = tmp_path / "paper.json"
    path.write_text(json.dumps({"protocols": record_of(measured, {"cycle": list(shifts)})}))
    again = recorded(path)
    new, old = ([one.verdict for one in judge_claims(source)] for source in (measured, again))
    assert new == old
    assert (
        again["cycle"].difference("psnr_db", "V9", "V7").high
        == measured["cycle"].difference("psnr_db", "V9", "V7").high
    )
    wide, narrow = (
        again["cycle"].difference("psnr_db", "V7", "self-forcing"),
        measured["cycle"].difference("psnr_db", "V7", "self-forcing"),
    )
    assert wide.difference == pytest.approx(narrow.difference)
    assert wide.bounds is not None
    assert narrow.low is not None
    assert wide.bounds[0] <= narrow.low, "by way of V9: never too narrow"
    with pytest.raises(EvaluatorError, match="no such difference"):
        again["cycle"].difference("ssim", "V9", "V7")
    path.write_text('{"protocols": {"cycle": 1}}')
    with pytest.raises(InputError, match="no record"):
        recorded(path)


def test_the_p_value_of_a_difference_is_that_of_the_paired_t_test() -> None:
    measured = arms(a=0.03, b=0.0)
    a, b = ([measured.values[arm][clip]["psnr_db"] for clip in CLIPS] for arm in "ab")
    assert measured.difference("psnr_db", "a", "b").p_value == pytest.approx(
        scipy.stats.ttest_rel(a, b).pvalue
    )
    assert measured.margin("psnr_db", "a", 23.0).p_value == pytest.approx(
        scipy.stats.ttest_1samp(a, 23.0).pvalue
    )
    equal = Measured(
        {
            arm: {c: {"psnr_db": level} for c in CLIPS}
            for arm, level in (("a", 1.0), ("b", 2.0), ("c", 1.0))
        }
    )
    assert (
        equal.difference("psnr_db", "a", "b").p_value,
        equal.difference("psnr_db", "a", "c").p_value,
    ) == (0.0, 1.0)


def lost_with(p_value: float, others: int) -> tuple[Measured, tuple[Comparison, ...]]:
    """Return one comparison that is lost with a two-sided p-value, and others that are as much
    better as is asked for.
    """
    x = np.linspace(-1, 1, len(CLIPS))
    shift = scipy.stats.t.isf(p_value / 2, len(CLIPS) - 1) * x.std(ddof=1) / np.sqrt(len(CLIPS))
    values = {
        "a": np.full(len(CLIPS), margin("psnr_db")),
        "b": x + shift,
        **{f"c{i}": x for i in range(others)},
    }
    measured = Measured(
        {
            arm: {c: {"psnr_db": float(v)} for c, v in zip(CLIPS, many, strict=True)}
            for arm, many in values.items()
        }
    )
    return measured, tuple(
        Comparison("cycle", "psnr_db", "a", rival) for rival in values if rival != "a"
    )


@pytest.mark.parametrize(
    ("p_value", "others", "verdict"),
    [
        (0.04, 0, "does not hold"),
        (0.06, 0, "undecided"),
        (0.04, 1, "undecided"),
        (0.024, 1, "does not hold"),
        (0.024, 2, "undecided"),
        (0.0004, 99, "does not hold"),
        (0.0006, 99, "undecided"),
    ],
)
def test_a_lost_contest_refutes_if_it_is_lost_among_so_many(
    p_value: float, others: int, verdict: str
) -> None:
    measured, comparisons = lost_with(p_value, others)
    judged = judge_claims({"cycle": measured}, [Claim("it is so", "here", comparisons)])[0]
    assert judged.verdict == verdict
    assert judged.count("against") == (p_value < 0.05), (
        "by its own interval it is lost all the same"
    )
    assert judged.results[0].refutes == pytest.approx(min(p_value / 2 * (others + 1), 1.0))


@pytest.mark.parametrize(
    ("level", "verdict"), [(0.97, "holds"), (0.85, "does not hold"), (0.9, "undecided")]
)
def test_a_contest_with_a_bound_asks_whether_the_mean_is_shown_to_be_on_one_side(
    level: float, verdict: str
) -> None:
    measured = Measured(
        {
            "a": {
                clip: {"style_acc_syn": level + (0.02 if i % 2 else -0.02)}
                for i, clip in enumerate(CLIPS)
            }
        }
    )
    assert (
        verdict_of(measured, Comparison("cycle", "style_acc_syn", "a", "0.9", bound=0.9)) == verdict
    )
    exact = Measured({"a": {clip: {"style_acc_syn": level} for clip in CLIPS}})
    assert exact.margin("style_acc_syn", "a", 0.9).difference == pytest.approx(level - 0.9)
