"""A drive that is built in sections: the same from wherever a camera came, and without seams."""

from functools import partial

import numpy as np
import pytest
from scipy.spatial import KDTree

from alpasim_plugin.core.geometry import se3
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.streets import builder, site
from alpasim_plugin.streets.builder import build_scene
from alpasim_plugin.world.ground import height_at
from tests.gaussians.scene_maps import camera_spec, curve

pytestmark = pytest.mark.slow


def built(scenario):
    return build_scene(scenario, partial(height_at, scenario.ground))


def view(scenario, index):
    T = se3(scenario.ego_log.xyz[index], scenario.ego_log.quat[index])
    spec = camera_spec(64, 36)
    return PinholeCamera.from_pose(64, 36, spec.K, T @ spec.T_rig_camera)


def content(graph):
    clouds = [level.cloud for node in graph.background for level in node.levels]
    return b"".join(cloud.means.tobytes() + cloud.sh.tobytes() for cloud in clouds)


@pytest.fixture
def in_sections(monkeypatch):
    """Give a street on a slope that is built in sections of 40 m, of which a view needs two."""
    monkeypatch.setattr(builder, "BUILT_WHOLE_M", 50.0)
    monkeypatch.setattr(builder, "SIGHT_M", 15.0)
    monkeypatch.setattr(site, "SECTION_M", 40)
    return curve()


def test_a_section_is_the_same_wherever_the_camera_was_before(in_sections):
    first = view(in_sections, 0)
    last = view(in_sections, -1)
    there_and_back = built(in_sections)
    fresh = built(in_sections)
    there_and_back.render(first, {}, 1)
    names = {node.name for node in there_and_back.background}
    there_and_back.render(last, {}, 1)
    held = {node.name for node in there_and_back.background}
    there_and_back.render(first, {}, 1)
    fresh.render(first, {}, 1)
    assert content(there_and_back) == content(fresh)
    assert names - held
    assert {node.name for node in there_and_back.background} == names


def test_sections_join_without_a_hole_or_a_second_layer(in_sections, monkeypatch):
    monkeypatch.setattr(builder, "SIGHT_M", 400.0)
    joined = built(in_sections)
    joined.render(view(in_sections, 0), {}, 1)
    whole = builder.build_surroundings(in_sections, partial(height_at, in_sections.ground))
    ground = [
        np.concatenate(
            [n.levels[0].cloud.means for n in nodes if n.name.rpartition("/")[0].endswith("ground")]
        )
        for nodes in (joined.background, whole)
    ]
    road_m = np.linalg.norm(ground[1][:, None, :2] - in_sections.ego_log.xyz[None, ::4, :2], axis=2)
    near = ground[1][road_m.min(axis=1) < 6.0]
    distance_m, _ = KDTree(ground[0]).query(near)
    assert distance_m.max() < 0.6
    pairs = KDTree(ground[0]).query_pairs(0.05)
    assert len(pairs) <= len(KDTree(ground[1]).query_pairs(0.05))
