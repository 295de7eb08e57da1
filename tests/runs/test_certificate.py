"""The determinism certificate: what it repeats, what it finds, and what it says where it cannot be
made.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.core.types import Frame, RenderRequest, Route, Scenario, SensorSpec
from alpasim_plugin.log import read_asl
from alpasim_plugin.log.run_folder.manifests import read_manifest
from alpasim_plugin.renderers.gaussian import CleanRenderer
from alpasim_plugin.runs.certificate import Certify, certificate_line, certify
from alpasim_plugin.runs.execute import HowToRun, Threads, execute
from alpasim_plugin.runs.plan import RunOptions, RunPlan, make_plan
from alpasim_plugin.runs.run import execute_run
from policies import ConstantVelocity
from scenarios.suite import expand
from tests.runs.test_runs import Announced

pytestmark = pytest.mark.slow

BARE = ("environment.buildings=0", "environment.trees_per_100m=0", "environment.poles_spacing_m=0")
SHORT, LONGER = "timing.duration_us=800000", "timing.duration_us=1200000"
FORGETFUL = "tests.runs.broken_policies:RemembersEarlierRollouts"


def plan_of(
    renderer: str = "clean",
    policy: str = "lane-camera",
    overrides: tuple[str, ...] = (),
    images: str = "none",
) -> RunPlan:
    refs = [
        *expand("smoke/lead_car", (LONGER, *BARE, *overrides)),
        *expand("smoke/straight", (SHORT, *BARE, *overrides)),
    ]
    return make_plan(refs, (renderer,), (policy,), (0,), RunOptions(images=images))  # type: ignore[arg-type]


def certificate(
    plan: RunPlan, root: Path, before: dict | None = None, wanted: Certify = "one"
) -> dict:
    """Run a plan without its tables and return the certificate."""
    manifests = execute(plan, root, HowToRun(Threads(1, 1)), lambda manifest, reused: None, print)
    return certify(plan, root, manifests, 1, wanted, before)


@pytest.mark.slow
def test_the_shortest_rollout_is_repeated_and_stands_in_both_files(tmp_path: Path) -> None:
    found = execute_run(plan_of(), tmp_path, 1, ["simrun"], Announced(), report=False).summary[
        "determinism"
    ]
    assert found["status"] == "equal"
    assert found["cell"]["scene"] == "smoke-straight"
    assert found["steps"] == 8
    assert set(found["digests"]) == {"ego", "actors", "frames", "plans", "scores"}
    assert found["digests"] == found["repeated"]
    assert len(set(found["digests"].values())) == 5
    for name in ("run.json", "summary.json"):
        assert json.loads((tmp_path / name).read_text())["determinism"] == found
    assert "smoke-straight" in certificate_line(found)


def test_workers_drive_the_repeat_beside_the_other_rollouts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = plan_of()
    one = execute_run(plan, tmp_path / "one", 1, ["simrun"], Announced(), report=False).summary[
        "determinism"
    ]
    monkeypatch.setattr("alpasim_plugin.runs.certificate.run_cell", None)  # in this process
    two = execute_run(plan, tmp_path / "two", 2, ["simrun"], Announced(), report=False).summary[
        "determinism"
    ]
    assert one.pop("wall_s") > 0
    assert two.pop("wall_s") > 0
    assert one == two
    assert not list((tmp_path / "two").glob("*repeat*"))


class Flicker(CleanRenderer):
    """Changes one pixel of the fourth frame of every rollout after the process's first."""

    lives = 0

    def __init__(self, scenario: Scenario, seed: int, device: str, threads: int | None) -> None:
        super().__init__(scenario, seed, device, threads)
        Flicker.lives += 1
        self.due_us = scenario.start_us + 400_000

    def render(self, request: RenderRequest) -> Frame:
        frame = super().render(request)
        if request.t_us == self.due_us:
            frame.rgb[0, 0, 0] = np.uint8(Flicker.lives)
        return frame


def test_one_changed_pixel_is_found_without_images_in_the_log(tmp_path: Path) -> None:
    found = certificate(
        plan_of(f"{__name__}:Flicker", "tests.runs.test_certificate:Blind"), tmp_path
    )
    assert found["status"] == "different"
    first = found["first_difference"]
    assert (first["component"], first["step"]) == ("frames", 4)
    assert [
        name for name in found["digests"] if found["digests"][name] != found["repeated"][name]
    ] == ["frames"]
    assert "DIFFERENT" in certificate_line(found)


@pytest.mark.slow
def test_a_policy_that_remembers_is_named_before_the_motion_that_follows_from_it(
    tmp_path: Path,
) -> None:
    found = certificate(plan_of(policy=FORGETFUL, overrides=("timing.warmup_us=0",)), tmp_path)
    first = found["first_difference"]
    assert (first["component"], first["step"]) == ("plans", 5)
    differing = {
        name for name in found["digests"] if found["digests"][name] != found["repeated"][name]
    }
    assert {"plans", "ego", "scores"} <= differing


@pytest.mark.slow
def test_the_same_command_again_keeps_the_certificate_until_the_log_is_another(
    tmp_path: Path,
) -> None:
    first = certificate(plan_of(images="jpeg"), tmp_path)
    assert (
        certificate(plan_of(images="jpeg"), tmp_path, first) == first
    )  # wall_s included: nothing was repeated
    log = tmp_path / first["path"] / "rollout.asl"
    data = bytearray(log.read_bytes())
    image = read_asl(log).images[-1].data
    at = data.rindex(image) + len(image) - 40  # inside the last camera image, before its end mark
    data[at] ^= 1
    log.write_bytes(bytes(data))
    plan = plan_of(
        images="jpeg"
    )  # a run would drive the damaged rollout again before it is repeated
    manifests = [read_manifest(tmp_path / cell.folder)[0] for cell in plan.cells]
    found = certify(plan, tmp_path, manifests, 1, "one", first)
    assert found["status"] == "different"
    assert found["first_difference"]["component"] == "frames"
    assert found["first_difference"]["step"] == 7


@pytest.mark.slow
def test_resuming_with_more_rollouts_certifies_the_folder_as_it_is_now(tmp_path: Path) -> None:
    longer = make_plan(
        expand("smoke/lead_car", (LONGER, *BARE)),
        ("clean",),
        ("pure-pursuit",),
        (0,),
        RunOptions(images="none"),
    )
    first = certificate(longer, tmp_path)
    assert first["cell"]["scene"] == "smoke-lead_car"
    found = certificate(plan_of(policy="pure-pursuit"), tmp_path, first)
    assert found["cell"]["scene"] == "smoke-straight"
    assert found["status"] == "equal"


def test_what_cannot_be_repeated_is_said(tmp_path: Path) -> None:
    def of_one_scene(policy: str, *overrides: str) -> RunPlan:
        return make_plan(
            expand("smoke/straight", (SHORT, *BARE, *overrides)),
            ("clean",),
            (policy,),
            (0,),
            RunOptions(images="none"),
        )

    off = certificate(of_one_scene("constant-velocity"), tmp_path / "off", wanted="none")
    assert off["reason"] == "switched off with --certify none"
    measured = certificate(
        of_one_scene("constant-velocity", "latency.kind=measured"), tmp_path / "measured"
    )
    assert measured == {
        "status": "skipped",
        "reason": "latency 'measured' depends on the machine: no rollout can be repeated",
    }
    failed = certificate(of_one_scene("tests.runs.broken_policies:Raises"), tmp_path / "failed")
    assert failed == {"status": "skipped", "reason": "no rollout finished"}
    assert certificate_line(failed) == "skipped: no rollout finished"


class AwayAfterItsFirstDrive(ConstantVelocity):
    """Fails as a service does that has gone after the first rollout."""

    drives = 0

    def reset(self, seed: int, route: Route) -> None:
        super().reset(seed, route)
        AwayAfterItsFirstDrive.drives += 1
        if AwayAfterItsFirstDrive.drives > 1:
            raise InfrastructureError("localhost:1: connection refused", "start the driver again")


def test_a_peer_that_is_gone_when_a_rollout_is_repeated_costs_neither_tables_nor_reports(
    tmp_path: Path,
) -> None:
    refs = expand("smoke/straight", (SHORT, *BARE))
    policy = f"{__name__}:AwayAfterItsFirstDrive"
    plan = make_plan(refs, ("clean",), (policy,), (0,), RunOptions(images="none"))
    result = execute_run(plan, tmp_path, 1, ["simrun"], Announced())
    found = result.summary["determinism"]
    assert found["status"] == "skipped"
    assert found["reason"] == "the repeat failed: asking a driver, localhost:1: connection refused"
    assert found["error"]["hint"] == "start the driver again"
    assert result.exit_code == 0  # every rollout has run to its end
    assert found["reason"] in certificate_line(found)
    assert found["reason"] in (tmp_path / "report.html").read_text()
    assert all(
        (tmp_path / name).exists()
        for name in ("summary.json", "junit.xml", "summary.md", "contents.json")
    )
    again = execute_run(plan, tmp_path, 1, ["simrun"], Announced(), report=False).summary[
        "determinism"
    ]
    assert again["status"] == "skipped"  # tried again, since it was not made


class Blind(ConstantVelocity):
    """Takes the camera's frames and drives straight on without looking."""

    sensors = (SensorSpec("front"),)
