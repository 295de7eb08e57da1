from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from alpasim_plugin.core.types import RolloutLog
from alpasim_plugin.log import read_asl
from alpasim_plugin.run_folder.rows import series_by_cell
from evaluators.opening import Run, read_run
from tests.io.checksum_files import vouch_for
from tests.report.make_run import Plan
from tests.viewer.make_watched import make_watched

SMALL = Plan(
    renderers=("clean", "3dgs"), scenes=("urban-left_turn",), seeds=(0, 1), steps=8, pictures=False, fail=[("3dgs", "urban-left_turn", 1)]
)


@dataclass
class Watched:
    """A small run with logs: two renderers, one scene, two seeds (3dgs failed in the second), eight steps, two cameras."""

    folder: Path
    run: Run

    def log(self, renderer: str) -> RolloutLog:
        return read_asl(self.folder / "rollouts" / renderer / "lane-camera" / "urban-left_turn" / "0" / "rollout.asl")

    def metrics(self, renderer: str) -> dict[str, list[tuple[int, float]]]:
        (rollout,) = (r for r in self.run.rollouts if (r.renderer, r.seed) == (renderer, 0))
        (own,) = series_by_cell(self.run.steps_of(rollout)).values()
        return {name: list(zip(t.tolist(), v.tolist(), strict=True)) for name, (t, v) in own.items()}


@pytest.fixture(scope="session")
def watched(tmp_path_factory: pytest.TempPathFactory) -> Watched:
    folder = make_watched(tmp_path_factory.mktemp("recorded"), SMALL, actors=4, cameras=("front", "side"))
    return Watched(vouch_for(folder), read_run(folder))
