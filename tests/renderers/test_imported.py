"""The renderer 3dgs of an imported drive: its own model, sky as an opaque layer without depth, the
recording's exposure and frames.
"""

from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import interpolate
from alpasim_plugin.core.types import RenderRequest
from alpasim_plugin.gaussians.scene.log_views import log_actors
from alpasim_plugin.renderers import make_renderer
from alpasim_plugin.renderers.reconstruction import ImportedRenderer, exposure_near
from alpasim_plugin.renderers.recorded import photograph_camera, photograph_image
from alpasim_plugin.renderers.weather import FOG_SRGB
from tests.renderers.recorded_drive import EXPOSURE, HIGH, SKY_LEVEL, WIDE, recorded_drive


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return recorded_drive(tmp_path_factory.mktemp("drive"))


@pytest.fixture(scope="module")
def frame(drive):
    camera = drive.cameras[0]
    t_us = int(drive.ego_log.t_us[0]) + 400_000
    T = interpolate(drive.ego_log, t_us) @ camera.T_rig_camera
    return make_renderer("3dgs", drive, threads=1).render(
        RenderRequest(t_us, camera, np.stack([T, T]), log_actors(drive, t_us))
    )


def test_3dgs_of_an_imported_drive_is_its_model(drive, frame):
    assert isinstance(make_renderer("3dgs", drive), ImportedRenderer)
    road = frame.rgb[-8:, 20:44].astype(float)
    assert abs(road.mean() - 0.4 * 255 * EXPOSURE) < 6, "in the exposure of the recording"


def test_the_sky_is_opaque_and_has_no_depth(frame):
    up = slice(0, HIGH // 2 - 4)
    assert np.all(frame.alpha[up] == 1)
    assert np.all(frame.depth[up] == 0)
    assert abs(float(frame.rgb[up].mean()) - SKY_LEVEL * EXPOSURE) < 3
    assert frame.depth[-1, WIDE // 2] > 1


def test_fog_hides_the_sky_of_an_imported_drive(drive):
    foggy = replace(drive, environment=replace(drive.environment, fog_visibility_m=50.0))
    camera = drive.cameras[0]
    t_us = int(drive.ego_log.t_us[0]) + 400_000
    T = interpolate(drive.ego_log, t_us) @ camera.T_rig_camera
    request = RenderRequest(t_us, camera, np.stack([T, T]), log_actors(drive, t_us))
    shown = make_renderer("3dgs", foggy, threads=1).render(request)
    assert (shown.rgb[: HIGH // 2 - 4] == FOG_SRGB).all()


def test_a_hole_below_the_horizon_stays_a_hole(drive):
    camera = drive.cameras[0]
    t_us = int(drive.ego_log.t_us[0])
    T = interpolate(drive.ego_log, t_us) @ camera.T_rig_camera
    T[:3, 3] += [0.0, 200.0, 0.0]  # far beside the road, where there is nothing
    shown = make_renderer("3dgs", drive, threads=1).render(
        RenderRequest(t_us, camera, np.stack([T, T]), {})
    )
    assert shown.alpha[-1].max() < 0.5
    assert shown.alpha[0].min() == 1


def test_what_stands_in_the_model_is_not_drawn_once_more(drive):
    renderer = make_renderer("3dgs", drive)
    assert isinstance(renderer, ImportedRenderer)
    assert "obstacle-001" in log_actors(drive, int(drive.ego_log.t_us[0]))
    assert not renderer.graph.actors


def test_a_missing_model_names_the_folder(drive, tmp_path):
    with pytest.raises(InputError):
        make_renderer("3dgs", replace(drive, model=str(tmp_path / "nowhere")))


def test_recorded_frames_are_those_of_the_fit_alone(drive):
    frames = make_renderer("3dgs", drive, threads=1).recorded()
    assert [one.camera for one in frames] == ["front"] * 8
    held = next(one for one in drive.recording if one.use == "held-out")
    assert held.t_us not in {one.t_us for one in frames}
    first = frames[0]
    rgb, depth = first.read()
    assert rgb.shape == (HIGH, WIDE, 3), "at the size at which the camera is rendered"
    assert depth.shape == (HIGH, WIDE)
    assert np.allclose(first.K, drive.cameras[0].K)
    assert depth[0].max() == 0, "the sky has none"
    assert depth[-1].min() > 1
    assert np.allclose(first.T_world_camera, drive.recording[0].T_world_camera)


def test_a_missing_photograph_is_named(drive, tmp_path):
    gone = replace(drive.recording[0], path=str(tmp_path / "gone.png"))
    with pytest.raises(InputError):
        photograph_image(gone, photograph_camera(gone, WIDE))


def test_exposure_follows_the_place_and_the_camera(drive):
    one = drive.recording[0]
    other = drive.recording[8]
    recording = (replace(one, exposure=(1.0, 1.0, 1.0)), replace(other, exposure=(2.0, 1.0, 0.5)))
    assert np.allclose(exposure_near(recording, "front", one.T_world_camera[:3, 3]), 1.0, atol=1e-2)
    assert np.allclose(
        exposure_near(recording, "front", other.T_world_camera[:3, 3]), [2.0, 1.0, 0.5], atol=1e-2
    )
    assert np.allclose(
        exposure_near(recording, "roof", other.T_world_camera[:3, 3]), [2.0, 1.0, 0.5], atol=1e-2
    )
    assert np.allclose(exposure_near((), "front", np.zeros(3)), 1.0)
