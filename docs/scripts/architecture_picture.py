"""Draw docs/img/architecture.svg: the rooms of the source, with who imports whom, as the test of
layers has them.

Usage: python docs/scripts/architecture_picture.py [--check]
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np
from pages import DOCS, write

sys.path.insert(0, str(DOCS.parent))
from tests import test_layers as layers

PICTURE = DOCS / "img" / "architecture.svg"
PREFIX = "alpasim_plugin."
NOTES = {
    "world": "road users, ground, routes",
    "cameras": "lenses, shutters",
    "gaussians": "clouds, rasteriser, fits",
    "streets": "what a scene is built of",
    "scenarios": "from a file to a scenario",
    "renderers": "clean, 3dgs, weather",
    "drives": "recorded drives",
    "fixers": "repair frames",
    "policies": "the shipped drivers",
    "control": "vehicle, controllers, CAN",
    "log": "rollout.asl, run folder",
    "alpasim.client": "remote renderers, drivers",
    "evaluators": "metrics, statistics, pages",
}
BOX_WIDTH, BOX_HEIGHT = 190, 46
GAP_X, GAP_Y = 14, 58
MARGIN = 20
STYLE = """
  .ground { fill: #ffffff } .box { fill: #eef3fb; stroke: #5b7db1 } .bar { fill: #f4f0e6; stroke: #a08a4f }
  .name { fill: #14213d; font: 600 14px sans-serif } .note { fill: #44546f; font: 12px sans-serif }
  .edge { stroke: #7b8794; fill: none }
  @media (prefers-color-scheme: dark) {
    .ground { fill: #1e2129 } .box { fill: #26344d; stroke: #7da2dd } .bar { fill: #3a3524; stroke: #c9b26b }
    .name { fill: #f2f5fa } .note { fill: #c3cede } .edge { stroke: #8f9bab }
  }
"""


@dataclass(frozen=True)
class Box:
    """A room in the picture, pixels."""

    x: float
    y: float
    width: float = BOX_WIDTH

    @property
    def middle(self) -> float:
        """Return where its arrows begin and end, across."""
        return self.x + self.width / 2


def room(name: str) -> str:
    """Return the room of the picture that a folder belongs to."""
    name = name.removeprefix(PREFIX)
    return name if name in NOTES else name.split(".")[0]


def imports() -> dict[str, set[str]]:
    """Return the rooms that each room imports, without the base that all import, in the order in
    which data flows.
    """
    imported: dict[str, set[str]] = {}
    for name, may_import in layers.STAGES.items():
        rooms = imported.setdefault(room(name), set())
        rooms |= {room(other) for other in may_import} - {room(name)}
    return imported


def depths(imported: Mapping[str, set[str]]) -> dict[str, int]:
    """Return how many rooms lie below each one, along the longest way."""
    depth: dict[str, int] = {}
    for name, below in imported.items():
        depth[name] = 1 + max((depth[other] for other in below), default=-1)
    return depth


def direct(imported: Mapping[str, set[str]]) -> Iterable[tuple[str, str]]:
    """Yield the imports that do not follow from others, as (importing, imported)."""
    reach: dict[str, set[str]] = {}
    for name, below in imported.items():
        reach[name] = below.union(*(reach[other] for other in below))
        for other in sorted(below):
            if not any(other in reach[between] for between in below):
                yield name, other


def in_rows(imported: Mapping[str, set[str]]) -> list[list[str]]:
    """Return the rooms of equal depth, the deepest row first. Within a row a room stands where the
    rooms that it imports stand on average, so that few arrows cross.
    """
    depth = depths(imported)
    lowest = [name for name in depth if depth[name] == 0]
    place = {name: (rank + 0.5) / len(lowest) for rank, name in enumerate(lowest)}
    rows = [lowest]
    for level in range(1, max(depth.values()) + 1):
        names = [name for name in depth if depth[name] == level]
        names.sort(key=lambda name: np.mean([place[other] for other in imported[name]]))
        place |= {name: (rank + 0.5) / len(names) for rank, name in enumerate(names)}
        rows.append(names)
    return rows


def placed(rows: Sequence[Sequence[str]], top: float) -> tuple[dict[str, Box], float, float]:
    """Return the boxes, the first row lowest; their width and the end of the lowest row."""
    most = max(len(row) for row in rows)
    width = most * BOX_WIDTH + (most - 1) * GAP_X
    boxes = {}
    for row, names in enumerate(reversed(rows)):
        taken = len(names) * BOX_WIDTH + (len(names) - 1) * GAP_X
        left = MARGIN + (width - taken) / 2
        for column, name in enumerate(names):
            x = left + column * (BOX_WIDTH + GAP_X)
            boxes[name] = Box(x, top + row * (BOX_HEIGHT + GAP_Y))
    return boxes, width, top + len(rows) * (BOX_HEIGHT + GAP_Y)


def labelled(box: Box, kind: str, name: str, note: str) -> str:
    """Return a box with its two lines."""
    return (
        f'<rect class="{kind}" x="{box.x:g}" y="{box.y:g}" width="{box.width:g}" height="{BOX_HEIGHT}" rx="6"/>'
        f'<text class="name" x="{box.middle:g}" y="{box.y + 20:g}" text-anchor="middle">{escape(name)}</text>'
        f'<text class="note" x="{box.middle:g}" y="{box.y + 37:g}" text-anchor="middle">{escape(note)}</text>'
    )


def arrow(importing: Box, imported: Box) -> str:
    """Return the line from a room to one that it imports."""
    begin, end = importing.y + BOX_HEIGHT, imported.y - 4
    bend = (end - begin) / 2
    return (
        f'<path class="edge" marker-end="url(#head)" d="M{importing.middle:g} {begin:g} '
        f'C{importing.middle:g} {begin + bend:g} {imported.middle:g} {end - bend:g} {imported.middle:g} {end:g}"/>'
    )


def picture() -> str:
    """Return the picture as SVG."""
    imported = imports()
    bars_above = [
        (
            ", ".join(room(name) for name in layers.PLUG_INS),
            "plug-ins: register themselves, and no room imports them",
        ),
        (
            ", ".join(room(name) for name in reversed(layers.AFTER_THE_STAGES)),
            "compose the stages; may import everything below",
        ),
    ]
    top = MARGIN + len(bars_above) * (BOX_HEIGHT + GAP_X) + GAP_X
    boxes, width, bottom = placed(in_rows(imported), top)
    bars = [
        labelled(Box(MARGIN, MARGIN + row * (BOX_HEIGHT + GAP_X), width), "bar", name, note)
        for row, (name, note) in enumerate(bars_above)
    ]
    base = ", ".join(name.removeprefix(PREFIX) for name in layers.BASE)
    bars.append(
        labelled(
            Box(MARGIN, bottom - GAP_X, width),
            "bar",
            base,
            "types, errors, files, parts; every room may import them",
        )
    )
    height = bottom - GAP_X + BOX_HEIGHT + MARGIN
    arrows = [arrow(boxes[name], boxes[other]) for name, other in direct(imported)]
    rooms = [labelled(box, "box", name, NOTES[name]) for name, box in boxes.items()]
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width + 2 * MARGIN:g} {height:g}" role="img" '
            'aria-label="Rooms of the source and who imports whom">',
            f"<style>{STYLE}</style>",
            '<defs><marker id="head" viewBox="0 0 8 8" refX="6" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
            '<path class="edge" d="M1 1 L7 4 L1 7"/></marker></defs>',
            f'<rect class="ground" width="{width + 2 * MARGIN:g}" height="{height:g}" rx="8"/>',
            *arrows,
            *bars,
            *rooms,
            "</svg>\n",
        ]
    )


def written() -> dict[Path, str]:
    """Return the picture as it should be."""
    return {PICTURE: picture()}


if __name__ == "__main__":
    PICTURE.touch()
    write(written())
