"""The renderer service with our own renderer: what the request says is what is drawn."""

from dataclasses import replace

import grpc
import numpy as np
import pytest

from alpasim_plugin.alpasim.server.assembly import Settings, assemble
from alpasim_plugin.alpasim.server.views import read_view
from alpasim_plugin.core.types import RenderRequest
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.files.ply import write_ply
from alpasim_plugin.log.images import decode_image
from alpasim_plugin.log.wire import FRONT_WIDE, common_pb2, sensorsim_pb2
from alpasim_plugin.log.wire.services import Stub
from alpasim_plugin.renderers.gaussian import CleanRenderer
from scenarios.load import load_scenario
from tests.alpasim.local_service import SCENE, H, W, ask
from tests.alpasim.service_cases import answers, channel_to, hosted

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def served():
    made = assemble(Settings(renderer="clean", scenes=[SCENE]))
    with hosted({"SensorsimService": made.service}) as host, channel_to(host) as channel:
        yield Stub(channel, "SensorsimService"), made


def test_a_frame_equals_the_renderers_own_at_the_pose_of_the_wire(
    served,
):
    asked = ask()
    scenario = load_scenario(SCENE)
    view = read_view(asked)
    camera = replace(
        scenario.cameras[0],
        name="front",
        width=W,
        height=H,
        K=np.array([[40.0, 0, 32], [0, 40, 18], [0, 0, 1]]),
    )
    boxes = {track: pair[1] for track, pair in view.objects.items()}
    direct = CleanRenderer(scenario, 0, "cpu", 1).render(
        RenderRequest(view.t_us, camera, view.T_world_camera, boxes)
    )
    (data,) = answers(served[0], [asked])
    np.testing.assert_array_equal(decode_image(data), direct.rgb)


def test_a_moved_object_and_another_lens_are_seen(served):
    asked = ask()
    (before,) = answers(served[0], [asked])
    for o in asked.dynamic_objects:
        o.pose_pair.end_pose.vec.z -= 100.0  # as the runtime hides an actor
    (hidden,) = answers(served[0], [asked])
    assert hidden != before
    lens = sensorsim_pb2.FthetaCameraParam(
        principal_point_x=32, principal_point_y=18, angle_to_pixeldist_poly=[0.0, 40.0, 0.0, 0.0]
    )
    lens.reference_poly = sensorsim_pb2.FthetaCameraParam.ANGLE_TO_PIXELDIST
    round_lens = sensorsim_pb2.CameraSpec(
        ftheta_param=lens, logical_id="front", resolution_w=W, resolution_h=H
    )
    (bent,) = answers(served[0], [ask(spec=round_lens)])
    centre = np.s_[
        14:22, 26:38
    ]  # within 0.15 rad of the axis the lenses agree to a quarter of a pixel
    a, b = (decode_image(x)[centre].astype(int) for x in (before, bent))
    assert np.abs(a - b).mean() < 6
    assert before != bent


def test_an_own_splat_is_served_with_the_road_users_of_the_request(tmp_path):
    """A PLY file replaces what the scenario builds; a car of the request is drawn in it as
    Gaussians, where the request puts it.
    """
    ground = np.stack(
        np.meshgrid(np.linspace(-20, 120, 120), np.linspace(-20, 20, 40), [-0.05]), axis=-1
    ).reshape(-1, 3)
    n = len(ground)
    cloud = GaussianCloud(
        ground,
        np.tile([1.0, 0, 0, 0], (n, 1)),
        np.full((n, 3), 0.7),
        np.full(n, 0.99),
        np.full((n, 1, 3), -1.0),
    )
    write_ply(tmp_path / "own.ply", cloud)
    overrides = [f"background.file={tmp_path / 'own.ply'}"]
    made = assemble(Settings(renderer="clean", scenes=[SCENE], overrides=overrides))
    shown = []
    with hosted({"SensorsimService": made.service}) as host, channel_to(host) as channel:
        stub = Stub(channel, "SensorsimService")
        (ident,) = stub.get_available_scenes(common_pb2.Empty()).scene_ids
        for aside_m, up_m in ((0.0, -100.0), (0.0, 0.0), (2.0, 0.0)):
            asked = ask()
            asked.scene_id = ident
            for o in asked.dynamic_objects:
                o.pose_pair.end_pose.vec.y += aside_m
                o.pose_pair.end_pose.vec.z += up_m
            shown.append(decode_image(answers(stub, [asked])[0]).astype(int))
    hidden, ahead, left = shown
    places = [
        np.argwhere(np.abs(one - hidden).max(axis=2) > 24)[:, 1].mean() for one in (ahead, left)
    ]
    assert abs(places[0] - W / 2) < 3
    assert places[1] < places[0] - 2


def test_questions_about_scenes_are_answered(served):
    stub, made = served
    (scene_id,) = stub.get_available_scenes(common_pb2.Empty()).scene_ids
    cameras = stub.get_available_cameras(
        sensorsim_pb2.AvailableCamerasRequest(scene_id=scene_id)
    ).available_cameras
    assert [camera.logical_id for camera in cameras] == ["front", FRONT_WIDE]
    assert cameras[0].rig_to_camera == cameras[1].rig_to_camera
    assert cameras[1].intrinsics.logical_id == FRONT_WIDE
    assert (
        stub.prefetch_scene(sensorsim_pb2.ScenePrefetchRequest(scene_id=scene_id))
        == common_pb2.Empty()
    )
    assert [s.scene_id for s in stub.get_loaded_scenes(common_pb2.Empty()).scenes] == [scene_id]
    asked = sensorsim_pb2.AvailableTrajectoriesRequest(scene_id=scene_id)
    path = stub.get_available_trajectories(asked).available_trajectories[0].trajectory
    assert len(path.poses) == len(load_scenario(SCENE).ego_log)
    assert not stub.get_available_ego_masks(common_pb2.Empty()).ego_mask_metadata
    assert "clean" in stub.get_version(common_pb2.Empty()).version_id
    assert made.fixers is None


@pytest.mark.parametrize(
    ("call", "code", "found"),
    [
        (
            lambda stub: stub.render_rgb(changed(scene_id="other")),
            "NOT_FOUND",
            "none of the 1 known",
        ),
        (
            lambda stub: stub.prefetch_scene(sensorsim_pb2.ScenePrefetchRequest(scene_id="other")),
            "NOT_FOUND",
            "none of the 1 known",
        ),
        (
            lambda stub: stub.render_rgb(changed(track="ghost")),
            "INVALID_ARGUMENT",
            "'ghost', not in the scene",
        ),
        (
            lambda stub: stub.render_lidar(
                sensorsim_pb2.LidarRenderRequest(lidar_config={"lidar_type": 7})
            ),
            "UNIMPLEMENTED",
            "lidar of type 7",
        ),
    ],
)
def test_what_is_not_here_is_refused_with_a_reason(served, call, code, found):
    with pytest.raises(grpc.RpcError) as caught:
        call(served[0])
    assert caught.value.code().name == code
    assert found in caught.value.details()


def changed(scene_id=None, track=None):
    asked = ask()
    if scene_id is not None:
        asked.scene_id = scene_id
    if track is not None:
        asked.dynamic_objects.add(track_id=track, pose_pair=asked.sensor_pose)
    return asked
