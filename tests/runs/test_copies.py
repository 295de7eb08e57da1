"""What is driven and rendered once: rollouts without a camera, and the past of a fork."""

import shutil
from dataclasses import fields
from types import SimpleNamespace

import numpy as np
import pyarrow.parquet as pq
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from alpasim_plugin.core.interfaces import Renderer, complete
from alpasim_plugin.core.parts.spec import short_digest
from alpasim_plugin.core.types import Frame, SensorSpec
from alpasim_plugin.log import read_asl
from alpasim_plugin.log.images import decode_image
from alpasim_plugin.log.run_folder.check import inspect_run
from alpasim_plugin.log.run_folder.manifests import read_manifest
from alpasim_plugin.log.video import read_mp4
from alpasim_plugin.runs.cameras import recorded_requests
from alpasim_plugin.runs.cell import run_cell
from alpasim_plugin.runs.film import Film
from alpasim_plugin.runs.fork import SwitchedRenderer
from alpasim_plugin.runs.plan import RunOptions, make_plan
from alpasim_plugin.runs.renderer import make_renderer
from alpasim_plugin.runs.reports import shown_at
from alpasim_plugin.runs.run import execute_run
from policies.simple import ConstantVelocity
from scenarios.suite import expand
from tests.runs.grey_renderer import GREY, Darker, Grey
from tests.runs.short_runs import Announced

DARKER = "tests.runs.grey_renderer:Darker"
SEES = f"{__name__}:SeesAfterAll"
SMALL = SimpleNamespace(name="front", width=8, height=4)
SHORT = ("timing.duration_us=1200000", "degradation.kind=none")


class Counts(Grey):
    """Counts its frames."""

    frames = 0

    def render(self, request):
        self.frames += 1
        return super().render(request)


class SeesAfterAll(ConstantVelocity):
    """Has a camera, which its class does not declare."""

    def reset(self, seed, route):
        self.sensors = (SensorSpec("front"),)

    def __init__(self, scenario):
        self.sensors = (SensorSpec("front"),)


def plan_of(policy="constant-velocity", renderers=(GREY, DARKER), more=(), **options):
    refs = [ref for name in ("smoke/straight", "smoke/curve") for ref in expand(name, SHORT + more)]
    return make_plan(refs, renderers, (policy,), (0,), RunOptions(**options))  # type: ignore[arg-type]


def drive(plan, root, workers=1):
    announced = Announced()
    run = execute_run(plan, root, workers, ["simrun"], announced, report=False)
    return run.summary, announced


def origins(root):
    """Return the renderer and scene of each rollout with the rollout that it was copied from."""
    manifests = [read_manifest(path.parent) for path in sorted(root.rglob("manifest.json"))]
    return {f"{m.renderer[-6:]} {m.scene}": m.copied_from for m in manifests}


def test_a_copy_is_the_rollout_that_driving_would_have_made(tmp_path):
    plan = plan_of()
    summary, _ = drive(plan, tmp_path / "run")
    assert summary.copies == 2
    paired = summary.paired[DARKER]
    assert {one.diff for one in paired.values()} <= {0.0, None}
    for cell in plan.cells[1::2]:
        copied = read_manifest(tmp_path / "run" / cell.folder)
        driven = run_cell(cell, plan.options, tmp_path / "alone", 1)
        original = next(
            one for one in plan.cells if (one.scene, one.seed) == (cell.scene, cell.seed)
        )
        assert copied.copied_from == original.folder.as_posix()
        differing = {
            member.name
            for member in fields(driven)
            if getattr(copied, member.name) != getattr(driven, member.name)
        }
        assert differing <= {"wall_s", "stage_ms", "files", "copied_from"}
        for name in ("rollout.asl", "frames.jsonl", "steps.parquet"):
            one, other = (tmp_path / where / cell.folder / name for where in ("run", "alone"))
            assert one.read_bytes() == other.read_bytes()
        assert read_asl(tmp_path / "run" / cell.folder / "rollout.asl").info["digests"] == {
            "runtime": "",
            "sensorsim": short_digest(cell.renderer.digest),
            "egodriver": short_digest(cell.policy.digest),
            **dict.fromkeys(("physics", "traffic", "controller", "video_model"), "<skip>"),
        }
    rows = pq.read_table(tmp_path / "run" / "rollouts.parquet").to_pylist()
    assert [row["copied_from"] is not None for row in rows] == [False, True] * 2


@pytest.mark.slow
def test_copies_are_reused_and_a_lost_or_outdated_one_is_made_again(tmp_path):
    plan = plan_of()
    drive(plan, tmp_path)
    made = origins(tmp_path)
    assert {reused for _, reused in drive(plan, tmp_path)[1].results} == {True}
    shutil.rmtree(tmp_path / plan.cells[1].folder)
    assert sorted(reused for _, reused in drive(plan, tmp_path)[1].results) == [False, *[True] * 3]
    with (tmp_path / plan.cells[0].folder / "rollout.asl").open("ab") as log:
        log.write(b"damage")
    assert (
        sorted(reused for _, reused in drive(plan, tmp_path)[1].results) == [False] * 2 + [True] * 2
    )
    assert origins(tmp_path) == made
    assert inspect_run(tmp_path, full=True).damage == ()


@pytest.mark.slow
def test_films_show_each_renderer_and_only_those_of_failures_are_made(tmp_path):
    plan = plan_of(more=("cameras={rig: surround-6, width: 64}",), video="all")
    drive(plan, tmp_path / "all")
    for cell, level in zip(plan.cells, (Grey.level, Darker.level) * 2, strict=True):
        film = read_mp4(tmp_path / "all" / cell.folder / "front.mp4")
        assert film.fps == 10
        assert film.frames.shape == (13, 36, 6 * 64, 3)  # both ends of 1.2 s
        assert_allclose(film.frames, level, atol=2)
    drive(plan_of(), tmp_path / "failures")
    assert not list((tmp_path / "failures").rglob("front.mp4"))


def test_a_flip_shows_all_cameras(watched):
    log = watched.log("clean")
    one, other = (decode_image(image.data) for image in log.images[:2])
    shown = shown_at(log, log.images[0].end_us)
    assert_array_equal(shown, np.hstack([one, other]))


def test_a_film_has_the_times_of_its_frames_and_holds_those_of_a_slower_camera(tmp_path):
    film = Film()
    for t_us in (0, 200_000, 400_000):
        film.add(Frame(t_us, "front", np.full((16, 16, 3), 200, dtype=np.uint8)))
    for t_us in (0, 400_000):
        film.add(Frame(t_us, "left", np.full((8, 16, 3), 50 + t_us // 4000, dtype=np.uint8)))
    film.save(tmp_path)
    shown = read_mp4(tmp_path / "front.mp4")
    assert shown.t_us.tolist() == [0, 200_000, 400_000]
    assert_allclose(shown.frames[:, 4, 24], [[50] * 3, [50] * 3, [150] * 3], atol=3)


def test_cameras_of_a_film_stand_in_the_order_of_their_first_frames_whatever_their_periods(
    tmp_path,
):
    film = Film()
    for t_us, names in ((0, ("front", "left")), (200_000, ("left",)), (400_000, ("left", "front"))):
        for name in names:
            level = {"front": 200, "left": 50}[name]
            film.add(Frame(t_us, name, np.full((16, 16, 3), level, dtype=np.uint8)))
    film.add(Frame(600_000, "left", np.full((16, 16, 3), 50, dtype=np.uint8)))
    film.save(tmp_path)
    shown = read_mp4(tmp_path / "front.mp4")
    assert_allclose(shown.frames[:, 8, 8], [[200] * 3] * 4, atol=3)
    assert_allclose(shown.frames[:, 8, 24], [[50] * 3] * 4, atol=3)


def test_a_rollout_that_failed_is_not_copied(tmp_path):
    plan = plan_of("tests.runs.broken_policies:Raises")
    summary, _ = drive(plan, tmp_path)
    assert (summary.copies, summary.failures.n_failed) == (0, 4)


def test_the_first_renderer_drives_and_another_one_alone_drives_itself(tmp_path):
    drive(plan_of(renderers=(DARKER,)), tmp_path)
    assert set(origins(tmp_path).values()) == {None}


def test_a_fork_shows_the_past_only_to_a_renderer_with_a_history():
    early, late = (SimpleNamespace(t_us=t_us, camera=SMALL) for t_us in (0, 200_000))
    for has_history in (True, False):
        first, then = (complete(make(), Renderer) for make in (Counts, Counts))
        then.has_history = has_history
        switched = SwitchedRenderer(first, then, 100_000)
        switched.render_batch([early])
        assert (first.frames, then.frames) == (1, has_history)
        switched.render_batch([late])
        assert (first.frames, then.frames) == (1, has_history + 1)


def test_clean_has_no_history(straight_road):
    requests = [recorded_requests(straight_road, straight_road.start_us + t) for t in (0, 500_000)]
    (alone,) = make_renderer("clean", straight_road).render_batch(requests[1][:1])
    renderer = make_renderer("clean", straight_road)
    renderer.render_batch(requests[0][:1])
    assert not renderer.has_history
    assert_array_equal(renderer.render_batch(requests[1][:1])[0].rgb, alone.rgb)
