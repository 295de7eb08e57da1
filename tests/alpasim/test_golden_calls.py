"""The calls that AlpaSim's own runtime made, as its logs hold them, made again to our service:
every answer valid and in order.
"""

import pytest

from alpasim_plugin.log.asl import AslReader
from alpasim_plugin.log.images import decode_image
from alpasim_plugin.log.wire import common_pb2, sensorsim_pb2
from tests.alpasim.service_cases import StandInRenderer, hosted, in_front_of, trust_every_frame


class RecordedRenderer(StandInRenderer):
    """Answer as the log's renderer did."""

    def __init__(self, entries):
        super().__init__()
        self._cameras = next(
            e.available_cameras_return for e in entries if e.HasField("available_cameras_return")
        )
        images = (
            e.driver_camera_image.camera_image for e in entries if e.HasField("driver_camera_image")
        )
        self._images = {(i.logical_id, i.frame_end_us): i.image_bytes for i in images}

    def get_available_cameras(self, asked, context):
        return self._cameras

    def get_available_ego_masks(self, asked, context):
        return sensorsim_pb2.AvailableEgoMasksReturn()

    def _image(self, asked, context):
        return self._images[asked.camera_intrinsics.logical_id, asked.frame_end_us]


def complete_logs(shared_data):
    """Return the first log of each scene: the others were stripped of their requests."""
    scenes = sorted((shared_data / "alpasim-golden" / "rollouts").iterdir())
    return [sorted(scene.rglob("rollout.asl"))[0] for scene in scenes]


def replay(log, scenes, **settings):
    """Make the calls of a log in its order and check each answer; return the images."""
    entries = list(AslReader(log))
    images = []
    with (
        hosted({"SensorsimService": RecordedRenderer(entries)}) as upstream,
        in_front_of(upstream, scenes=[str(scenes)], **settings) as (stub, made),
    ):
        stub.get_version(common_pb2.Empty())
        scene_ids = stub.get_available_scenes(common_pb2.Empty()).scene_ids
        for entry in entries:
            kind = entry.WhichOneof("log_entry")
            if kind == "available_cameras_request":
                assert {entry.available_cameras_request.scene_id, "*"} & set(scene_ids)
                cameras = stub.get_available_cameras(entry.available_cameras_request)
            elif kind == "available_cameras_return":
                assert cameras == entry.available_cameras_return
            elif kind == "available_ego_masks_request":
                assert (
                    stub.get_available_ego_masks(entry.available_ego_masks_request)
                    == sensorsim_pb2.AvailableEgoMasksReturn()
                )
            elif kind == "batch_render_request":
                reply = stub.batch_render_rgb(entry.batch_render_request, timeout=300)
                assert sorted(i.camera_name for i in reply.items) == sorted(
                    i.camera_name for i in entry.batch_render_request.items
                )
                for item in reply.items:
                    assert item.success
                    asked = next(
                        i.request
                        for i in entry.batch_render_request.items
                        if i.camera_name == item.camera_name
                    )
                    assert item.result.image_bytes[:2] == b"\xff\xd8"
                    assert asked.image_format == sensorsim_pb2.JPEG
                    assert decode_image(item.result.image_bytes).shape == (
                        asked.resolution_h,
                        asked.resolution_w,
                        3,
                    )
                    images.append(item.result.image_bytes)
        assert made.tree.counts.starts == (0 if made.fixers is None else 1), (
            "every frame but the first continues the drive"
        )
        assert made.tree.counts.frames in (0, len(images))
        assert not made.service.statuses
    return images


def test_the_calls_of_one_recorded_drive(shared_data, overrides, monkeypatch):
    trust_every_frame(monkeypatch)
    log = complete_logs(shared_data)[0]
    scenes = shared_data / "alpasim-golden" / "scenes"
    scene = scenes / f"{log.parents[1].name}.usdz"
    images = replay(log, scene, overrides=overrides)
    assert len(images) > 20
    handed_on = replay(log, scene, renderer="identity")
    recorded = [
        e.driver_camera_image.camera_image.image_bytes
        for e in AslReader(log)
        if e.HasField("driver_camera_image")
    ]
    assert handed_on == recorded
    assert images != handed_on


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_the_calls_of_all_recorded_drives(shared_data):
    """With the fixer that ships, its maps, and trust by the distance from each recorded path."""
    logs = complete_logs(shared_data)
    assert len(logs) > 20
    for log in logs:
        assert replay(
            log, shared_data / "alpasim-golden" / "scenes" / f"{log.parents[1].name}.usdz"
        )
