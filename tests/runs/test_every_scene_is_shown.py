"""A rollout of every class of scene shows its street in every frame: a renderer that is asked in
another way than its scene answers shows an empty one.
"""

from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin import make_policy, make_renderer, run_rollout
from alpasim_plugin.core.errors import RendererError
from alpasim_plugin.core.types import BackgroundFile, Degradation
from alpasim_plugin.gaussians import write_ply
from alpasim_plugin.gaussians.scene.scene_graph import SceneGraph
from alpasim_plugin.renderers.gaussian import clear_cache
from alpasim_plugin.renderers.rolling import SplatRenderer
from alpasim_plugin.streets import builder, site
from alpasim_plugin.streets.builder import LongScene, build_scene
from scenarios.load import load_scenario
from tests.gaussians.gaussian_scenes import splats
from tests.renderers.recorded_drive import recorded_drive

LEAST_SHOWN = 0.25  # of a frame's pixels that have depth
LONG_ROAD = """
version: 1
road:
  segments:
    - {kind: straight, length_m: 900}
    - {kind: straight, length_m: 900}
ego: {speed_mps: 30, cruise_mps: 30}
timing: {duration_us: 56_000_000}
environment: {buildings: 0, trees_per_100m: 0}
"""


@pytest.fixture
def rendered(monkeypatch):
    """Return the frames that renderers of Gaussians make, and the scenes that they draw."""
    frames = []
    scenes = []
    plain_batch = SplatRenderer.render_batch
    plain_draw = SceneGraph.render_all

    def render_batch(self, requests):
        made = plain_batch(self, requests)
        frames.extend(made)
        return made

    def render_all(self, *args, **options):
        scenes.append(type(self))
        return plain_draw(self, *args, **options)

    monkeypatch.setattr(SplatRenderer, "render_batch", render_batch)
    monkeypatch.setattr(SceneGraph, "render_all", render_all)
    clear_cache()
    yield frames, scenes
    clear_cache()


@pytest.fixture
def in_sections(monkeypatch):
    """Build whatever is longer than 20 m in sections of 20 m, those within 25 m of a camera."""
    monkeypatch.setattr(builder, "BUILT_WHOLE_M", 20.0)
    monkeypatch.setattr(builder, "SIGHT_M", 25.0)
    monkeypatch.setattr(site, "SECTION_M", 20)


def rollout(scenario, renderer, policy="lane-camera"):
    session = make_renderer(renderer, scenario, threads=1)
    return run_rollout(scenario, session, make_policy(policy, scenario), 0)


def shares(frames):
    return [float((frame.depth > 0).mean()) for frame in frames]


def test_a_built_street_is_shown(straight_road, rendered):
    frames, scenes = rendered
    rollout(straight_road, "clean")
    assert len(frames) == 30
    assert min(shares(frames)) > LEAST_SHOWN
    assert set(scenes) == {SceneGraph}


@pytest.mark.parametrize("renderer", ["clean", "3dgs", "onefixer+clean"])
def test_a_street_in_sections_is_shown(straight_road, rendered, in_sections, renderer):
    frames, scenes = rendered
    start_us = 1_000_000
    rollout(replace(straight_road, start_us=start_us, end_us=start_us + 500_000), renderer)
    assert min(shares(frames)) > LEAST_SHOWN
    assert set(scenes) == {LongScene}


def test_a_street_with_a_file_in_its_background_is_shown(straight_road, rendered, tmp_path):
    frames, _ = rendered
    places = np.column_stack(
        [np.repeat(np.arange(0.0, 40.0), 30), np.tile(np.linspace(-3, 3, 30), 40), np.zeros(1200)]
    )
    write_ply(tmp_path / "street.ply", splats(places, 0.4, 0.99))
    for keep_road in (False, True):
        background = BackgroundFile(str(tmp_path / "street.ply"), np.eye(4), keep_road)
        rollout(replace(straight_road, background=background, content_hash=f"{keep_road}"), "clean")
    assert min(shares(frames)) > LEAST_SHOWN


def test_an_imported_street_is_shown(rendered, tmp_path):
    frames, _ = rendered
    drive = recorded_drive(tmp_path)
    rollout(replace(drive, end_us=drive.start_us + 1_000_000), "3dgs")
    assert min(shares(frames)) > LEAST_SHOWN


@pytest.mark.slow
def test_a_fitted_street_is_shown(straight_road, rendered, tmp_path, monkeypatch):
    monkeypatch.setenv("SIMRUN_CACHE", str(tmp_path))
    frames, _ = rendered
    fitted = replace(straight_road, degradation=Degradation("reconstruction", share=0.05))
    rollout(fitted, "3dgs")
    assert min(shares(frames)) > LEAST_SHOWN


@pytest.mark.slow
def test_a_street_of_almost_two_kilometres_is_shown(rendered, tmp_path):
    frames, scenes = rendered
    file = tmp_path / "long.yaml"
    file.write_text(LONG_ROAD)
    scenario = load_scenario(file)
    rollout(replace(scenario, end_us=scenario.start_us + 500_000), "clean")
    assert frames
    assert min(shares(frames)) > LEAST_SHOWN
    assert set(scenes) == {LongScene}


def test_a_frame_that_lacks_the_street_is_an_error_of_the_renderer(straight_road, monkeypatch):
    """A scene whose background is lost still shows the sky and the car ahead."""
    clear_cache()

    def lost(scenario, height_at):
        whole = build_scene(scenario, height_at)
        return SceneGraph([], list(whole.actors.values()), whole.sky)

    monkeypatch.setattr("alpasim_plugin.renderers.gaussian.build_scene", lost)
    with pytest.raises(RendererError, match="shows a surface at"):
        rollout(straight_road, "clean")
    clear_cache()
