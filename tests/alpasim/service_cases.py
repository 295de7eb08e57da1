"""A painted renderer of AlpaSim's protocol, requests as its runtime makes them, and a running
service in front of that renderer.
"""

from contextlib import contextmanager
from itertools import pairwise

import cv2
import grpc
import numpy as np

from alpasim_plugin.alpasim.server.assembly import Settings, Upstream, assemble
from alpasim_plugin.alpasim.server.hosting import Host, HostPolicy
from alpasim_plugin.alpasim.server.sources import UpstreamSource
from alpasim_plugin.core.geometry import quat_from_matrix, se2
from alpasim_plugin.log.images import encode_image
from alpasim_plugin.log.wire import api_version, common_pb2, sensorsim_pb2
from alpasim_plugin.log.wire.services import OPTIONS, Stub
from tests.camera_builders import ahead

CAMERA = "camera_front_wide_120fov"
WIDTH = 48
HEIGHT = 32
STEP_US = 100_000
SHUTTER_US = 30_000
START_US = 1_689_697_803_493_732
# Optical axes in the rig: x right, y down, z forward.
T_RIG_CAMERA = ahead(x_m=1.7)


def wire_pose(T):
    """Return the message of a pose."""
    w, x, y, z = quat_from_matrix(T[None, :3, :3])[0].tolist()
    return common_pb2.Pose(
        vec=common_pb2.Vec3(x=T[0, 3], y=T[1, 3], z=T[2, 3]),
        quat=common_pb2.Quat(w=w, x=x, y=y, z=z),
    )


def pinhole(width=WIDTH, height=HEIGHT, name=CAMERA):
    """Return the intrinsics of a pinhole without distortion."""
    lens = sensorsim_pb2.OpenCVPinholeCameraParam(focal_length_x=40, focal_length_y=40)
    lens.principal_point_x = width / 2
    lens.principal_point_y = height / 2
    return sensorsim_pb2.CameraSpec(
        opencv_pinhole_param=lens, logical_id=name, resolution_w=width, resolution_h=height
    )


def request(
    before,
    now,
    t_us,
    shutter_us=SHUTTER_US,
    image_format=sensorsim_pb2.PNG,
    camera=CAMERA,
    scene_id="scene",
    size=(WIDTH, HEIGHT),
):
    """Return a request as AlpaSim's runtime makes it: the shutter's start lies on the line between
    two poses of the rig ``(4, 4)``.
    """
    start = now.copy()
    start[:3, 3] += (before[:3, 3] - now[:3, 3]) * shutter_us / STEP_US
    pair = sensorsim_pb2.PosePair(
        start_pose=wire_pose(start @ T_RIG_CAMERA), end_pose=wire_pose(now @ T_RIG_CAMERA)
    )
    return sensorsim_pb2.RGBRenderRequest(
        scene_id=scene_id,
        resolution_w=size[0],
        resolution_h=size[1],
        camera_intrinsics=pinhole(*size, name=camera),
        frame_start_us=t_us - shutter_us,
        frame_end_us=t_us,
        sensor_pose=pair,
        image_format=image_format,
        image_quality=95.0,
    )


def drive(steps, parts_at=0, aside_mps=0.0, brake_mps2=0.0, **options):
    """Return the requests of a drive along x at 10 m/s that swerves or brakes from a step on; until
    then all drives are equal.
    """
    xy = np.zeros(2)
    speed = 10.0
    poses = []
    for step in range(-1, steps):
        poses.append(se2(float(xy[0]), float(xy[1]), 0.0))
        on = step >= parts_at
        speed = max(0.0, speed - brake_mps2 * STEP_US / 1e6) if on else speed
        xy = xy + np.array([speed, aside_mps if on else 0.0]) * STEP_US / 1e6
    return [
        request(a, b, START_US + i * STEP_US, **options) for i, (a, b) in enumerate(pairwise(poses))
    ]


def picture(asked):
    """Draw stripes that move with the camera: a function of the request alone."""
    end = asked.sensor_pose.end_pose.vec
    y, x = np.mgrid[0 : asked.resolution_h, 0 : asked.resolution_w].astype(np.float64)
    waves = [np.sin(x / 4 + end.x * k + end.y) * np.cos(y / 5 + end.y * 3) for k in (1.0, 1.7, 2.3)]
    return np.stack([127.5 + 110 * wave for wave in waves], axis=-1).astype(np.uint8)


class StandInRenderer:
    """A server of the renderer service; ``fault`` may replace an answer."""

    def __init__(self):
        self.calls = []
        self.lost_images = 0  # of an aggregated answer
        self.fault = None  # called with (request, context, image bytes); returns the bytes to send

    def get_version(self, asked, context):
        """Return a triple."""
        return common_pb2.VersionId(
            version_id="stand-in", git_hash="abc", grpc_api_version=api_version()
        )

    def get_available_scenes(self, asked, context):
        """Know every scene."""
        return common_pb2.AvailableScenesReturn(scene_ids=["*"])

    def get_available_cameras(self, asked, context):
        """List one camera."""
        camera = sensorsim_pb2.AvailableCamerasReturn.AvailableCamera
        listed = camera(
            intrinsics=pinhole(), rig_to_camera=wire_pose(T_RIG_CAMERA), logical_id=CAMERA
        )
        return sensorsim_pb2.AvailableCamerasReturn(available_cameras=[listed])

    def get_available_trajectories(self, asked, context):
        """List a straight path."""
        poses = [
            common_pb2.PoseAtTime(pose=wire_pose(se2(x, 0.0, 0.0)), timestamp_us=START_US + i)
            for i, x in enumerate((-10.0, 90.0))
        ]
        listed = sensorsim_pb2.AvailableTrajectoriesReturn.AvailableTrajectory(
            trajectory=common_pb2.Trajectory(poses=poses)
        )
        return sensorsim_pb2.AvailableTrajectoriesReturn(available_trajectories=[listed])

    def get_available_ego_masks(self, asked, context):
        """List one mask."""
        mask = sensorsim_pb2.AvailableEgoMasksReturn.EgoMaskMetadata(
            ego_mask_id=sensorsim_pb2.EgoMaskId(camera_logical_id=CAMERA)
        )
        return sensorsim_pb2.AvailableEgoMasksReturn(ego_mask_metadata=[mask])

    def render_lidar(self, asked, context):
        """Return one point."""
        return sensorsim_pb2.LidarRenderReturn(point_xyzs=[1.0, 2.0, 3.0], num_points=1)

    def render_rgb(self, asked, context):
        """Draw one frame."""
        self.calls.append("render_rgb")
        return sensorsim_pb2.RGBRenderReturn(image_bytes=self._image(asked, context))

    def batch_render_rgb(self, asked, context):
        """Draw one frame a camera."""
        self.calls.append("batch_render_rgb")
        item = sensorsim_pb2.BatchRGBRenderReturnItem
        result = sensorsim_pb2.RGBRenderReturn
        images = [self._image(i.request, context) for i in asked.items]
        made = [
            item(camera_name=i.camera_name, success=True, result=result(image_bytes=data))
            for i, data in zip(asked.items, images, strict=True)
        ]
        return sensorsim_pb2.BatchRGBRenderReturn(items=made)

    def render_aggregated(self, asked, context):
        """Draw frames, with bytes for the driver."""
        self.calls.append("render_aggregated")
        rgb = [
            sensorsim_pb2.RGBRenderReturn(image_bytes=self._image(r, context))
            for r in asked.rgb_requests[self.lost_images :]
        ]
        return sensorsim_pb2.AggregatedRenderReturn(rgb_returns=rgb, driver_data=b"for the driver")

    def _image(self, asked, context):
        data = encode_image(
            picture(asked), "png" if asked.image_format == sensorsim_pb2.PNG else "jpeg"
        )
        return data if self.fault is None else self.fault(asked, context, data)


@contextmanager
def hosted(services, **options):
    """Run services on a free port."""
    host = Host(services, "127.0.0.1:0", **options).start()
    try:
        yield host
    finally:
        host.stop(0.0)


@contextmanager
def channel_to(host):
    with grpc.insecure_channel(host.address, list(OPTIONS)) as channel:
        yield channel


def trust_every_frame(monkeypatch, trust=1.0):
    """Let the distance to the recorded path count for nothing."""
    monkeypatch.setattr(UpstreamSource, "_trust_in", lambda source, view, left: trust)


@contextmanager
def in_front_of(upstream, policy=HostPolicy(), **settings):
    """Run the service in front of another; give a stub of it and its parts."""
    made = assemble(Settings(upstream=Upstream(upstream.address), **settings))
    with (
        hosted({"SensorsimService": made.service}, policy=policy) as host,
        channel_to(host) as channel,
    ):
        yield Stub(channel, "SensorsimService"), made
    made.close()


def holes(folder):
    """Write a mask whose left third is not trusted at all, so that noise enters there."""
    mask = np.full((HEIGHT, WIDTH), 255, dtype=np.uint8)
    mask[:, : WIDTH // 3] = 0
    path = folder / "mask.png"
    cv2.imwrite(str(path), mask)
    return path


def answers(stub, requests):
    return [stub.render_rgb(r, timeout=60).image_bytes for r in requests]
