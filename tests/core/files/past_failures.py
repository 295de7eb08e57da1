"""Inputs that once gave way: each writes a scenario and returns its path."""

import json
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

from tests.scenarios import make_argoverse, make_commonroad, make_usdz

ROAD = "version: 1\nroad: {lanes_forward: 1, segments: [{kind: straight, length_m: %s}]}\nego: {cruise_mps: 10}\n"
Make = Callable[[Path], Path]


def yaml(text):
    def make(folder):
        path = folder / "scene.yaml"
        path.write_text(text)
        return path

    return make


def road_of(length):
    return yaml(ROAD % length)


def actors(text):
    return yaml(ROAD % 400 + f"actors: [{text}]\n")


def surroundings(text):
    return yaml(ROAD % 200 + f"environment: {{{text}}}\n")


def parked(n):
    row = "{kind: parked, id: p%d, s_m: %.1f, count: 40, spacing_m: 7, label: car}"
    return actors(", ".join(row % (i, 10 + 0.01 * i) for i in range(n // 40)))


def xodr(length="400", geometry="<line/>", s="0"):
    def make(folder):
        lane = '<lane id="-1" type="driving"><width sOffset="0" a="3.6" b="0" c="0" d="0"/></lane>'
        back = lane.replace('id="-1"', 'id="1"')
        view = f'<geometry s="{s}" x="-20" y="1.8" hdg="0" length="{length}">{geometry}</geometry>'
        section = f'<laneSection s="0"><left>{back}</left><right>{lane}</right></laneSection>'
        road = f'<road id="1" length="{length}" junction="-1"><planView>{view}</planView><lanes>{section}</lanes></road>'
        content = {k: v for k, v in make_usdz.members().items() if not k.startswith("clipgt/")}
        content["map.xodr"] = f"<OpenDRIVE>{road}</OpenDRIVE>".encode()
        return make_usdz.write(folder / "scene.usdz", content)

    return make


def tracks(**change):
    def make(folder):
        content = make_usdz.members()
        sequence = make_usdz.sequence()
        for key, value in change.items():
            part = sequence["s"]["cuboidtracks_data" if key == "cuboids_dims" else "tracks_data"]
            part[key] = value
        content["sequence_tracks.json"] = json.dumps(sequence).encode()
        return make_usdz.write(folder / "scene.usdz", content)

    return make


def cuboid_width(width):
    def make(folder):
        rows = make_argoverse.cuboids(make_argoverse.TRACKS)
        rows["width_m"] = [width] * len(rows["width_m"])
        return make_argoverse.write_argoverse(folder / "log", annotations=rows)

    return make


def commonroad_time(time_step):
    def make(folder):
        states = make_commonroad.drive(20, 0)
        states[0] = states[0].replace(
            "<exact>0</exact></time>", f"<exact>{time_step}</exact></time>"
        )
        return make_commonroad.write_commonroad(
            folder / "scene.xml", traffic=make_commonroad.obstacle(11, states)
        )

    return make


def png_header(width, height):
    def chunk(kind, data):
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    rows = zlib.compress(b"\0" * min((3 * width + 1) * height, 1 << 20), 9)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def pipe(name):
    def make(folder):
        os.mkfifo(folder / name)
        return folder / name

    return make


SEEN = {
    "road of 1e6 m": road_of("1.0e+6"),
    "road of 1e15 m": road_of("1.0e+15"),
    "road of 1e308 m": road_of("1.0e+308"),
    "OpenDRIVE s = 1e5": xodr(s="1e5"),
    "OpenDRIVE curvature 1e9": xodr(geometry='<arc curvature="1e9"/>'),
    "AV2 width 1e300": cuboid_width(1e300),
    "usdz size NaN": tracks(cuboids_dims=[[float("nan"), 2.5, 3.0], [0.6, 0.6, 1.8]]),
    "usdz size 1e9": tracks(cuboids_dims=[[1e9, 2.5, 3.0], [0.6, 0.6, 1.8]]),
    "size_m 1e6": actors("{kind: parked, id: a, s_m: 60, size_m: [1.0e+6, 2, 2]}"),
    "1e9 trees": surroundings("trees_per_100m: 1.0e+9"),
    "poles every 1e-9 m": surroundings("poles_spacing_m: 1.0e-9"),
    "20,000 parked cars": parked(20_000),
    "4 MB of '- a'": yaml("- a\n" * 1_000_000),
    "CommonRoad time -1e308": commonroad_time("-1e308"),
    "path of 5,000 characters": lambda folder: Path("a" * 5000),
    "pipe as scenario": pipe("scene.yaml"),
    "pipe as CommonRoad": pipe("scene.xml"),
    "pipe as AlpaSim scene": pipe("scene.usdz"),
    "error of 7 MB": yaml("version: 1\n" + "\n".join(f"key_{i}: 1" for i in range(100_000))),
}
