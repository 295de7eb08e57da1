"""Inputs that once gave way: each is a command line over files that it writes.

A case passes if it ends within the limits of time and memory, without a traceback: refused with
code 2 and four parts, or accepted.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable
from pathlib import Path

from tests.core.checksum_files import vouch_for
from tests.report.make_run import Plan, make_run
from tests.scenarios import make_argoverse, make_commonroad, make_usdz

LIMIT_S, LIMIT_BYTES = 60.0, 6 << 30
DRY = ["--dry-run", "--renderer", "clean", "--policy", "log-replay"]
ROAD = "version: 1\nroad: {lanes_forward: 1, segments: [{kind: straight, length_m: %s}]}\nego: {cruise_mps: 10}\n"
Make = Callable[[Path], list[str]]


def yaml(text: str, verb: list[str] = DRY) -> Make:
    def make(folder: Path) -> list[str]:
        (folder / "scene.yaml").write_text(text)
        return [*verb, str(folder / "scene.yaml")]

    return make


def road_of(length: str) -> Make:
    return yaml(ROAD % length)


def actors(text: str) -> Make:
    return yaml(ROAD % 400 + f"actors: [{text}]\n")


def surroundings(text: str) -> Make:
    """Build the scene as well: what stands beside the road is built with the renderer."""
    return yaml(
        ROAD % 200
        + f"environment: {{{text}}}\ntiming: {{duration_us: 600000, start_us: 100000, warmup_us: 100000}}\n",
        [
            "--renderer",
            "clean",
            "--policy",
            "log-replay",
            "--images",
            "none",
            "--quiet",
        ],
    )


def parked(n: int) -> Make:
    row = "{kind: parked, id: p%d, s_m: %.1f, count: 40, spacing_m: 7, label: car}"
    return actors(", ".join(row % (i, 10 + 0.01 * i) for i in range(n // 40)))


def followers(n: int) -> Make:
    row = "{kind: idm, id: f%d, s_m: %.1f, speed_mps: 8, lane: 0}"
    return yaml(
        ROAD % 3000 + "actors: [" + ", ".join(row % (i, 30 + 10 * i) for i in range(n)) + "]\n"
    )


def xodr(length: str = "400", geometry: str = "<line/>", s: str = "0") -> Make:
    def make(folder: Path) -> list[str]:
        lane = '<lane id="-1" type="driving"><width sOffset="0" a="3.6" b="0" c="0" d="0"/></lane>'
        back = lane.replace('id="-1"', 'id="1"')
        view = f'<geometry s="{s}" x="-20" y="1.8" hdg="0" length="{length}">{geometry}</geometry>'
        section = f'<laneSection s="0"><left>{back}</left><right>{lane}</right></laneSection>'
        road = f'<road id="1" length="{length}" junction="-1"><planView>{view}</planView><lanes>{section}</lanes></road>'
        content = {k: v for k, v in make_usdz.members().items() if not k.startswith("clipgt/")}
        content["map.xodr"] = f"<OpenDRIVE>{road}</OpenDRIVE>".encode()
        return [*DRY, str(make_usdz.write(folder / "scene.usdz", content))]

    return make


def tracks(**change: object) -> Make:
    def make(folder: Path) -> list[str]:
        content = make_usdz.members()
        sequence = make_usdz.sequence()
        for key, value in change.items():
            part = sequence["s"]["cuboidtracks_data" if key == "cuboids_dims" else "tracks_data"]
            part[key] = value
        content["sequence_tracks.json"] = json.dumps(sequence).encode()
        return [*DRY, str(make_usdz.write(folder / "scene.usdz", content))]

    return make


def cuboid_width(width: float) -> Make:
    def make(folder: Path) -> list[str]:
        rows = make_argoverse.cuboids(make_argoverse.TRACKS)
        rows["width_m"] = [width] * len(rows["width_m"])
        return [*DRY, str(make_argoverse.write_argoverse(folder / "log", annotations=rows))]

    return make


def commonroad_time(time_step: str) -> Make:
    def make(folder: Path) -> list[str]:
        states = make_commonroad.drive(20, 0)
        states[0] = states[0].replace(
            "<exact>0</exact></time>", f"<exact>{time_step}</exact></time>"
        )
        path = make_commonroad.write_commonroad(
            folder / "scene.xml", traffic=make_commonroad.obstacle(11, states)
        )
        return [*DRY, str(path)]

    return make


def arguments(*args: str) -> Make:
    return lambda folder: [*args]


def run_file(name: str, text: str, verb: str, more: tuple[str, ...] = ()) -> Make:
    def make(folder: Path) -> list[str]:
        run = vouch_for(
            make_run(
                folder / "run",
                Plan(scenes=("plain",), seeds=(0, 1), steps=30, pictures=False, clips=False),
            )
        )
        path = next(run.rglob(name)) if "/" not in name else run / name
        if path.name == "summary.json" and text.startswith("metrics="):
            content = json.loads(path.read_text())
            content["metrics"] = json.loads(text.removeprefix("metrics="))
            path.write_text(json.dumps(content))
        else:
            path.write_text(text)
        return [verb, str(run), *more]

    return make


def gate_files(**files: str) -> Make:
    def make(folder: Path) -> list[str]:
        run = vouch_for(
            make_run(
                folder / "run",
                Plan(scenes=("plain",), seeds=(0, 1), steps=30, pictures=False, clips=False),
            )
        )
        args = ["gate", str(run)]
        for option, text in files.items():
            path = folder / f"{option}.{'yaml' if option == 'gate' else 'json'}"
            path.write_text(text)
            args += [f"--{option.replace('_', '-')}", str(path)]
        return args

    return make


def raw_header(data: bytes) -> Make:
    def make(folder: Path) -> list[str]:
        path = folder / "weights.safetensors"
        path.write_bytes(struct.pack("<Q", len(data)) + data)
        return [
            *DRY[:1],
            "--renderer",
            "onefixer",
            "--policy",
            "log-replay",
            "--set",
            f"fixer.weights.bundle={path}",
            "smoke/straight",
        ]

    return make


def background(name: str, data: bytes) -> Make:
    def make(folder: Path) -> list[str]:
        (folder / name).write_bytes(data)
        text = (
            ROAD % 200
            + f"background: {{file: {name}}}\n"
            + "timing: {duration_us: 300000, start_us: 100000, warmup_us: 0}\n"
        )
        quick = [
            "--renderer",
            "clean",
            "--policy",
            "log-replay",
            "--images",
            "none",
            "--quiet",
        ]
        return yaml(text, [*quick, "--workers", "1", "--out", str(folder / "out")])(folder)

    return make


def spz_of(points: int) -> bytes:
    import gzip

    return gzip.compress(struct.pack("<IIIBBBB", 0x5053474E, 2, points, 0, 12, 0, 0) + b"\0" * 100)


def compressed_ply() -> bytes:
    bounds = [
        f"{end}_{name}"
        for end in ("min", "max")
        for name in ("x", "y", "z", "scale_x", "scale_y", "scale_z")
    ]
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        "element chunk 1",
        *(f"property float {b}" for b in bounds),
        "element vertex 1",
    ]
    lines += [f"property float packed_{k}" for k in ("position", "rotation", "scale", "color")]
    return ("\n".join([*lines, "end_header"]) + "\n").encode() + b"\0" * (48 + 16)


def png_header(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    rows = zlib.compress(b"\0" * min((3 * width + 1) * height, 1 << 20), 9)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def log_of(data: bytes) -> Make:
    def make(folder: Path) -> list[str]:
        (folder / "rollout.asl").write_bytes(data)
        return [
            "score",
            str(folder / "rollout.asl"),
            "--scene",
            "smoke/straight",
            "--out",
            str(folder / "out"),
        ]

    return make


def pipe(name: str, *args: str) -> Make:
    def make(folder: Path) -> list[str]:
        os.mkfifo(folder / name)
        return [*args, str(folder / name)]

    return make


SEEN: dict[str, Make] = {
    "road of 1e6 m": road_of("1.0e+6"),
    "road of 1e15 m": road_of("1.0e+15"),
    "road of 1e308 m": road_of("1.0e+308"),
    "OpenDRIVE of 3 km": xodr("3000"),
    "OpenDRIVE of 9 km": xodr("9000"),
    "OpenDRIVE s = 1e5": xodr(s="1e5"),
    "OpenDRIVE curvature 1e9": xodr(geometry='<arc curvature="1e9"/>'),
    "AV2 width 1e300": cuboid_width(1e300),
    "usdz size NaN": tracks(cuboids_dims=[[float("nan"), 2.5, 3.0], [0.6, 0.6, 1.8]]),
    "usdz size 1e9": tracks(cuboids_dims=[[1e9, 2.5, 3.0], [0.6, 0.6, 1.8]]),
    "size_m 1e6": actors("{kind: parked, id: a, s_m: 60, size_m: [1.0e+6, 2, 2]}"),
    "1e9 trees": surroundings("trees_per_100m: 1.0e+9"),
    "poles every 1e-9 m": surroundings("poles_spacing_m: 1.0e-9"),
    "20,000 parked cars": parked(20_000),
    "40 IDM actors": followers(40),
    "200 IDM actors": followers(200),
    "1e12 seeds": arguments(*DRY, "--seeds", "1000000000000", "smoke/straight"),
    "4 MB of '- a'": yaml("- a\n" * 1_000_000),
    "bundle header deep": raw_header(b'{"a":' + b"[" * 100_000),
    "baseline rows of numbers": gate_files(
        baseline_file=json.dumps(
            {
                "preset": "paper",
                "scenes": {},
                "weights": {},
                "rows": 5,
                "made_with": {},
                "schema_version": 1,
            }
        )
    ),
    "baseline scenes a list": gate_files(
        baseline_file=json.dumps(
            {
                "preset": "paper",
                "scenes": [1],
                "weights": {},
                "rows": [],
                "made_with": {},
                "schema_version": 1,
            }
        )
    ),
    "baseline deep": gate_files(baseline_file="[" * 100_000),
    "gate margins 1e999": gate_files(
        gate="version: 1\nmetrics: {collision_any: {margin: 1.0e+999}}\n"
    ),
    "gate a list": gate_files(gate="- 1\n- 2\n"),
    "run.json []": run_file("run.json", "[]", "report"),
    "run.json scenes 5": run_file("run.json", '{"scenes": 5}', "report"),
    "run.json deep": run_file("run.json", "[" * 100_000, "report"),
    "summary metrics []": run_file("summary.json", "metrics=[]", "report"),
    "summary metrics 5, compared": run_file("summary.json", "metrics=5", "compare"),
    "run.json scenes 5, gated": run_file("run.json", '{"scenes": 5}', "gate"),
    "fork at nan": run_file(
        "run.json",
        '{"scenes": {}, "config": {}}',
        "fork",
        ("--cell", "clean/lane-camera/plain/0", "--at", "nan"),
    ),
    "fork, run.json scenes 5": run_file(
        "run.json", '{"scenes": 5}', "fork", ("--cell", "clean/lane-camera/plain/0", "--at", "1")
    ),
    "CommonRoad time -1e308": commonroad_time("-1e308"),
    "compressed PLY of floats": background("a.ply", compressed_ply()),
    "spz of 1e8 points": background("a.spz", spz_of(100_000_000)),
    "path of 5,000 characters": arguments(*DRY, "a" * 5000),
    "path with a null character": arguments(*DRY, "a\0b"),
    "log of zeros": log_of(b"\0" * 64),
    "log cut in its first entry": log_of(b"\x00\x00\x00\x10\x0a\x0e"),
    "pipe as scenario": pipe("scene.yaml", *DRY),
    "pipe as CommonRoad": pipe("scene.xml", *DRY),
    "pipe as AlpaSim scene": pipe("scene.usdz", *DRY),
    "device as log": arguments("score", "/dev/zero", "--scene", "smoke/straight"),
    "error of 7 MB": yaml("version: 1\n" + "\n".join(f"key_{i}: 1" for i in range(100_000))),
}


def _limit() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (LIMIT_BYTES, LIMIT_BYTES))


def outcome(make: Make) -> tuple[str, float]:
    """Run one case in a process of its own; return what came of it and the seconds it took."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        args = make(folder)
        began = time.perf_counter()
        try:
            process = subprocess.Popen(
                [sys.executable, "-m", "alpasim_plugin.cli.main", *args],
                cwd=folder,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                preexec_fn=_limit,
                start_new_session=True,
                text=True,
            )
        except ValueError as error:
            return f"not a command line ({error})", 0.0
        try:
            text, _ = process.communicate(timeout=LIMIT_S)
        except subprocess.TimeoutExpired:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            return f"> {LIMIT_S:.0f} s", LIMIT_S
        took = time.perf_counter() - began
    if "Traceback (most recent call last)" in text:
        return f"traceback: {text.strip().splitlines()[-1][:60]}", took
    longest = max((len(line) for line in text.splitlines()), default=0)
    note = f", a line of {longest} characters" if longest > 400 else ""
    kind = {0: "accepted", 2: "refused"}.get(process.returncode, f"code {process.returncode}")
    return f"{kind}{note}", took
