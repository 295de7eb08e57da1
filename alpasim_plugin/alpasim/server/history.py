"""Histories without sessions: a tree of frames per scene, camera and lens.

AlpaSim's render requests carry no session. Several rollouts of one scene come over one connection,
interleaved, and with a deterministic driver their requests are equal byte for byte. So a frame's
past is found by content:

- A request that is equal to an earlier one *is* that frame, and has its answer.
- Otherwise its parent is the frame before it on the same drive. With the shutter pair (start, end)
  of the request, the camera was at ``end - (end - start) dt / shutter`` a time ``dt`` earlier
  (AlpaSim interpolates poses linearly over a control step, so this is nearly exact); dynamic
  objects are taken back in the same way. With a shutter of 0, the parent's own motion is continued
  instead; the first frame of a drive has none, so its nearest pose counts.
- A frame with no parent within reach starts a history.

Two drives that differ thus have their own branches from where they part, and what one receives does
not depend on the other.

Memory is bounded: what nobody used for `expiry_s` goes; beyond `max_bytes`, first frames that have
a successor, the longest unused first, then the ends of branches, the longest unused first.
"""

import threading
import time
from bisect import bisect_left, insort
from collections import OrderedDict, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

import cv2
import numpy as np

from alpasim_plugin.alpasim.server.views import View
from alpasim_plugin.core.geometry import rigid
from alpasim_plugin.core.types import F64

SLACK_M = 0.1  # error of a predicted pose that is always allowed ...
# ... plus this times dt^2: twice the error of a constant speed under hard braking
ACCEL_MPS2 = 10.0
# where there is no motion to continue, farther than this times dt is another place
SPEED_MPS = 70.0
LEVER_M = 2.0  # a turn by one radian counts as this distance
S = TypeVar("S")
GAP_US = 2_000_000  # longest time between two frames of a drive


def distance(view: View, before: View, T_before: tuple[F64, int] | None) -> tuple[float, float]:
    """Return how far a frame is from where a view's drive was at its time, in metres, and how far
    it may be.

    Args:
        view: The later frame.
        before: The earlier one.
        T_before: Camera pose and time of the frame before that one, where known.
    """
    dt_us = view.t_us - before.t_us
    shutter_us = view.t_us - view.start_us
    reach_m = SLACK_M + ACCEL_MPS2 * (dt_us / 1e6) ** 2
    start, end = view.T_world_camera
    position = before.T_world_camera[1]
    if shutter_us > 0:
        back = dt_us / shutter_us
        ego_m = apart(on_line(end, start, back), position)
        return ego_m + _objects_apart(view, before, back), reach_m
    if T_before is not None:
        last, last_us = T_before
        return apart(end, on_line(last, position, 1 + dt_us / (before.t_us - last_us))), reach_m
    return apart(end, position), SLACK_M + SPEED_MPS * dt_us / 1e6


def on_line(a: F64, b: F64, s: float) -> F64:
    """Return the pose ``(4, 4)`` at ``s`` on the steady motion through ``a`` at 0 and ``b`` at 1;
    ``s`` may lie outside.

    Example:
        >>> a, b = np.eye(4), np.eye(4)
        >>> b[0, 3] = 2.0
        >>> on_line(a, b, 3.0)[0, 3].item()
        6.0
    """
    turn, _ = cv2.Rodrigues(a[:3, :3].T @ b[:3, :3])
    return rigid(a[:3, :3] @ cv2.Rodrigues(turn * s)[0], a[:3, 3] + s * (b[:3, 3] - a[:3, 3]))


def apart(a: F64, b: F64) -> float:
    """Return the distance of two poses in metres, a radian counting as `LEVER_M`."""
    cosine = np.clip((np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2, -1.0, 1.0)
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3]) + LEVER_M * np.arccos(cosine))


def _objects_apart(view: View, before: View, back: float) -> float:
    """Return the mean distance in metres between where the dynamic objects that both frames show
    were in the earlier one, and where their motion during the later one's shutter, continued
    backwards, puts them at that time. It tells drives apart whose traffic differs.

    Args:
        view: The later frame.
        before: The earlier one.
        back: Time between the frames, in shutter times of the later one.
    """
    shared = [track for track in view.objects if track in before.objects]
    if not shared:
        return 0.0
    logged = np.array([before.objects[track][1, :3, 3] for track in shared])
    start, end = (np.array([view.objects[track][i, :3, 3] for track in shared]) for i in (0, 1))
    predicted = end + back * (start - end)
    return float(np.linalg.norm(predicted - logged, axis=1).mean())


@dataclass(eq=False)
class Node(Generic[S]):
    """One frame that was answered.

    Attributes:
        view: Its request.
        state: What the fixer knows after it.
        size: Bytes that it holds.
        T_before: Camera pose and time of its parent; None at the start of a history.
        parent: Key of its parent.
        children: How many frames follow it.
    """

    view: View
    state: S
    size: int
    T_before: tuple[F64, int] | None
    parent: bytes | None
    used_s: float
    children: int = 0


@dataclass
class Counts:
    """What happened so far, for the log and the soak."""

    frames: int = 0
    repeated: int = 0
    starts: int = 0


class HistoryTree(Generic[S]):
    """The histories of all scenes and cameras. All methods may be called from several threads.

    Args:
        max_bytes: Most memory of all states.
        expiry_s: Frames unused for so long are forgotten.
        clock: Monotonic seconds.
    """

    def __init__(
        self, max_bytes: int, expiry_s: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.max_bytes, self.expiry_s, self._clock = max_bytes, expiry_s, clock
        self.bytes = 0
        self.counts = Counts()
        self._nodes: OrderedDict[bytes, Node[S]] = OrderedDict()  # the longest unused first
        # sorted by time
        self._times: dict[tuple[str, str, bytes], list[tuple[int, bytes]]] = defaultdict(list)
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._nodes)

    def find(self, view: View) -> Node[S] | None:
        """Return the frame that an equal request was answered with, if it is still known."""
        with self._lock:
            node = self._touch(view.key)
            self.counts.repeated += node is not None
            return node

    def parent_of(self, view: View) -> Node[S] | None:
        """Return the frame before a view on the same drive; None where a history starts."""
        with self._lock:
            node = self._nearest(view)
            return None if node is None else self._touch(node.view.key)

    def add(self, view: View, state: S, size: int, parent: Node[S] | None) -> Node[S]:
        """Enter an answered frame that is not known yet."""
        with self._lock:
            before = None if parent is None else (parent.view.T_world_camera[1], parent.view.t_us)
            node = Node(
                view,
                state,
                size,
                before,
                None if parent is None else parent.view.key,
                self._clock(),
            )
            self._nodes[view.key] = node
            insort(self._times[_group(view)], (view.t_us, view.key))
            self.bytes += size
            self.counts.frames += 1
            self.counts.starts += parent is None
            if parent is not None:
                parent.children += 1
            self._trim(keep=view.key)
            return node

    def expire(self) -> None:
        """Forget what nobody used for `expiry_s`."""
        with self._lock:
            self._trim(keep=None)

    def _touch(self, key: bytes) -> Node[S] | None:
        node = self._nodes.get(key)
        if node is not None:
            node.used_s = self._clock()
            self._nodes.move_to_end(key)
        return node

    def _nearest(self, view: View) -> Node[S] | None:
        best: tuple[float, Node[S]] | None = None
        newest_us: int | None = None
        for node in self._earlier(view):
            if newest_us is not None and node.view.t_us != newest_us and best is not None:
                return best[1]  # the latest time with a frame within reach has it
            newest_us = node.view.t_us
            error, limit = distance(view, node.view, node.T_before)
            if error <= limit and (best is None or error < best[0]):
                best = error, node
        return None if best is None else best[1]

    def _earlier(self, view: View) -> Iterator[Node[S]]:
        """Yield the frames of the same scene, camera and lens before a view, the latest first."""
        times = self._times.get(_group(view), [])
        for t_us, key in reversed(times[: bisect_left(times, (view.t_us, b""))]):
            if view.t_us - t_us > GAP_US:
                return
            yield self._nodes[key]

    def _trim(self, keep: bytes | None) -> None:
        now = self._clock()
        while self._nodes:
            oldest = next(iter(self._nodes.values()))
            if now - oldest.used_s <= self.expiry_s or oldest.view.key == keep:
                break
            self._remove(oldest)
        while self.bytes > self.max_bytes:
            others = [node for key, node in self._nodes.items() if key != keep]
            if not others:
                break
            self._remove(next((node for node in others if node.children), others[0]))

    def _remove(self, node: Node[S]) -> None:
        del self._nodes[node.view.key]
        group = _group(node.view)
        self._times[group].remove((node.view.t_us, node.view.key))
        if not self._times[group]:
            del self._times[group]
        self.bytes -= node.size
        parent = self._nodes.get(node.parent) if node.parent is not None else None
        if parent is not None:
            parent.children -= 1


def _group(view: View) -> tuple[str, str, bytes]:
    return view.scene_id, view.camera, view.lens
