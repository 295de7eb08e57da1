"""Where a picture comes from: means by cell, at sizes that cells do not divide, and the text that
keeps them.
"""

import numpy as np
import pytest
import torch

from alpasim_plugin.core.types import GUESSED_SHARE, RECORDED_SHARE, TRUST_CELLS
from alpasim_plugin.fixers.trust import (
    CELL_PX,
    LEVELS,
    MADE_UP,
    MOST_COLUMNS,
    trust_facts,
    trust_sums,
)
from evaluators.pages.images import trust_by_time
from evaluators.statistics.sentences import seen_before


def trust(output, render, recorded):
    images = (torch.from_numpy(x)[None] for x in (output, render, recorded[..., None]))
    return trust_facts(trust_sums(*images)[0].numpy(), *recorded.shape)


def trust_cells(text):
    """Return the shares of every cell ``(rows, columns, 2)``, in fifteenths."""
    size, _, digits = text.partition(":")
    columns, rows = (int(part) for part in size.split("x"))
    return np.array([int(digit, 16) for digit in digits], dtype=np.uint8).reshape(rows, columns, 2)


@pytest.mark.parametrize(
    ("height", "width"), [(144, 256), (150, 250), (9, 7), (288, 512), (270, 600)]
)
def test_cells_are_the_means_of_their_pixels(height, width):
    rng = np.random.default_rng(height)
    render = rng.uniform(-1, 1, (height, width, 3)).astype(np.float32)
    recorded = rng.random((height, width), np.float32)
    output = render + rng.uniform(-0.4, 0.4, render.shape).astype(np.float32)
    found = trust(output, render, recorded)
    guessed = np.minimum(np.abs(output - render).mean(axis=2) / MADE_UP, 1) * (1 - recorded)
    assert found[RECORDED_SHARE] == pytest.approx(recorded.mean(), abs=1e-5)
    assert found[GUESSED_SHARE] == pytest.approx(guessed.mean(), abs=1e-5)
    cells = trust_cells(str(found[TRUST_CELLS]))
    side = max(CELL_PX, int(np.ceil(width / MOST_COLUMNS)))
    assert cells.shape == (-(-height // side), -(-width // side), 2)
    assert cells.shape[1] <= MOST_COLUMNS
    for row, column in np.ndindex(*cells.shape[:2]):
        here = slice(row * side, (row + 1) * side), slice(column * side, (column + 1) * side)
        for k, shares in enumerate((recorded, guessed)):
            assert (
                abs(int(cells[row, column, k]) / LEVELS - shares[here].mean())
                <= 0.5 / LEVELS + 1e-6
            )


def test_a_render_that_stays_is_neither_recorded_nor_guessed_and_a_reference_is_never_guessed():
    grey = np.zeros((32, 48, 3), dtype=np.float32)
    zero = np.zeros((32, 48), dtype=np.float32)
    assert trust(grey, grey, zero) == {
        RECORDED_SHARE: 0,
        GUESSED_SHARE: 0,
        TRUST_CELLS: "3x2:" + 6 * "00",
    }
    assert trust(grey + 1, grey, zero)[TRUST_CELLS] == "3x2:" + 6 * "0f"
    assert trust(grey + 1, grey, zero + 1) == {
        RECORDED_SHARE: 1,
        GUESSED_SHARE: 0,
        TRUST_CELLS: "3x2:" + 6 * "f0",
    }


def test_a_page_says_what_was_seen_in_the_second_before():
    rows = [
        {
            "t_us": t,
            "camera": "front",
            GUESSED_SHARE: t / 1e7,
            RECORDED_SHARE: 0.5,
            TRUST_CELLS: "1x1:f0",
        }
        for t in range(0, 2_000_001, 500_000)
    ]
    assert seen_before(rows, 2_000_000).startswith(
        "15 % of what it saw in the second before was made up by the fixer, 50 % was recorded"
    )
    assert seen_before(rows, 9_000_000) == ""
    assert seen_before([{"t_us": 0, "camera": "front"}], 0) == ""
    assert trust_by_time(rows, "front")[500_000] == "1x1:f0"
    assert trust_by_time(rows, "side") == {}
