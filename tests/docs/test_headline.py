"""The headline about driving is what its record says: how long the drives are, of which sets, over
scenes and over families.
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest


@pytest.fixture
def headline(repo: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(repo / "docs" / "scripts"))
    return importlib.import_module("headline")


RECORD = """
<!-- begin closed-loop -->
{length}

**learned**: 6 scenes x 2 seeds

| metric | clean | 3dgs | onefixer |
|---|---|---|---|
| `offroad_or_collision_at_fault` (%) | 0.0 ± 0.0 [0.0, 6.0] | 50.0 ± 4.0 [8.2, 94.9] | 8.3 ± 1.7 [0.7, 47.3] |
| `lateral_distance_m` (m) | 0.191 ± 0.030 [0.127, 0.254] | 0.532 ± 0.094 [0.327, 0.737] | 0.283 ± 0.054 [0.174, 0.391] |

| minus 3dgs | clean | onefixer |
|---|---|---|
| `offroad_or_collision_at_fault` (%) | -50.0 [-81.8, -5.6], p 0.000 | -41.7 [-79.9, -4.8], p 0.000 |

| left the road or at fault, rollouts | clean | 3dgs | onefixer |
|---|---|---|---|
| bends | 0 of 4 | 1 of 4 | 0 of 4 |
| hills | 0 of 4 | 4 of 4 | 0 of 4 |
| towns | 0 of 4 | 1 of 4 | 1 of 4 |

**lane-camera**: 6 scenes x 2 seeds

| metric | clean |
|---|---|
| `offroad_or_collision_at_fault` (%) | 99.0 |
<!-- end closed-loop -->
"""


def test_readme_and_results_say_what_the_record_says(
    headline: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    pages = headline.written(headline.read_record(headline.RECORD.read_text(encoding="utf-8")))
    assert {path.name for path in pages} == {"README.md", "results.md"}
    for path, text in pages.items():
        assert path.read_text(encoding="utf-8") == text, (
            f"{path.name}: run python docs/scripts/headline.py"
        )


def test_a_sentence_has_the_length_of_the_drives_the_sets_and_the_families(
    headline: ModuleType,
) -> None:
    said = headline.sentence(headline.read_record(RECORD.format(length="8 s each; `one` 9 s.")))
    for part in (
        "12 rollouts of the policy `learned`",
        "cut to its first 8 of 19.8 s",
        "two frozen test sets, 3 families, 2 seeds",
    ):
        assert part in said.replace("\n", " ")
    assert "50.0 % behind `3dgs`, 8.3 % behind `onefixer` and 0.0 % behind `clean`" in said
    whole = headline.sentence(headline.read_record(RECORD.format(length="19.8 s each.")))
    assert "19.8 s each" in whole
    assert "cut" not in whole


def test_the_interval_over_families_is_that_of_the_scenes_whatever_they_are_within_a_family(
    headline: ModuleType,
) -> None:
    record = headline.read_record(RECORD.format(length="19.8 s each."))
    scenes = np.array(
        [0.0, -0.5, -1.0, -1.0, 0.5, -0.5]
    )  # sums of two: -1 of 4, -4 of 4 and 0 of 4 rollouts
    assert record.over_families("onefixer") == pytest.approx(
        [100 * end for end in headline.family_bounds(scenes, np.array([0, 0, 1, 1, 2, 2]))]
    )
    assert record.without("onefixer") == ("hills", pytest.approx(-12.5))


def test_a_record_without_what_is_claimed_is_refused(headline: ModuleType) -> None:
    for text, found in (
        ("no tables", "no tables"),
        (RECORD.format(length="60 scenes"), "how long"),
        (RECORD.replace("learned", "other"), "learned"),
    ):
        with pytest.raises(AssertionError, match=found):
            headline.read_record(text.format(length="8 s each."))


def test_the_command_compares_and_fails_where_a_page_differs(
    headline: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    page = tmp_path / "README.md"
    page.write_text("stale\n")
    monkeypatch.setattr(headline, "written", lambda record: {page: "as it should be\n"})
    monkeypatch.setattr(sys, "argv", ["headline.py", "--check"])
    with pytest.raises(SystemExit, match="1"):
        headline.main()
    assert "run docs/scripts/headline.py" in capsys.readouterr().out
    assert page.read_text() == "stale\n"
    monkeypatch.setattr(sys, "argv", ["headline.py"])
    headline.main()
    assert page.read_text() == "as it should be\n"
