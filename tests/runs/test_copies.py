"""What is not rendered: frames for a policy without a camera, and the past of a fork."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np

from alpasim_plugin.core.interfaces import Renderer, complete
from alpasim_plugin.core.types import Frame, RenderRequest, Scenario
from alpasim_plugin.log.video import read_mp4
from alpasim_plugin.runs.cameras import recorded_requests
from alpasim_plugin.runs.cell import make_renderer
from alpasim_plugin.runs.fork import SwitchedRenderer
from alpasim_plugin.runs.plan import RunOptions, RunPlan, make_plan
from alpasim_plugin.runs.run import execute_run
from scenarios.suite import expand
from tests.runs.grey_renderer import GREY, Darker, Grey
from tests.runs.test_runs import Announced

DARKER = "tests.runs.grey_renderer:Darker"
SMALL = SimpleNamespace(name="front", width=8, height=4)
SHORT = ("timing.duration_us=1200000", "degradation.kind=none")


class Counts(Grey):
    """Counts its frames."""

    frames = 0

    def render(self, request: RenderRequest) -> Frame:
        self.frames += 1
        return super().render(request)


def plan_of(
    policy: str = "constant-velocity", renderers: tuple[str, ...] = (GREY, DARKER), **options: str
) -> RunPlan:
    refs = [ref for name in ("smoke/straight", "smoke/curve") for ref in expand(name, SHORT)]
    return make_plan(refs, renderers, (policy,), (0,), RunOptions(**options))  # type: ignore[arg-type]


def drive(plan: RunPlan, root: Path, workers: int = 1) -> tuple[dict, Announced]:
    announced = Announced()
    run = execute_run(plan, root, workers, ["simrun"], announced, report=False)
    return run.summary, announced


def test_without_a_camera_the_renderer_changes_nothing(tmp_path: Path) -> None:
    plan = plan_of()
    summary, _ = drive(plan, tmp_path, workers=2)
    assert {one["diff"] for one in summary["paired"][DARKER].values()} <= {0.0, None}


def test_films_show_each_renderer_and_only_those_of_failures_are_made(tmp_path: Path) -> None:
    plan = plan_of(video="all")
    drive(plan, tmp_path / "all")
    for cell, level in zip(plan.cells, (Grey.level, Darker.level) * 2, strict=True):
        film = read_mp4(tmp_path / "all" / cell.folder / "front.mp4")
        assert film.fps == 10
        assert len(film.frames) == 13  # both ends of 1.2 s
        np.testing.assert_allclose(film.frames, level, atol=2)
    drive(plan_of(), tmp_path / "failures")
    assert not list((tmp_path / "failures").rglob("front.mp4"))


def test_a_fork_shows_the_past_only_to_a_renderer_with_a_history() -> None:
    early, late = (SimpleNamespace(t_us=t_us, camera=SMALL) for t_us in (0, 200_000))
    for has_history in (True, False):
        first, then = (complete(make(), Renderer) for make in (Counts, Counts))
        then.has_history = has_history
        switched = SwitchedRenderer(first, then, 100_000)
        switched.render_batch([early])
        assert (first.frames, then.frames) == (1, has_history)
        switched.render_batch([late])
        assert (first.frames, then.frames) == (1, has_history + 1)


def test_clean_has_no_history(straight_road: Scenario) -> None:
    requests = [recorded_requests(straight_road, straight_road.start_us + t) for t in (0, 500_000)]
    (alone,) = make_renderer("clean", straight_road).render_batch(requests[1][:1])
    renderer = make_renderer("clean", straight_road)
    renderer.render_batch(requests[0][:1])
    assert not renderer.has_history
    np.testing.assert_array_equal(renderer.render_batch(requests[1][:1])[0].rgb, alone.rgb)
