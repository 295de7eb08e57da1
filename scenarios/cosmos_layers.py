"""Map layers of a Cosmos-Drive-Dreams clip: labels in tars of JSON, as arrays and attributes."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from alpasim_plugin.core.types import F64, Box, Paint
from scenarios.reading import SourceFiles


@dataclass(frozen=True)
class Label:
    """One map feature: its attributes and its polylines, surface or cuboid."""

    where: str  # file and feature, for messages
    attributes: dict[str, Any]
    lines: tuple[F64, ...]  # each (N, 3) metres, world; one for a polyline or surface, the eight corners for a cuboid

    @property
    def feature_id(self) -> str:
        """Return the id other features refer to."""
        return str(self.attributes.get("feature_id"))

    def ids(self, name: str) -> tuple[str, ...]:
        """Return a list attribute of ids; empty where the map gives none."""
        value = self.attributes.get(name)
        return tuple(str(v) for v in value if str(v) != "-1") if isinstance(value, list) else ()

    def one_id(self, name: str) -> str | None:
        """Return a single id; the text -1 means none."""
        value = self.attributes.get(name)
        return None if value is None or isinstance(value, list) or str(value) == "-1" else str(value)


def read_layer(files: SourceFiles, folder: Path, layer: str) -> tuple[Label, ...]:
    """Read one layer folder, such as ``3d_lanes``; labels marked empty are left out.

    Raises:
        InputError: The folder, its tar or its JSON is missing or damaged, or a feature has no finite geometry.
    """
    path = files.only(folder / layer, ("*.tar",), f"layer {layer}")
    members = {name: data for name, data in files.read_tar(path).items() if name.endswith(".json")}
    if len(members) != 1:
        raise files.fail(path, f"{len(members)} JSON members", "give a tar with one JSON member")
    name, data = next(iter(members.items()))
    document = files.parse_json(data, f"{path}, {name}")
    labels = document.get("labels") if isinstance(document, dict) else None
    if not isinstance(labels, list):
        raise files.fail(f"{path}, {name}", "no list 'labels'", "use a file of the RDS-HQ layout")
    out: list[Label] = []
    for number, raw in enumerate(labels):
        where = f"{path}, label {number}"
        if isinstance(raw, dict) and raw.get("labelFamily") == "EMPTY":
            continue
        try:
            shape = raw["labelData"]["shape3d"]
            attributes = {a["name"]: _value(a) for a in shape.get("attributes", ())}
            lines = tuple(np.array(v, dtype=np.float64).reshape(-1, 3) for v in _vertices(shape))
        except (KeyError, TypeError, ValueError) as error:
            raise files.fail(where, f"no readable shape: {error!r}", "use a file of the RDS-HQ layout") from error
        if not lines or any(len(line) == 0 or not np.isfinite(line).all() for line in lines):
            raise files.fail(where, "a shape without finite vertices", "repair or drop this label")
        for line in lines:
            files.near(where, line)
        out.append(Label(where, attributes, lines))
    return tuple(out)


def _value(attribute: dict[str, Any]) -> Any:
    """Unpack an attribute: ``{"name": ..., KIND: value}``, where lists come one level deeper and may be absent when empty."""
    values = [v for k, v in attribute.items() if k != "name"]
    if not values:
        return None
    value = values[0]
    return next(iter(value.values()), []) if isinstance(value, dict) else value


def _vertices(shape: dict[str, Any]) -> list[Any]:
    if "polylines3d" in shape:
        return [line["vertices"] for line in shape["polylines3d"]["polylines"]]
    for kind in ("polyline3d", "surface", "cuboid3d"):
        if kind in shape:
            return [shape[kind]["vertices"]]
    raise KeyError("polylines3d, polyline3d, surface or cuboid3d")


def paint_of(styles: Any, colours: Any) -> Paint:
    """Return the paint of a line from its styles and colours a vertex; the most frequent pair decides.

    Kerbs, barriers, virtual lines and road boundaries carry no paint.
    """
    if not isinstance(styles, list) or not styles:
        return "unknown"
    given = colours if isinstance(colours, list) and len(colours) == len(styles) else ["UNKNOWN"] * len(styles)
    style, colour = Counter(zip(styles, given, strict=True)).most_common(1)[0][0]
    yellow = colour == "YELLOW"
    if style in ("VIRTUAL", "BARRIER", "ROAD_BOUNDARY") or "CURB" in style:
        return "none"
    if colour not in ("YELLOW", "WHITE"):
        return "unknown"
    if "GROUP" in style:
        return "double_yellow" if yellow else "solid_white" if "SOLID" in style else "dashed_white"
    if "DASHED" in style:
        return "dashed_yellow" if yellow else "dashed_white"
    if "SOLID" in style:
        return "solid_yellow" if yellow else "solid_white"
    return "unknown"


def sign_pose(corners: F64) -> tuple[F64, Box]:
    """Return ``(T_world_sign (4, 4), size)`` of a cuboid ``(8, 3)``: x along its thinnest side, z as upright as it goes.

    Corners 0 to 3 go round one face and corner 4 lies opposite corner 0.
    """
    sides = corners[[1, 3, 4]] - corners[0]  # (3, 3) rows
    lengths = np.linalg.norm(sides, axis=1)
    axes = sides / np.maximum(lengths, 1e-9)[:, None]
    up = int(np.argmax(np.abs(axes[:, 2])))
    thin, wide = sorted((i for i in range(3) if i != up), key=lambda i: lengths[i])
    z = axes[up] * np.copysign(1.0, axes[up, 2])
    x = axes[thin] - z * (axes[thin] @ z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = x, np.cross(z, x), z, corners.mean(axis=0)
    return pose, Box(float(lengths[thin]), float(lengths[wide]), float(lengths[up]))
