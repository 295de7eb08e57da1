"""A server gives its fixer the recorded frames of a scene, and equal requests the same ones
whatever was asked before.
"""

import numpy as np
import pytest

from alpasim_plugin.alpasim.server.caches import SceneCache, resolve_served
from alpasim_plugin.runs.cameras import recorded_requests

SCENE = """
version: 1
scene_id: served
road: {segments: [{kind: straight, length_m: 120}]}
ego: {speed_mps: 10}
timing: {duration_us: 2_000_000}
cameras: [{width: 64, height: 48}]
environment: {buildings: 0.0, trees_per_100m: 0.0, poles_spacing_m: 0}
degradation: {share: 0.02}
"""


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("served") / "served.yaml"
    path.write_text(SCENE)
    return path


def served(file, renderer):
    return SceneCache([file], resolve_served(renderer), False).get("served")


def request(entry, t_us):
    return recorded_requests(entry.scenario, entry.scenario.start_us + t_us)[0]


@pytest.mark.slow
def test_a_view_has_the_same_references_whatever_was_asked_before(file):
    entry = served(file, "onefixer")
    alone = entry.render([request(entry, 820_000)])[0].references
    entry.render([request(entry, 1_500_000)])
    again = entry.render([request(entry, 820_000)])[0].references
    assert len(alone) == 2
    assert all(np.array_equal(a, b) for a, b in zip(alone, again, strict=True))
    assert (alone[0][..., 3] > 0).mean() > 0.5
