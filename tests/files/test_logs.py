"""Recorded logs without what a reader could do without."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scenarios.argoverse import read_argoverse
from scenarios.load import load_scenario
from tests.scenarios.make_argoverse import TRACKS, cuboids, write_argoverse


@pytest.mark.parametrize("empty", [False, True])
def test_an_argoverse_log_of_the_test_split_drives_alone(tmp_path: Path, empty: bool) -> None:
    none = {key: np.array(value)[:0] for key, value in cuboids(TRACKS).items()}
    folder = write_argoverse(tmp_path / "x", annotations=none)
    if not empty:
        (folder / "annotations.feather").unlink()
    log = read_argoverse(folder)
    assert log.actors == ()
    assert any("test split" in note for note in log.notes)
    assert load_scenario(folder).actors == ()
