"""Scenes found by their ids: what a caller may ask for is bounded."""

from __future__ import annotations

import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.runs import score_logs
from alpasim_plugin.runs.score_logs import KnownScenes


def test_scenes_of_many_seeds_are_not_all_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(score_logs, "MOST_SEEDED", 2)
    known = KnownScenes(["smoke/straight"])
    own = known.of("smoke-straight").scene.scene_id
    for seed in range(1, 6):
        assert known.of(f"{own}-seed{seed}").scene.scene_id == f"{own}-seed{seed}"
    for _ in range(3):
        with pytest.raises(InputError):
            known.of(f"{own}-seed005")
    assert sorted(known._read) == [own, f"{own}-seed4", f"{own}-seed5"]
