"""What a policy says of itself: whatever it is, a row of bounded size, and no failure."""

import json

import numpy as np
import pytest

from alpasim_plugin.log.debug import MOST_VALUES, NAME_LETTERS, debug_row, size_of


class Leaves:
    def __str__(self):
        raise SystemExit(3)


class LeavingWord(str):
    __slots__ = ()

    def __str__(self):
        raise SystemExit(3)


@pytest.mark.parametrize(
    ("debug", "text"),
    [
        ({"x": 10**5000}, ["debug", "not shown: ValueError"]),
        ({"x": [[1], [1, 2]]}, ["debug", "not shown: ValueError"]),
        ({Leaves(): 1}, ["debug", "not shown: SystemExit"]),
        ({"x": LeavingWord("a")}, ["debug", "not shown: SystemExit"]),
        ({"x": Leaves()}, ["x", "not shown: Leaves"]),
        ({"n" * 10**6: "w" * 10**6}, ["n" * NAME_LETTERS, "w" * 300]),
        ({"boxes": np.ones((10**6, 4))}, ["boxes", "not shown: ndarray of shape (1000000, 4)"]),
    ],
)
def test_what_cannot_be_shown_is_named(debug, text):
    row = debug_row({"good": 1.5, **debug})
    assert row["text"] == [["good", "1.5"], text]


def test_names_that_are_no_words_and_many_values():
    row = debug_row({number: np.eye(4) for number in range(MOST_VALUES + 7)})
    assert [values[0] for values in row["heat"]] == [str(n) for n in range(MOST_VALUES)]
    assert row["text"] == [["debug", "not shown: 7 more values"]]


def test_a_row_of_large_values_is_small_and_says_how_large_it_is():
    random = np.random.default_rng(0)
    row = debug_row(
        {
            "camera": random.integers(0, 256, (1500, 2000, 3), dtype=np.uint8),
            "heat": random.random((3000, 3000)),
            "boxes": random.random((1000, 4)),
        }
    )
    assert all(row[kind] for kind in ("images", "heat", "boxes"))
    written = len(json.dumps(row))
    assert written < 2 << 20
    assert 0.5 < size_of(row) / written < 2.0
