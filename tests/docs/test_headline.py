"""The headline about driving is what its record says: over scenes and over families."""

import importlib

import numpy as np
import pytest

RECORD = """
<!-- begin closed-loop -->
19.8 s each.

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


@pytest.fixture
def headline(repo, monkeypatch):
    monkeypatch.syspath_prepend(str(repo / "docs" / "scripts"))
    return importlib.import_module("headline")


def test_readme_and_results_say_what_the_record_says(headline):
    pages = headline.written(headline.read_record(headline.RECORD.read_text(encoding="utf-8")))
    assert {path.name for path in pages} == {"README.md", "index.md"}
    for path, text in pages.items():
        assert path.read_text(encoding="utf-8") == text, "run python docs/scripts/headline.py"


def test_the_sentence_has_the_numbers_of_the_policy(headline):
    text = headline.sentence(headline.read_record(RECORD)).replace("\n", " ")
    assert "12 rollouts of the policy `learned`, 19.8 s each" in text
    assert "two frozen test sets, 3 families, 2 seeds" in text
    assert "50.0 % behind `3dgs`, 8.3 % behind `onefixer` and 0.0 % behind `clean`" in text


def test_the_interval_over_families_is_t_on_the_sums_of_their_residuals(
    headline,
):
    record = headline.read_record(RECORD)
    # -1, -4 and 0 of 4 rollouts: mean -5/12, residuals 2/3, -7/3 and 5/3, t of 2 degrees 4.3027
    half = 100 * 4.3027 * np.sqrt(3 / 2 * (4 / 9 + 49 / 9 + 25 / 9)) / 12
    assert record.over_families("onefixer") == pytest.approx(
        (-500 / 12 - half, -500 / 12 + half), rel=1e-4
    )
    assert record.without("onefixer") == ("hills", pytest.approx(-12.5))


@pytest.mark.parametrize(
    "text", ["no tables", RECORD.replace("19.8 s each.", ""), RECORD.replace("learned", "other")]
)
def test_a_record_without_what_is_claimed_is_refused(headline, text):
    with pytest.raises(AssertionError):
        headline.read_record(text)
