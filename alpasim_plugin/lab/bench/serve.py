"""Load on ``simrun serve``: how many requests a second, and what the fixer adds to a request's time
over handing it on.

Everything runs over loopback sockets in this process: a renderer that paints stripes, the service
in front of it, and one thread a rollout that asks for frame after frame, as AlpaSim's runtime does.
Rollouts swerve apart after a few frames.
"""

from __future__ import annotations

import os
import resource
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

import grpc
import numpy as np

from alpasim_plugin.alpasim.client.served_drives import PaintedRenderer, drive
from alpasim_plugin.alpasim.server.assembly import Assembled, Settings, Upstream, assemble
from alpasim_plugin.alpasim.server.hosting import Host
from alpasim_plugin.log.wire import sensorsim_pb2
from alpasim_plugin.log.wire.services import OPTIONS, Stub

PARTS_AT = 4  # frames that all rollouts share
EPISODE = 200  # frames of a rollout in the soak, as AlpaSim's default
Request = sensorsim_pb2.RGBRenderRequest
Answer = Callable[[Any, Request], bytes]


@dataclass(frozen=True)
class LoadRow:
    """One number of concurrent rollouts.

    Attributes:
        rollouts: How many ask at the same time.
        requests_per_s: Answered through the fixer.
        p50_ms, p95_ms, p99_ms: Time of a request through the fixer.
        added_p50_ms, added_p95_ms, added_p99_ms: The same percentile of handing on, taken off.
        unequal: Answers that differ from those that the rollout gets alone.
    """

    rollouts: int
    requests_per_s: float
    p50_ms: float
    p95_ms: float
    p99_ms: float
    added_p50_ms: float
    added_p95_ms: float
    added_p99_ms: float
    unequal: int


@dataclass(frozen=True)
class SoakRow:
    """A long run.

    Attributes:
        frames: Answered.
        seconds: How long it took.
        resident_first_mb, resident_last_mb: Memory of the process after a tenth of the frames, and
            at the end.
        history_max_mb: Most memory that the histories held.
        files_grown, threads_grown: Open files and threads, end less start.
        failed: Requests without an answer.
    """

    frames: int
    seconds: float
    resident_first_mb: float
    resident_last_mb: float
    history_max_mb: float
    files_grown: int
    threads_grown: int
    failed: int


def drives(
    rollouts: int, frames: int, size: tuple[int, int], scene_id: str = "scene"
) -> list[list[Request]]:
    """Return the requests of rollouts that share their first frames and then swerve apart, 0.2 m/s
    each.
    """
    jpeg = sensorsim_pb2.JPEG
    return [
        drive(frames, PARTS_AT, 0.2 * i, size=size, scene_id=scene_id, image_format=jpeg)
        for i in range(rollouts)
    ]


@contextmanager
def in_front(upstream: Host, settings: Settings) -> Iterator[tuple[Host, Assembled]]:
    """Run the service in front of a renderer."""
    made = assemble(settings)
    host = Host(
        {"SensorsimService": made.service}, "127.0.0.1:0", workers=32, every=made.tree.expire
    ).start()
    try:
        yield host, made
    finally:
        host.stop(0.0)
        made.close()


def ask_all(
    address: str, wanted: Sequence[Sequence[Request]]
) -> tuple[list[list[bytes]], list[float], float]:
    """Drive all rollouts at the same time, each over its own thread, all over one channel.

    Returns:
        The answers by rollout, the times of all requests in milliseconds, and the seconds that all
        took.
    """
    answers: list[list[bytes]] = [[] for _ in wanted]
    times: list[list[float]] = [[] for _ in wanted]
    failures: list[BaseException] = []

    def run(index: int, stub: Any) -> None:
        try:
            for request in wanted[index]:
                began = time.perf_counter()
                answers[index].append(stub.render_rgb(request, timeout=300).image_bytes)
                times[index].append(1e3 * (time.perf_counter() - began))
        except BaseException as error:
            failures.append(error)

    with grpc.insecure_channel(address, list(OPTIONS)) as channel:
        stub = Stub(channel, "SensorsimService")
        threads = [threading.Thread(target=run, args=(i, stub)) for i in range(len(wanted))]
        began = time.perf_counter()
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        seconds = time.perf_counter() - began
    if failures:
        raise failures[0]
    return answers, [t for one in times for t in one], seconds


def bench_serve(
    settings: Settings, rollouts: Sequence[int], frames: int, size: tuple[int, int]
) -> list[LoadRow]:
    """Measure the fixer of ``settings`` under load; its upstream and renderer's base are replaced
    by the painted one.
    """
    rows = []
    with ExitStack() as stack:
        upstream = stack.enter_context(
            Host({"SensorsimService": PaintedRenderer()}, "127.0.0.1:0", workers=32)
        )
        at = Upstream(upstream.address)
        identity = stack.enter_context(
            in_front(upstream, Settings(renderer="identity", upstream=at))
        )[0]
        fixing = Settings(
            settings.renderer, settings.overrides, (), at, settings.device, settings.threads
        )
        warm = drives(1, 12, size, "warm-up")
        with in_front(upstream, fixing) as (host, _):
            ask_all(host.address, warm)  # the network is loaded and recorded
        for count in rollouts:
            wanted = drives(count, frames, size)
            _, handed_ms, _ = ask_all(identity.address, wanted)
            with in_front(upstream, fixing) as (host, _):
                got, fixed_ms, seconds = ask_all(host.address, wanted)
            with in_front(upstream, fixing) as (host, _):
                alone = [ask_all(host.address, [one])[0][0] for one in wanted]
            unequal = sum(
                a != b for x, y in zip(got, alone, strict=True) for a, b in zip(x, y, strict=True)
            )
            through, base = (np.percentile(ms, [50, 95, 99]) for ms in (fixed_ms, handed_ms))
            p50, p95, p99, more50, more95, more99 = (
                float(ms) for ms in (*through, *(through - base))
            )
            rows.append(
                LoadRow(
                    count, count * frames / seconds, p50, p95, p99, more50, more95, more99, unequal
                )
            )
    return rows


def soak(settings: Settings, frames: int, size: tuple[int, int], rollouts: int = 4) -> SoakRow:
    """Answer many frames and watch memory, files and threads. Rollouts of `EPISODE` frames follow
    one another, each on its own way.
    """
    with ExitStack() as stack:
        upstream = stack.enter_context(
            Host({"SensorsimService": PaintedRenderer()}, "127.0.0.1:0", workers=32)
        )
        served = Settings(
            settings.renderer,
            settings.overrides,
            (),
            Upstream(upstream.address),
            settings.device,
            settings.threads,
            history_bytes=settings.history_bytes,
        )
        host, made = stack.enter_context(in_front(upstream, served))
        ask_all(host.address, drives(rollouts, 12, size, "warm-up"))
        files = open_files()
        threads = threading.active_count()
        done = 0
        failed = 0
        most = 0
        first = 0.0
        began = time.perf_counter()
        length = max(1, min(EPISODE, frames // (10 * rollouts)))
        while done < frames:
            wanted = [
                drive(
                    length,
                    PARTS_AT,
                    0.2 * i + 1e-3 * done / length,
                    size=size,
                    image_format=sensorsim_pb2.JPEG,
                )
                for i in range(rollouts)
            ]
            got, _, _ = ask_all(host.address, wanted)
            failed += sum(not data for one in got for data in one)
            done += rollouts * length
            most = max(most, made.tree.bytes)
            if first == 0.0 and done >= frames // 10:
                first = resident_mb()
        return SoakRow(
            done,
            time.perf_counter() - began,
            first,
            resident_mb(),
            most / 2**20,
            open_files() - files,
            threading.active_count() - threads,
            failed,
        )


def resident_mb() -> float:
    """Return the memory of this process in MiB."""
    try:
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * resource.getpagesize() / 2**20
    except OSError:  # not Linux: the most it ever was
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10


def open_files() -> int:
    """Return the number of this process's open files; -1 where the system does not tell."""
    try:
        return len(os.listdir("/proc/self/fd"))
    except OSError:
        return -1
