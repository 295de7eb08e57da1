from __future__ import annotations

from types import SimpleNamespace

import pytest

from alpasim_plugin.alpasim.client.preflight import DriveTimes
from alpasim_plugin.cli import check
from alpasim_plugin.cli.check import over_scenes, rehearse
from alpasim_plugin.core.errors import InfrastructureError
from scenarios.load import load_scenario


@pytest.mark.parametrize(("times_lost", "outcomes"), [(1, ()), (2, None)])
def test_a_scene_in_which_the_driver_is_lost_is_driven_once_more(times_lost, outcomes, monkeypatch):
    losses = iter([InfrastructureError("a driver: UNAVAILABLE", "start it")] * times_lost)
    waited = []

    def drive(*_: object):
        error = next(losses, None)
        if error is not None:
            raise error
        return SimpleNamespace(log=lambda: None)

    monkeypatch.setattr(check, "run_rollout", drive)
    monkeypatch.setattr(check, "make_renderer", lambda *_: None)
    monkeypatch.setattr(check, "score", lambda *_, **__: None)
    monkeypatch.setattr(check, "reduce_rollout", lambda *_: SimpleNamespace(as_dict=dict))
    service = SimpleNamespace(
        stub=SimpleNamespace(drive=None), target="elsewhere:1", wait_ready=lambda: waited.append(1)
    )
    policy = SimpleNamespace(service=service, forget_session=lambda: None)
    found = rehearse(load_scenario("smoke/curve"), policy, DriveTimes())  # type: ignore[arg-type]
    assert (found.outcomes, found.lost, len(waited)) == (outcomes, times_lost, times_lost)
    (line,) = over_scenes([found])
    assert (line.result, line.text[:18]) == ("failed", f"{times_lost} lost connections"[:18])
