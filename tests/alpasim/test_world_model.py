"""The video-model service: 5 frames, then 8 and 8, one for each pose, and the same frames for the
same session.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from typing import Any

import grpc
import numpy as np
import pytest

from alpasim_plugin.alpasim.server.assembly import Assembled, Settings, assemble
from alpasim_plugin.alpasim.server.world_model import clip_of
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import interpolate
from alpasim_plugin.log.images import decode_image, encode_image
from alpasim_plugin.log.schema import wire_box, wire_pose
from alpasim_plugin.log.wire import common_pb2, sensorsim_pb2, video_model_pb2
from alpasim_plugin.log.wire.services import Stub
from scenarios.load import load_scenario
from tests.alpasim.service_cases import channel_to, hosted

SCENE, CAMERA = "smoke/lead_car", "camera_front_wide_120fov"
INTERVAL_US = 33_333
W, H = 48, 32


@pytest.fixture(scope="module")
def served(bundle: Any) -> Iterator[tuple[Any, Assembled]]:
    overrides = [f"weights.bundle={bundle}", "precision=fp32", "holes=noise", "keep_render=false"]
    made = assemble(
        Settings(renderer="onefixer+clean", overrides=overrides, scenes=[SCENE], threads=1)
    )
    with hosted(made.services) as host, channel_to(host) as channel:
        yield Stub(channel, "WorldModelService"), made


def zipped(*names: str) -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        for name in names:
            archive.writestr(name, b"PAR1")
    return data.getvalue()


def session(
    seed: int = 0, hdmap: bool = False, clip: str = "", **debug: bool
) -> video_model_pb2.SessionRequest:
    lens = sensorsim_pb2.FthetaCameraParam(
        principal_point_x=W / 2, principal_point_y=H / 2, angle_to_pixeldist_poly=[0.0, 30.0]
    )
    lens.reference_poly = sensorsim_pb2.FthetaCameraParam.ANGLE_TO_PIXELDIST
    spec = sensorsim_pb2.CameraSpec(
        ftheta_param=lens, logical_id=CAMERA, resolution_w=W, resolution_h=H
    )
    # Sensor axes: a camera that looks ahead is not turned.
    mount = common_pb2.Pose(vec=common_pb2.Vec3(x=1.7, z=1.5), quat=common_pb2.Quat(w=1.0))
    first = video_model_pb2.Image(
        data=encode_image(np.zeros((H, W, 3), np.uint8), "jpeg"), format=video_model_pb2.JPEG
    )
    clip = clip or load_scenario(SCENE).scene_id
    return video_model_pb2.SessionRequest(
        static_world_map=video_model_pb2.StaticWorldMap(
            hdmap_parquets=zipped(f"{clip}.lane.parquet", f"{clip}.clip.parquet")
        ),
        camera_specs=[spec],
        rig_to_camera=[mount],
        initial_frames=[first],
        random_seed=seed,
        debug_options=video_model_pb2.DebugOptions(return_hdmap_frames=hdmap, **debug),
    )


def chunk(
    session_id: video_model_pb2.SessionId, first: int, frames: int
) -> video_model_pb2.VideoChunkRequest:
    """Return the request for frames ``first``... of the recorded drive, with its road users."""
    scenario = load_scenario(SCENE)
    times = [scenario.start_us + (first + i) * INTERVAL_US for i in range(frames)]
    rig = common_pb2.Trajectory(
        poses=[
            common_pb2.PoseAtTime(
                pose=wire_pose(interpolate(scenario.ego_log, t), "a test"), timestamp_us=t
            )
            for t in times
        ]
    )
    actors = []
    for actor in scenario.actors:
        poses = [
            common_pb2.PoseAtTime(
                pose=wire_pose(interpolate(actor.track, t), "a test"), timestamp_us=t
            )
            for t in times
        ]
        track = common_pb2.Trajectory(poses=poses)
        actors.append(
            video_model_pb2.DynamicActor(
                class_id=video_model_pb2.CAR, bbox_dims=wire_box(actor.box), trajectory=track
            )
        )
    state = video_model_pb2.DynamicWorldState(actors=actors)
    return video_model_pb2.VideoChunkRequest(
        session_id=session_id, rig_trajectory=rig, dynamic_state=state
    )


def rollout(stub: Any, lengths: tuple[int, ...] = (5, 8, 8), **options: Any) -> list[bytes]:
    name = stub.start_session(session(**options))
    frames, out = 1, []
    for length in lengths:
        reply = stub.render_video_chunk(chunk(name, frames, length), timeout=120)
        (camera,) = reply.camera_outputs
        assert (camera.camera_logical_id, len(camera.rgb_frames)) == (CAMERA, length)
        assert all(image.format == video_model_pb2.JPEG for image in camera.rgb_frames)
        out += [image.data for image in camera.rgb_frames]
        frames += length
    stub.close_session(video_model_pb2.SessionCloseRequest(session_id=name.session_id))
    return out


@pytest.mark.parametrize(
    ("lengths", "others"),
    [((1, 4), (5,)), pytest.param((5, 8, 8), (9, 12), marks=pytest.mark.slow)],
)
@pytest.mark.slow
def test_chunks_equal_chunks_of_other_lengths_in_another_session(
    served: tuple[Any, Assembled], lengths: tuple[int, ...], others: tuple[int, ...]
) -> None:
    stub, made = served
    frames = rollout(stub, lengths)
    assert rollout(stub, others) == frames
    assert len(set(frames)) == sum(lengths)
    assert decode_image(frames[0]).shape == (H, W, 3)
    assert made.world_model is not None
    assert len(made.world_model.sessions) == 0


@pytest.mark.slow
@pytest.mark.slow
def test_a_repeated_chunk_is_answered_alike_and_interleaved_sessions_stay_apart(
    served: tuple[Any, Assembled],
) -> None:
    stub, _ = served
    a, b = (stub.start_session(session()) for _ in range(2))
    first = [stub.render_video_chunk(chunk(name, 1, 5)) for name in (a, b)]
    assert stub.render_video_chunk(chunk(a, 1, 5)) == first[0] == first[1]
    second = [stub.render_video_chunk(chunk(name, 6, 4)) for name in (a, b)]
    assert second[0] == second[1] != first[0]


@pytest.mark.slow
def test_map_frames_come_on_request_and_alone_if_asked(served: tuple[Any, Assembled]) -> None:
    stub, _ = served
    both = stub.render_video_chunk(
        chunk(stub.start_session(session(hdmap=True)), 1, 5)
    ).camera_outputs[0]
    assert (len(both.rgb_frames), len(both.hdmap_condition_frames)) == (5, 5)
    assert decode_image(both.hdmap_condition_frames[0].data).any()
    alone = stub.render_video_chunk(
        chunk(stub.start_session(session(hdmap=True, skip_video_generation=True)), 1, 5)
    ).camera_outputs[0]
    assert (len(alone.rgb_frames), list(alone.hdmap_condition_frames)) == (
        0,
        list(both.hdmap_condition_frames),
    )


@pytest.mark.slow
def test_the_seed_is_the_noises(served: tuple[Any, Assembled]) -> None:
    _, made = served
    assert made.fixers is not None
    assert made.fixers.of("s", 3).seed == 3  # type: ignore[attr-defined]
    assert made.fixers.of("s", 3) is not made.fixers.of("s", 4)


@pytest.mark.parametrize(
    ("make", "code", "found"),
    [
        (
            lambda stub: chunk(stub.start_session(session()), 1, 8),
            "INVALID_ARGUMENT",
            "1 \\+ 4 k in the first chunk",
        ),
        (
            lambda stub: chunk(video_model_pb2.SessionId(session_id="gone"), 1, 5),
            "NOT_FOUND",
            "unknown, closed or expired",
        ),
        (
            lambda stub: resized(chunk(stub.start_session(session()), 1, 5)),
            "INVALID_ARGUMENT",
            "road user 0",
        ),
        (
            lambda stub: chunk(stub.start_session(session(clip="other")), 1, 5),
            "NOT_FOUND",
            "none of the 1 known",
        ),
    ],
)
def test_what_cannot_be_rendered_is_refused(
    served: tuple[Any, Assembled], make: Any, code: str, found: str
) -> None:
    stub, _ = served
    with pytest.raises(grpc.RpcError, match=found) as caught:
        stub.render_video_chunk(make(stub))
    assert caught.value.code().name == code


@pytest.mark.slow
def test_times_that_do_not_go_on_are_refused_and_the_session_lives(
    served: tuple[Any, Assembled],
) -> None:
    stub, _ = served
    name = stub.start_session(session())
    stub.render_video_chunk(chunk(name, 1, 5))
    with pytest.raises(grpc.RpcError, match="times that increase"):
        stub.render_video_chunk(chunk(name, 4, 8))
    assert len(stub.render_video_chunk(chunk(name, 6, 4)).camera_outputs[0].rgb_frames) == 4


def resized(request: video_model_pb2.VideoChunkRequest) -> video_model_pb2.VideoChunkRequest:
    request.dynamic_state.actors[0].bbox_dims.size_x += 1.0
    return request


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"PK\x05\x06",
        zipped("lane.parquet"),
        zipped("a.lane.parquet", "b.lane.parquet"),
        zipped("a.txt"),
    ],
)
def test_a_map_that_names_no_clip_is_refused(data: bytes) -> None:
    with pytest.raises(InputError, match="the map of a session"):
        clip_of(data)
