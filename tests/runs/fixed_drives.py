"""Drives behind a fixer, and comparisons of their pictures."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from alpasim_plugin import run_rollout
from alpasim_plugin.core.interfaces import Renderer
from alpasim_plugin.core.types import Frame, RenderRequest, SensorSpec
from alpasim_plugin.fixers.loop import fixed_renderer
from alpasim_plugin.fixers.settings import FixerSettings
from alpasim_plugin.renderers import make_renderer
from alpasim_plugin.runs.recorder import Recorder
from policies.simple import LogReplay
from tests.fixers.block_fixers import Blend


class Watching(LogReplay):
    """Drives the log exactly and keeps every frame it is shown."""

    sensors: Sequence[SensorSpec] = (SensorSpec("front"),)

    def reset(self, seed, route):
        self.seen = []
        self.asked = []

    def act(self, observation):
        self.asked.append(observation.t_us)
        self.seen += observation.frames.values()
        return super().act(observation)


class Zigzag(Watching):
    """Plans hard left and hard right by turns, so that no forecast holds for long."""

    controller = "bicycle"

    def act(self, observation):
        plan = super().act(observation)
        side = 1.0 if (observation.t_us // 100_000) % 2 else -1.0
        along = np.linspace(0.0, 1.0, len(plan.xy))
        return replace(plan, xy=plan.xy + np.stack([0 * along, 40 * side * along**2], axis=1))


@dataclass
class Drive:
    """A rollout behind a fixer, with everything that went through it."""

    recorder: Recorder
    session: Renderer
    fixers: list[Blend]
    policy: Watching
    requests: list[RenderRequest]
    frames: list[Frame]  # what came out, in the order of the requests
    calls: list[list[RenderRequest]]


def drive(
    scenario,
    policy=Watching,
    fixer=Blend,
    **settings,
):
    fixers = []

    def make():
        fixers.append(fixer())
        return fixers[-1]

    session = session_of(scenario, make, **settings)
    calls = []
    frames = []
    inner = session.render_batch

    def watched(requests):
        calls.append(list(requests))
        out = inner(requests)
        frames.extend(out)
        return out

    session.render_batch = watched  # type: ignore[method-assign]
    driver = policy(scenario)
    done = run_rollout(scenario, session, driver, 0)
    return Drive(done, session, fixers, driver, [r for call in calls for r in call], frames, calls)


def session_of(scenario, make, **settings):
    base = make_renderer("clean", scenario, 0, threads=1)
    return fixed_renderer(
        base.render_batch, make, FixerSettings(name="test", **settings), scenario, 1
    )  # type: ignore[arg-type]


def rendered(scenario, requests):
    base = make_renderer("clean", scenario, 0, threads=1)
    return [base.render(request) for request in requests]


def assert_same_pictures(one, other):
    assert [(f.t_us, f.camera) for f in one] == [(f.t_us, f.camera) for f in other]
    assert all(np.array_equal(a.rgb, b.rgb) for a, b in zip(one, other, strict=True))
