"""The renderer service over real sockets, in front of another renderer: same request, same bytes;
every drive as if it were alone.
"""

import grpc
import numpy as np
import pytest

from alpasim_plugin.alpasim.server.sources import trusted_opacity
from alpasim_plugin.core.types import Frame
from alpasim_plugin.fixers import fixer_settings, make_fixer
from alpasim_plugin.log.images import decode_image
from alpasim_plugin.log.wire import common_pb2, sensorsim_pb2
from alpasim_plugin.log.wire.services import Stub
from tests.alpasim.server_histories import SLOWLY_APART
from tests.alpasim.service_cases import (
    CAMERA,
    HEIGHT,
    START_US,
    STEP_US,
    WIDTH,
    answers,
    channel_to,
    drive,
    holes,
    in_front_of,
    picture,
    trust_every_frame,
)

EMPTY = common_pb2.Empty()
JPEG = sensorsim_pb2.JPEG
PNG = sensorsim_pb2.PNG


def batch(requests):
    item = sensorsim_pb2.BatchRGBRenderRequestItem
    return sensorsim_pb2.BatchRGBRenderRequest(
        items=[item(camera_name=r.camera_intrinsics.logical_id, request=r) for r in requests]
    )


def test_identity_hands_images_and_answers_on_bit_by_bit(upstream, renderer):
    frames = [*drive(3), *drive(2, image_format=JPEG)]
    with channel_to(upstream) as channel, in_front_of(upstream, renderer="identity") as (stub, _):
        direct = Stub(channel, "SensorsimService")
        assert answers(stub, frames) == answers(direct, frames)
        assert stub.batch_render_rgb(batch(frames[:1])) == direct.batch_render_rgb(
            batch(frames[:1])
        )
        lidar = sensorsim_pb2.LidarRenderRequest(scene_id="scene")
        assert stub.render_lidar(lidar) == direct.render_lidar(lidar)
        aggregated = sensorsim_pb2.AggregatedRenderRequest(
            rgb_requests=frames[:1], lidar_requests=[]
        )
        assert stub.render_aggregated(aggregated) == direct.render_aggregated(aggregated)
        for call, asked in (
            ("get_available_scenes", EMPTY),
            ("get_available_ego_masks", EMPTY),
            ("get_available_cameras", sensorsim_pb2.AvailableCamerasRequest(scene_id="scene")),
            (
                "get_available_trajectories",
                sensorsim_pb2.AvailableTrajectoriesRequest(scene_id="scene"),
            ),
        ):
            assert getattr(stub, call)(asked) == getattr(direct, call)(asked)
        with pytest.raises(grpc.RpcError, match="UNIMPLEMENTED"):
            stub.get_loaded_scenes(EMPTY)  # the stand-in has none
        assert stub.prefetch_scene(sensorsim_pb2.ScenePrefetchRequest(scene_id="scene")) == EMPTY


@pytest.mark.parametrize("image_format", [PNG, JPEG])
def test_interleaved_drives_get_the_bytes_that_each_gets_alone(
    upstream, overrides, tmp_path, image_format
):
    drives = [
        drive(12, parts_at=5 + i, image_format=image_format, **kind)
        for i, kind in enumerate(SLOWLY_APART)
    ]
    options = {"overrides": overrides, "masks": {CAMERA: holes(tmp_path)}}
    alone = []
    for one in drives:
        with in_front_of(upstream, **options) as (stub, _):
            alone.append(answers(stub, one))
    with in_front_of(upstream, **options) as (stub, made):
        mixed = [answers(stub, frames) for frames in zip(*drives, strict=True)]
        assert [list(column) for column in zip(*mixed, strict=True)] == alone
        assert answers(stub, drives[2]) == alone[2]  # again: a retry, another worker, a step back
        assert (made.tree.counts.starts, made.tree.counts.repeated > 12) == (1, True)
    assert len({data for one in alone for data in one}) > 20


def test_answers_equal_the_fixer_in_this_process(upstream, overrides, tmp_path, monkeypatch):
    trust_every_frame(monkeypatch, 0.9)
    frames = drive(6, parts_at=1, aside_mps=4.0)
    mask = holes(tmp_path)
    with in_front_of(upstream, overrides=overrides, masks={CAMERA: mask}) as (
        stub,
        _,
    ):
        served = [decode_image(data) for data in answers(stub, frames)]
    fixer = make_fixer(
        "onefixer",
        fixer_settings("onefixer", [*overrides, "noise=content"]),
        scene_id="scene",
    )
    trusted = np.full((HEIGHT, WIDTH), 255, dtype=np.uint8)
    trusted[:, : WIDTH // 3] = 0
    alpha = trusted_opacity(0.9, trusted, HEIGHT, WIDTH)
    for i, (asked, got) in enumerate(zip(frames, served, strict=True)):
        (fixed,) = fixer.step([Frame(START_US + i * STEP_US, CAMERA, picture(asked), alpha)], ())
        np.testing.assert_array_equal(got, fixed.rgb)
        assert (got != picture(asked)).any()


def test_a_batch_has_one_item_for_each_camera_with_success_set(
    upstream, overrides, renderer, monkeypatch
):
    trust_every_frame(monkeypatch)
    cameras = [CAMERA, "camera_rear_tele_30fov"]
    frames = [drive(2, camera=camera) for camera in cameras]
    with in_front_of(upstream, overrides=overrides) as (stub, _):
        for pair in zip(*frames, strict=True):
            reply = stub.batch_render_rgb(batch(list(pair)))
            assert [
                (item.camera_name, item.success, item.error_message) for item in reply.items
            ] == [(c, True, "") for c in cameras]
            assert [item.result.image_bytes for item in reply.items] == answers(stub, pair)
        twice = batch([frames[0][0], frames[0][0]])
        with pytest.raises(grpc.RpcError, match="a camera name twice"):
            stub.batch_render_rgb(twice)
    assert renderer.calls == ["batch_render_rgb"] * 2  # handed on as a batch


def test_aggregated_renders_are_fixed_and_keep_the_drivers_data(upstream, overrides, renderer):
    frames = drive(2)
    aggregated = sensorsim_pb2.AggregatedRenderRequest(rgb_requests=frames)
    with in_front_of(upstream, overrides=overrides) as (stub, _):
        reply = stub.render_aggregated(aggregated)
        assert renderer.calls == ["render_aggregated"]  # every frame is drawn once
        assert [r.image_bytes for r in reply.rgb_returns] == answers(stub, frames)
        assert reply.driver_data == b"for the driver"
    with in_front_of(upstream, overrides=overrides) as (stub, _):
        assert [r.image_bytes for r in reply.rgb_returns] == answers(stub, frames)


def test_an_aggregated_answer_without_an_image_is_the_upstreams_fault(
    upstream, overrides, renderer
):
    renderer.lost_images = 1
    aggregated = sensorsim_pb2.AggregatedRenderRequest(rgb_requests=drive(2))
    with (
        in_front_of(upstream, overrides=overrides) as (stub, _),
        pytest.raises(grpc.RpcError, match="1 images for 2"),
    ):
        stub.render_aggregated(aggregated)


def test_frames_of_a_camera_in_one_call_follow_one_another_by_time(upstream, overrides):
    frames = drive(3)

    def answered(asked):
        call = sensorsim_pb2.AggregatedRenderRequest(rgb_requests=asked)
        with in_front_of(upstream, overrides=overrides) as (stub, _):
            return [one.image_bytes for one in stub.render_aggregated(call).rgb_returns]

    in_order = answered(frames)
    assert answered(frames[::-1])[::-1] == in_order
    assert answered(frames[2:]) != in_order[2:]  # the fixer's past counts


def test_the_version_changes_with_settings_and_weights_and_names_the_upstream(
    upstream, overrides, tmp_path
):
    def version(**settings):
        with in_front_of(upstream, **settings) as (stub, _):
            return stub.get_version(EMPTY)

    first = version(overrides=overrides)
    assert first == version(overrides=overrides)
    others = [
        version(overrides=[*overrides, "holes=render"]),
        version(overrides=overrides[1:]),
        version(overrides=overrides, masks={CAMERA: holes(tmp_path)}),
        version(renderer="identity"),
    ]
    triples = {(v.version_id, v.git_hash) for v in (first, *others)}
    assert len(triples) == len({v.git_hash for v in (first, *others)}) == 5
    assert first.version_id.endswith("over stand-in")
    assert (first.grpc_api_version.minor, first.git_hash[40:]) == (54, "+abc")
