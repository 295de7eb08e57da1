"""Answer render requests: find the frame or its past, render, fix, remember, encode."""

import threading
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2

from alpasim_plugin.alpasim.server.caches import FixerCache
from alpasim_plugin.alpasim.server.history import HistoryTree, Node
from alpasim_plugin.alpasim.server.lens_cache import size_of
from alpasim_plugin.alpasim.server.sources import FrameSource, Rendered, Request
from alpasim_plugin.alpasim.server.status import CallTime, UpstreamFault
from alpasim_plugin.alpasim.server.views import MAX_PIXELS, View, read_view
from alpasim_plugin.cameras.lens import blackened
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import U8
from alpasim_plugin.log.images import ImageEncoding, encode_image
from alpasim_plugin.log.wire import sensorsim_pb2

ENCODINGS: dict[int, ImageEncoding] = {sensorsim_pb2.PNG: "png", sensorsim_pb2.JPEG: "jpeg"}
# What a frame and each of its objects hold beside images and tensors, roughly.
NODE_BYTES = 4096
OBJECT_BYTES = 512
# Of all frames of a call: four cameras of 3840 x 2160, which are held until the last is done.
MOST_PIXELS = 2 * MAX_PIXELS
QUALITY = 95.0  # where a request leaves it unset; AlpaSim always asks for it


@dataclass(frozen=True)
class Answered:
    """What the tree keeps of a frame: the image that was given, and the fixer's past for the next
    one.
    """

    image: U8
    past: Any


class FrameServer:
    """Frames for requests, in any order and from several threads.

    Args:
        source: Renders.
        fixers: Fixes; None: frames are given as rendered, and no history is kept.
        tree: Histories.
        busy: Held while something is computed.
        width: Wider images are made at this width and enlarged to the size asked for; None: all
            are made as asked.
    """

    def __init__(
        self,
        source: FrameSource,
        fixers: FixerCache | None,
        tree: HistoryTree[Answered],
        busy: threading.Lock,
        width: int | None = None,
    ) -> None:
        self.source = source
        self.tree = tree
        self._fixers = fixers
        self._busy = busy
        self._width = width
        self.events: Counter[str] = Counter()

    def answers(
        self, requests: Sequence[Request], left: CallTime, source: FrameSource | None = None
    ) -> list[bytes]:
        """Return an encoded image for every request, in order. Equal requests get equal bytes.

        Args:
            requests: Of one call.
            left: Of the caller.
            source: Gives the frames in place of the server's own source.

        Raises:
            SimrunError, grpc.RpcError, Late: See `status.status_of`.
        """
        source = source or self.source
        forms = [image_form(request) for request in requests]
        views = [read_view(request) for request in requests]
        pixels = sum(view.width * view.height for view in views)
        if pixels > MOST_PIXELS:
            raise InputError(
                f"{len(views)} frames: {pixels} pixels",
                f"ask for at most {MOST_PIXELS} in one call",
            )
        sizes = [(view.width, view.height) for view in views]
        if self._width is not None:
            views = [
                scaled(view, self._width) if view.width > self._width else view for view in views
            ]
        if self._fixers is None:
            rendered = source.render(requests, views, left)
            return [
                encode(self._sized(item.frame.rgb, size), form)
                for item, size, form in zip(rendered, sizes, forms, strict=True)
            ]
        nodes = self._nodes(requests, views, source, left)
        images = [nodes[view.key].state.image for view in views]
        return [
            encode(self._sized(image, size), form)
            for image, size, form in zip(images, sizes, forms, strict=True)
        ]

    def _nodes(
        self,
        requests: Sequence[Request],
        views: Sequence[View],
        source: FrameSource,
        left: CallTime,
    ) -> dict[bytes, Node[Answered]]:
        """Return the fixed frames of a call by the keys of their views; those that no call has asked
        for before are rendered and fixed.
        """
        nodes: dict[bytes, Node[Answered]] = {}
        missing: dict[bytes, tuple[Request, View]] = {}
        for request, view in zip(requests, views, strict=True):
            node = self.tree.find(view)
            if node is None:
                missing[view.key] = request, view
            else:
                nodes[view.key] = node
        if missing:
            # A camera's frames follow one another by time, however a call lists them.
            by_time = sorted(missing.values(), key=lambda pair: pair[1].t_us)
            requests_in_time, views_in_time = zip(*by_time, strict=True)
            rendered = source.render(requests_in_time, views_in_time, left)
            for item, view in zip(rendered, views_in_time, strict=True):
                nodes[view.key] = self._fixed(item, view, left)
        return nodes

    def _fixed(self, item: Rendered, view: View, left: CallTime) -> Node[Answered]:
        assert self._fixers is not None
        with left.holding(self._busy):
            # Under the lock: which frames there are does not change until the entry.
            node = self.tree.find(view)
            if node is not None:  # another call has made it meanwhile
                return node
            parent = self.tree.parent_of(view)
            if parent is not None and parent.state.image.shape[:2] != item.frame.size:
                raise UpstreamFault(
                    f"scene {view.scene_id!r}, camera {view.camera!r}: an image of {item.frame.size} after {parent.state.image.shape[:2]} (height, width)",
                    "see the upstream's log",
                )
            past = None if parent is None else parent.state.past
            frame, after = self._fixers.of(view.scene_id).advance(item.frame, item.sdmap, past)
            self.events.update(frame.events)
            answered = Answered(blackened(frame.rgb, item.blind), after)
            size = size_of(answered) + NODE_BYTES + OBJECT_BYTES * len(view.objects)
            return self.tree.add(view, answered, size, parent)

    def _sized(self, image: U8, size: tuple[int, int]) -> U8:
        """Return an image at the size asked for, where it was made smaller; an upstream's image
        has the size that the upstream chose.
        """
        return image if self._width is None else enlarged(image, size)


def image_form(request: Request) -> tuple[int, float]:
    """Return the format and quality that a request asks for.

    Raises:
        InputError: Neither PNG nor JPEG, or a quality outside 1 to 100.
    """
    quality = request.image_quality or QUALITY
    if request.image_format not in ENCODINGS:
        name = (
            sensorsim_pb2.ImageFormat.Name(request.image_format)
            if request.image_format < 7
            else str(request.image_format)
        )
        raise InputError(f"image_format {name}: no format that is made here", "ask for PNG or JPEG")
    if not 1 <= quality <= 100:
        raise InputError(f"image_quality {quality}: not between 1 and 100", "ask for 95")
    return request.image_format, quality if request.image_format == sensorsim_pb2.JPEG else 0.0


def enlarged(image: U8, size: tuple[int, int]) -> U8:
    """Return an image at a size (width, height), between pixels bicubically; as it is where it has
    that size.
    """
    if image.shape[1::-1] == size:
        return image
    return cv2.resize(image, size, interpolation=cv2.INTER_CUBIC)


def encode(image: U8, form: tuple[int, float]) -> bytes:
    """Encode an image ``(H, W, 3)`` as asked."""
    return encode_image(image, ENCODINGS[form[0]], round(form[1]))


def scaled(view: View, width: int) -> View:
    """Return a view at another width, its height in proportion."""
    return replace(view, width=width, height=max(round(view.height * width / view.width), 1))
