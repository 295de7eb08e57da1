"""A recorded drive of comma2k19 as bus traffic: its raw frames with their times, sent again on any
bus, or decoded.

    python -m alpasim_plugin.control.can_replay COMMA2K19
    'udp_multicast:239.74.163.2?map=toyota&dbc=_toyota_2017.dbc'

The recording holds frames of two buses and the echoes of what its device sent (buses from 128 on);
one bus is replayed.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import numpy as np

from alpasim_plugin.control.can_bus import Address, open_bus
from alpasim_plugin.control.can_codec import BadFrame, Codec, checked_values, load_map, open_codec
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.printing import say
from alpasim_plugin.core.reading import check_regular, parsing

ECHOES = 128  # buses from here on repeat what the recording device sent


@dataclass(frozen=True)
class Recording:
    """Frames of one bus in the order of their times."""

    t_s: np.ndarray[Any, np.dtype[np.float64]]  # (N,) seconds from the first frame
    address: np.ndarray[Any, np.dtype[np.int64]]  # (N,)
    data: np.ndarray[
        Any, np.dtype[np.bytes_]
    ]  # (N,) up to 8 bytes; zero bytes at the end are cut off

    def frames(self, codec: Codec) -> Iterator[tuple[float, can.Message]]:
        """Yield every frame whose message the database knows, with its time; the data get the
        message's length back.
        """
        for t, address, data in zip(
            self.t_s.tolist(), self.address.tolist(), self.data.tolist(), strict=True
        ):
            try:
                length = codec.database.get_message_by_frame_id(address).length
            except KeyError:
                continue
            yield (
                t,
                can.Message(
                    timestamp=t,
                    arbitration_id=address,
                    data=data.ljust(length, b"\0"),
                    is_extended_id=False,
                ),
            )


def read_recording(folder: Path, bus: int = 0) -> Recording:
    """Read ``processed_log/CAN/raw_can`` of a comma2k19 segment.

    Raises:
        InputError: A file is missing or not an array of its kind, or the bus has no frame.
    """
    arrays = {}
    for name, kind in (("t", "f"), ("src", "iu"), ("address", "iu"), ("data", "S")):
        path = folder / "processed_log" / "CAN" / "raw_can" / f"{name}.npy"
        check_regular(path)
        with parsing(path, do_this="fetch the segment again", what="a numpy array"):
            arrays[name] = np.load(path, allow_pickle=False)
        if (
            arrays[name].ndim != 1
            or arrays[name].dtype.kind not in kind
            or len(arrays[name]) != len(arrays["t"])
        ):
            raise InputError(
                f"{path}: {arrays[name].dtype} {arrays[name].shape}",
                "give one value a frame in each of t, src, address, data",
            )
    own = arrays["src"] == bus
    if not own.any() or bus >= ECHOES:
        buses = sorted(set(arrays["src"].tolist()))
        raise InputError(
            f"{folder}: no frame of bus {bus}",
            f"choose among {buses}; those from {ECHOES} on are echoes",
        )
    order = np.argsort(arrays["t"][own], kind="stable")
    t, address, data = (arrays[name][own][order] for name in ("t", "address", "data"))
    return Recording((t - t[0]).astype(np.float64), address.astype(np.int64), data)


def decode(
    recording: Recording, codec: Codec
) -> tuple[dict[str, tuple[list[float], list[float]]], Counter[str]]:
    """Return the map's quantities, each as times (s) and values, and how many frames of each
    message passed and failed their checks.
    """
    parts = {codec.message(sent.message).frame_id: sent for sent in codec.map.send}
    out: dict[str, tuple[list[float], list[float]]] = {}
    counts: Counter[str] = Counter()
    for t, frame in recording.frames(codec):
        sent = parts.get(frame.arbitration_id)
        if sent is None:
            continue
        try:
            values = checked_values(codec.message(sent.message), bytes(frame.data), sent.checksum)
        except BadFrame:
            counts[f"{sent.message} refused"] += 1
            continue
        counts[sent.message] += 1
        total: dict[str, float] = {}
        for name, content in sent.contents().items():
            total[content.quantity] = (
                total.get(content.quantity, 0.0) + values[name] / content.scale
            )
        for quantity, value in total.items():
            times, series = out.setdefault(quantity, ([], []))
            times.append(t)
            series.append(value)
    return out, counts


def replay(
    recording: Recording,
    codec: Codec,
    bus: can.BusABC,
    speed: float = 1.0,
    clock: Callable[[], float] = time.perf_counter,
    sleep: Callable[[float], None] = time.sleep,
) -> tuple[int, float]:
    """Send a recording with its own timing, and return the number of frames and the largest delay
    of one, s.

    Args:
        recording: From `read_recording`.
        codec: Knows the messages' lengths.
        bus: Where to.
        speed: Recorded seconds in one real second; infinity sends without waiting.
        clock: Seconds that only grow.
        sleep: Waits for so many seconds.
    """
    began = clock()
    count = 0
    worst = 0.0
    for t, frame in recording.frames(codec):
        due = began + t / speed
        if (left := due - clock()) > 0:
            sleep(left)
        bus.send(frame)
        worst = max(worst, clock() - due) if speed != float("inf") else 0.0
        count += 1
    return count, worst


def main(arguments: Sequence[str] | None = None) -> None:
    """Replay a segment and print what it carries."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("folder", type=Path, help="a comma2k19 segment")
    parser.add_argument(
        "address", help="as after can://, with a map for the recorded car: ...?map=toyota&dbc=FILE"
    )
    parser.add_argument(
        "--speed", type=float, default=1.0, help="recorded seconds in a real second"
    )
    given = parser.parse_args(arguments)
    address = Address.parse(given.address)
    codec = open_codec(*load_map(address.map, address.dbc))
    recording = read_recording(given.folder)
    series, counts = decode(recording, codec)
    for name, number in sorted(counts.items()):
        say(f"{name:28} {number:6} frames")
    for quantity, (_, values) in sorted(series.items()):
        say(f"{quantity:28} {min(values):10.3f} to {max(values):.3f}")
    with open_bus(address) as bus:
        sent, worst = replay(recording, codec, bus, given.speed)
    say(
        f"sent {sent} frames in {recording.t_s[-1] / given.speed:.1f} s, at most {worst * 1000:.1f} ms late"
    )


if __name__ == "__main__":
    main()
