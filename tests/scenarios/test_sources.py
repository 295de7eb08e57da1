"""Recordings through the one door: recognised by what they are, the same type as everything
else.
"""

import numpy as np
import pytest

from alpasim_plugin.core.geometry import interpolate
from alpasim_plugin.core.recorded_state import ego_state_from_log
from alpasim_plugin.world.actors import make_actors
from scenarios.load import load_scenario
from scenarios.sources import detect

FOLDERS = {
    "argoverse": "av2/7fab2350",
    "commonroad": "commonroad/USA_Lanker-1_1_T-1.xml",
}


def drive_with_the_log(s):
    """Run the actors beside an ego on its log and return how far each reactive one strayed from its
    track.
    """
    actors = make_actors(s)
    strayed = {}
    tracks = {a.actor_id: a.track for a in s.actors if a.behaviour.kind == "idm"}
    for t in range(s.start_us, s.end_us, 100_000):
        for name, pose in actors.step(t, ego_state_from_log(s.ego_log, t, s.vehicle)).items():
            assert np.isfinite(pose).all()
            if name in tracks and tracks[name].t_us[0] <= t <= tracks[name].t_us[-1]:
                strayed[name] = float(
                    np.linalg.norm(pose[:2, 3] - interpolate(tracks[name], t)[:2, 3])
                )
    return strayed


@pytest.mark.parametrize("kind", FOLDERS)
def test_a_recording_is_recognised_and_loaded_as_it_is(shared_data, kind):
    path = shared_data / FOLDERS[kind]
    assert detect(path) == kind
    s = load_scenario(path)
    assert s.source == kind
    assert s.start_us == s.ego_log.t_us[0] + 500_000
    assert s.end_us == s.ego_log.t_us[-1]
    assert s.notes
    assert len(s.route.xyz) > 1


@pytest.mark.parametrize("kind", [pytest.param("argoverse", marks=pytest.mark.slow), "commonroad"])
def test_a_file_can_let_recorded_traffic_react_or_vanish(shared_data, tmp_path, kind):
    path = tmp_path / "scene.yaml"
    source = shared_data / FOLDERS[kind]
    path.write_text(
        f"version: 1\nscene_id: mine\nlog: {{{kind}: {source}, actors: idm}}\nenvironment: {{sky: dusk}}\n"
    )
    s = load_scenario(path)
    assert (s.scene_id, s.source, s.environment.sky) == ("mine", kind, "dusk")
    reactive = {a.actor_id for a in s.actors if a.behaviour.kind == "idm"}
    assert reactive
    assert not any(
        a.is_static or a.label == "pedestrian" for a in s.actors if a.actor_id in reactive
    )
    strayed = drive_with_the_log(s)
    assert strayed
    assert max(strayed.values()) > 0.1, "they drive on their own"
    assert load_scenario(path, overrides=["log.actors=none"]).actors == ()


def test_other_recorded_car_as_ego(shared_data, tmp_path):
    path = tmp_path / "scene.yaml"
    xml = shared_data / "commonroad" / "USA_US101-3_3_T-1.xml"
    path.write_text(f"version: 1\nlog: {{commonroad: {xml}, ego: 408}}\n")
    one = load_scenario(path)
    two = load_scenario(xml)
    assert "408" not in {a.actor_id for a in one.actors}
    assert "408" in {a.actor_id for a in two.actors}
    assert one.content_hash != two.content_hash


def test_cameras_of_a_file_are_those_of_the_scene(shared_data, tmp_path):
    path = tmp_path / "scene.yaml"
    log = shared_data / FOLDERS["commonroad"]
    path.write_text(
        f"version: 1\nlog: {{commonroad: {log}}}\ncameras: [{{name: wide, width: 320, hfov_deg: 100}}]\n"
    )
    camera = load_scenario(path).cameras[0]
    assert (camera.name, camera.width) == ("wide", 320)
    assert camera.K[0, 0] == pytest.approx(160 / np.tan(np.deg2rad(50)))
