"""A running service in front of a painted renderer."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import grpc
import numpy as np

from alpasim_plugin.alpasim.client.served_drives import CAMERA as CAMERA
from alpasim_plugin.alpasim.client.served_drives import HEIGHT, WIDTH
from alpasim_plugin.alpasim.client.served_drives import START_US as START_US
from alpasim_plugin.alpasim.client.served_drives import STEP_US as STEP_US
from alpasim_plugin.alpasim.client.served_drives import PaintedRenderer as StandInRenderer
from alpasim_plugin.alpasim.client.served_drives import drive as drive
from alpasim_plugin.alpasim.client.served_drives import picture as picture
from alpasim_plugin.alpasim.client.served_drives import pinhole as pinhole
from alpasim_plugin.alpasim.client.served_drives import request as request
from alpasim_plugin.alpasim.server.assembly import Assembled, Settings, Upstream, assemble
from alpasim_plugin.alpasim.server.hosting import Host, HostPolicy
from alpasim_plugin.log.wire import sensorsim_pb2
from alpasim_plugin.log.wire.services import OPTIONS, Stub

__all__ = ["StandInRenderer"]


@contextmanager
def hosted(services: dict[str, object], **options: Any) -> Iterator[Host]:
    """Run services on a free port."""
    host = Host(services, "127.0.0.1:0", **options).start()
    try:
        yield host
    finally:
        host.stop(0.0)


@contextmanager
def channel_to(host: Host) -> Iterator[Any]:
    with grpc.insecure_channel(host.address, list(OPTIONS)) as channel:
        yield channel


@contextmanager
def in_front_of(
    upstream: Host, policy: HostPolicy = HostPolicy(), **settings: Any
) -> Iterator[tuple[Any, Assembled]]:
    """Run the service in front of another; give a stub of it and its parts."""
    made = assemble(Settings(upstream=Upstream(upstream.address), threads=1, **settings))
    with (
        hosted({"SensorsimService": made.service}, policy=policy) as host,
        channel_to(host) as channel,
    ):
        yield Stub(channel, "SensorsimService"), made
    made.close()


def holes(folder: Path) -> Path:
    """Write a mask whose left third is not trusted at all, so that noise enters there."""
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, : WIDTH // 3] = 0
    path = folder / "mask.png"
    cv2.imwrite(str(path), mask)
    return path


def answers(stub: Any, requests: Sequence[sensorsim_pb2.RGBRenderRequest]) -> list[bytes]:
    return [stub.render_rgb(r, timeout=60).image_bytes for r in requests]
