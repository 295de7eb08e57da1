from __future__ import annotations

import json
from types import SimpleNamespace

import pytest

from alpasim_plugin.alpasim.client.preflight import DriveTimes
from alpasim_plugin.cli import check_policy
from alpasim_plugin.cli.check_policy import KNOWN, Drive, ability_over, over_scenes, rehearse
from alpasim_plugin.core.errors import InfrastructureError
from scenarios.load import load_scenario

PASSED: dict[str, dict[str, bool]] = json.loads(KNOWN.read_text())["passed"]


def drives_of(driver: str) -> list[Drive]:
    return [
        Drive(scene, 1, () if ends[driver] else ("offroad",))
        for scene, ends in PASSED.items()
        if driver in ends
    ]


def test_a_driver_that_sees_is_abler_than_one_that_follows_the_route_and_that_than_one_that_goes_straight_on() -> (
    None
):
    found = [
        ability_over(drives_of(name)) for name in ("constant-velocity", "pure-pursuit", "learned")
    ]
    estimates = [one["estimate"] for one in found]
    assert estimates == sorted(estimates)
    for one in found:
        low, high = one["ci95"]
        assert low < one["estimate"] < high
        assert one["expected_share_ci95"][0] < one["expected_share"] < one["expected_share_ci95"][1]
        assert f"{one['estimate']:+.2f} logits" in one["text"]


def test_passes_everywhere_give_one_bound_and_no_score() -> None:
    found = ability_over([Drive(scene, 1, ()) for scene in list(PASSED)[:6]])
    assert found["estimate"] is None
    assert found["ci95"][0] is not None
    assert found["ci95"][1] is None
    assert found["text"].startswith(
        "no score, it passes all 6 scenes: there is one bound, and no score; above "
    )


def test_scenes_that_no_known_driver_drove_give_no_score() -> None:
    assert (
        ability_over([Drive("nowhere", 1, ())])["text"]
        == "no score: no known driver drove these scenes"
    )
    found = ability_over(drives_of("learned"), "behind 3dgs")
    assert found["estimate"] is None
    assert found["text"] == "no score: no known driver drove these scenes behind 3dgs"
    mixed = ability_over([*drives_of("learned"), Drive("nowhere", 1, ()), Drive("lost", 1)])
    assert "; 2 scenes without a known difficulty or an outcome" in mixed["text"]


def test_known_scenes_are_shipped_ones() -> None:
    assert {load_scenario(name).scene_id for name in ("smoke/curve", "hard/cut_in")} <= set(PASSED)


@pytest.mark.parametrize(("times_lost", "outcomes"), [(1, ()), (2, None)])
def test_a_scene_in_which_the_driver_is_lost_is_driven_once_more(
    times_lost: int, outcomes: tuple[str, ...] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    losses = iter([InfrastructureError("a driver: UNAVAILABLE", "start it")] * times_lost)
    waited = []

    def drive(*_: object) -> SimpleNamespace:
        error = next(losses, None)
        if error is not None:
            raise error
        return SimpleNamespace(log=lambda: None)

    monkeypatch.setattr(check_policy, "run_rollout", drive)
    monkeypatch.setattr(check_policy, "make_renderer", lambda *_: None)
    monkeypatch.setattr(check_policy, "score", lambda *_, **__: None)
    monkeypatch.setattr(check_policy, "reduce_rollout", lambda *_: SimpleNamespace(as_dict=dict))
    service = SimpleNamespace(
        stub=SimpleNamespace(drive=None), target="elsewhere:1", wait_ready=lambda: waited.append(1)
    )
    policy = SimpleNamespace(service=service, forget_session=lambda: None)
    found = rehearse(load_scenario("smoke/curve"), policy, "clean", DriveTimes())  # type: ignore[arg-type]
    assert (found.outcomes, found.lost, len(waited)) == (outcomes, times_lost, times_lost)
    assert found.resident_mib is None
    (line,) = over_scenes([found])
    assert (line.result, line.text[:18]) == ("failed", f"{times_lost} lost connections"[:18])
