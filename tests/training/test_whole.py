"""Training data appears whole or not at all, and a disk that refuses is told in four parts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from alpasim_plugin.errors import InfrastructureError
from alpasim_plugin.training.whole import save_array, whole_folder


def test_a_block_that_fails_leaves_the_old_folder(tmp_path: Path) -> None:
    folder = tmp_path / "a"
    with whole_folder(folder, "writing") as partial:
        (partial / "x").write_text("old")
    for error, seen in ((ValueError("no"), ValueError), (OSError(28, "No space left"), InfrastructureError)):
        with pytest.raises(seen), whole_folder(folder, "writing") as partial:  # noqa: PT012 - the block is what fails
            (partial / "x").write_text("new")
            raise error
    assert (folder / "x").read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_an_array_that_cannot_be_written_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "z.npy"
    save_array(path, np.arange(3))
    np.testing.assert_array_equal(np.load(path), [0, 1, 2])

    def full(file: object, array: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "save", full)
    with pytest.raises(InfrastructureError, match="No space left"):
        save_array(path, np.zeros(3))
    assert [p.name for p in tmp_path.iterdir()] == ["z.npy"]
    np.testing.assert_array_equal(np.load(path), [0, 1, 2])
