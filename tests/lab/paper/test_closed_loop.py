"""Table 2b: rates, paired differences and flips of policies behind the arms, and the claim that
rests on them.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from alpasim_plugin.lab.paper.claims import CLAIMS, DRIVERS, Claim, Comparison, behind
from alpasim_plugin.lab.paper.closed_loop import METRICS, Driven, closed_loop_section
from alpasim_plugin.lab.paper.document import Findings, document, draw_figures
from alpasim_plugin.lab.paper.published import published
from alpasim_plugin.lab.paper.tables import difference_text
from alpasim_plugin.lab.paper.verdict import judge_claims
from evaluators.statistics.paired import paired
from evaluators.statistics.summary import aggregate

SCENES, SEEDS = 20, 3


def rows_of(
    events: dict[str, Callable[[int, int], bool]], policy: str = "learned"
) -> list[dict[str, Any]]:
    """Return rollouts in which a renderer leaves the road where its rule of scene and seed says
    so.
    """
    rng = np.random.default_rng(1)
    level = rng.uniform(0.2, 0.4, (SCENES, SEEDS))
    rows = []
    for renderer, rule in events.items():
        for scene in range(SCENES):
            for seed in range(SEEDS):
                off = float(rule(scene, seed))
                values = {
                    "collision_at_fault": 0.0,
                    "offroad": off,
                    "offroad_or_collision_at_fault": off,
                    "route_distance_m": level[scene, seed] + 0.5 * off,
                    "progress": 1.0 - 0.5 * off,
                }
                metrics = {
                    name: {"value": value, "valid": True, "reason": ""}
                    for name, value in values.items()
                }
                rows.append(
                    {
                        "renderer": renderer,
                        "policy": policy,
                        "scene": f"s{scene:02d}",
                        "seed": seed,
                        "status": "ok",
                        "metrics": metrics,
                    }
                )
    return rows


def never(scene: int, seed: int) -> bool:
    return False


EVENTS: dict[str, Callable[[int, int], bool]] = {
    "3dgs": lambda scene, seed: scene < 12,
    "difix": lambda scene, seed: scene == 19,
    "V9": never,
}


def table(text: str, first: str) -> dict[str, list[str]]:
    """Return the rows of the table whose head begins so, by their first cell."""
    lines = text.splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith(f"| {first} |")) + 2
    end = next(
        i for i in range(start, len(lines) + 1) if i == len(lines) or not lines[i].startswith("|")
    )
    found = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[start:end]]
    return {
        row[0] if not row[1].startswith("`") else f"{row[0]} {row[1]}": row[1:] for row in found
    }


def test_rates_and_differences_are_those_of_a_run() -> None:
    rows = rows_of(EVENTS)
    text = closed_loop_section(published(), [Driven("learned", rows)], "f.png")
    means, off = aggregate(rows)["3dgs"]["offroad"], METRICS.index("offroad")
    low, high = means["ci95_clustered"]
    half = f"{100 * means['ci95']:.1f}"
    assert (
        table(text, "renderer")["3dgs"][off]
        == f"60.0, 36/60 ({100 * low:.1f} to {100 * high:.1f}\u202f%)"
    )
    entry = paired(rows, "3dgs")["V9"]["offroad"]
    low, high = (f"{100 * bound:.1f}".replace("-", "−") for bound in entry["ci95"])
    assert (
        table(text, "minus 3dgs")["V9"][off]
        == f"**−60.0\u00a0points ({low} to {high}), p < 0.001**"
    )
    assert re.search(rf"\*\*3dgs\*\* \| paper \|.*\n\|\s+\| ours \|.*60\.0±{half}", text)
    assert "20\u00a0scenes x 3\u00a0seeds" in text


def test_flips_are_counted_both_ways() -> None:
    text = closed_loop_section(published(), [Driven("learned", rows_of(EVENTS))], "f.png")
    flips = table(text[text.index("Flips") :], "renderer")
    assert flips["difix `offroad`"][1:] == ["3", "36", "< 0.001", "1", "12", "0.003"]
    assert flips["V9 `collision_at_fault`"][1:] == ["0", "0", "1.000", "0", "0", "1.000"]


def test_an_event_that_nobody_had_is_not_taken_for_equality() -> None:
    driven = Driven("learned", rows_of(EVENTS))
    found = driven.difference("collision_at_fault", "difix", "3dgs")
    assert found.low is not None
    assert found.high is not None
    assert (
        min(-found.low, found.high) > 0.05
    )  # 20 scenes without an event do not bound a rate below some percent
    comparison = Comparison(driven.protocol, "collision_at_fault", "difix", "3dgs", "equal")
    judged = judge_claims({driven.protocol: driven}, [Claim("it is so", "here", (comparison,))])
    assert judged[0].verdict == "undecided"


@pytest.mark.parametrize(
    ("first", "second", "outcome"),
    [("difix", "3dgs", "for"), ("3dgs", "V9", "against"), ("difix", "V9", "open")],
)
def test_a_contest_is_decided_as_the_run_decides_it(first: str, second: str, outcome: str) -> None:
    driven = Driven("learned", rows_of(EVENTS))
    judged = judge_claims(
        {driven.protocol: driven},
        [Claim("", "", (Comparison(driven.protocol, "offroad", first, second),))],
    )
    assert judged[0].results[0].outcome == outcome
    assert (
        driven.only([first, second]).difference("offroad", first, second)
        == judged[0].results[0].difference
    )


def test_the_claim_asks_both_policies() -> None:
    claim = next(claim for claim in CLAIMS if claim.text.startswith("OmniDreams and Self-Forcing"))
    assert {comparison.protocol for comparison in claim.comparisons} == {
        behind(policy) for policy in DRIVERS
    }
    always = EVENTS["3dgs"]
    alone = Driven(
        "learned", rows_of({"3dgs": always, "omnidreams@4": always, "self-forcing": always})
    )
    judged = judge_claims({alone.protocol: alone}, [claim])[0]
    assert judged.verdict == "not measured"
    assert {result.missing for result in judged.results} == {
        "",
        "protocol closed-loop, lane-camera",
    }


def test_the_document_has_a_part_and_a_picture_of_every_policy(tmp_path: Path) -> None:
    drives = [Driven(policy, rows_of(EVENTS, policy)) for policy in DRIVERS]
    found = Findings({one.protocol: one for one in drives}, {}, {})
    draw_figures(found, tmp_path)
    assert cv2.imread(str(tmp_path / "closed-loop.png")).std() > 5
    text = document(published(), found, "simrun bench paper")
    section = text[text.index("## In closed loop") : text.index("## A wrong map")]
    assert re.findall(r"^### Behind `(.*)`$", section, re.MULTILINE) == list(DRIVERS)
    assert "## In closed loop\n\nNot run." in document(
        published(), Findings({}, {}, {}), "simrun bench paper"
    )


def test_a_failed_rollout_is_in_no_rate_and_a_lopsided_interval_shows_its_bounds() -> None:
    rows = rows_of({"3dgs": lambda scene, seed: scene == 0 and seed == 0, "V9": never})
    rows[0] |= {"status": "failed", "failure_class": "renderer"}  # the only one with the event
    text = closed_loop_section(published(), [Driven("learned", rows)], "f.png")
    assert table(text, "renderer")["3dgs"][METRICS.index("offroad")].startswith(
        "0.0, 0/59 (0.0 to "
    )
    rows[0] |= {"status": "ok"}
    driven = Driven("learned", rows)
    comparison = Comparison(driven.protocol, "offroad", "V9", "3dgs")
    findings = document(
        published(), Findings({driven.protocol: driven}, {}, {}), "simrun bench paper"
    )
    assert driven.difference("offroad", "V9", "3dgs").favours == 0
    assert "protocol closed-loop, lane-camera" in findings
    assert re.fullmatch(
        r"-\d\.\d+ \[-\d\.\d+, \+\d\.\d+\]",
        difference_text(driven.difference(comparison.metric, "V9", "3dgs")),
    )


@pytest.mark.parametrize(("lost", "outcome"), [(12, "for"), (0, "against"), (6, "open")])
def test_a_drop_by_a_share_is_asked_of_what_is_left_without_it(lost: int, outcome: str) -> None:
    rows = rows_of(
        {"3dgs": lambda scene, seed: scene < 12, "V9": lambda scene, seed: lost <= scene < 12}
    )
    driven = Driven("learned", rows)
    comparison = Comparison(driven.protocol, "offroad", "V9", "3dgs", share=1 / 3)
    result = judge_claims({driven.protocol: driven}, [Claim("", "", (comparison,))])[0].results[0]
    assert result.outcome == outcome
    assert result.difference is not None
    assert result.difference.difference == pytest.approx((12 - lost) / SCENES - 2 / 3 * 12 / SCENES)
