"""How the semantic map is drawn: colours, widths in pixels, dash patterns, fade.

The colours and sizes are those of the conditioning videos of NVIDIA's world-scenario renderers:
cosmos-transfer2.5 (an OpenGL program that documents the rules, `OPENGL`) and FlashDreams (a CUDA
one that feeds OmniDreams at run time, `LUDUS`). Widths are defined at 1280 pixels of image width.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

Rgb = tuple[int, int, int]
LineColour = Literal["untyped", "white", "yellow", "other"]
Pattern = Literal[
    "solid", "long_dashed", "short_dashed", "dotted", "dotted_1_9", "dot_dashed", "other"
]
LightState = Literal["unknown", "red", "yellow", "green"]
AreaKind = Literal["road_marking", "intersection", "road_island", "buffer_zone"]

WIDTH_DEFINED_AT_PX = 1280.0

COLOURS: Mapping[str, Rgb] = {
    "road_boundary": (253, 1, 232),
    "line_untyped": (98, 183, 249),
    "line_white": (255, 255, 255),
    "line_yellow": (255, 255, 0),
    "line_other": (181, 164, 71),
    "stop_line": (108, 179, 59),
    "pole": (183, 69, 177),
    "crosswalk": (139, 93, 255),
    "road_marking": (20, 254, 185),
    "intersection": (80, 80, 120),
    "road_island": (60, 120, 60),
    "buffer_zone": (120, 80, 80),
    "sign": (8, 2, 255),
    "light_unknown": (100, 100, 100),
    "light_red": (240, 50, 50),
    "light_yellow": (255, 200, 0),
    "light_green": (130, 240, 132),
    "box_edge": (200, 200, 200),
}

# Front and back colour of a box along its heading.
BOX_COLOURS: Mapping[str, tuple[Rgb, Rgb]] = {
    "car": ((0, 46, 136), (126, 206, 255)),
    "truck": ((204, 55, 0), (255, 192, 64)),
    "pedestrian": ((148, 0, 62), (255, 124, 171)),
    "cyclist": ((0, 80, 66), (102, 208, 198)),
    "other": ((53, 26, 20), (166, 136, 125)),
}

_LABELS: Mapping[str, tuple[str, ...]] = {
    "car": ("automobile", "car", "vehicle", "other_vehicle"),
    "truck": (
        "truck",
        "heavy_truck",
        "bus",
        "trolley_bus",
        "train_or_tram_car",
        "trailer",
        "large_vehicle",
    ),
    "pedestrian": ("person", "pedestrian"),
    "cyclist": ("rider", "cyclist", "bicycle", "motorcycle"),
}
_CLASS_OF = {label: kind for kind, labels in _LABELS.items() for label in labels}

# Lengths painted and left bare, metres, repeated from the first point of a line.
_OPENGL_PATTERNS: Mapping[Pattern, tuple[tuple[float, float], ...]] = {
    "solid": (),
    "other": (),  # a line of no known pattern: solid and wide
    "long_dashed": ((3.0, 9.0),),
    "short_dashed": ((1.5, 1.5),),
    "dotted": ((0.3, 0.6),),
    "dotted_1_9": ((0.05, 0.45),),
    "dot_dashed": ((0.05, 0.10),) * 5
    + ((0.05, 2.85),),  # a dash of 0.91 m drawn one piece in three, then 2.74 m bare
}
_LUDUS_PATTERNS: Mapping[Pattern, tuple[tuple[float, float], ...]] = {
    **_OPENGL_PATTERNS,
    "short_dashed": ((1.0, 1.0),),
    "dotted": ((0.05, 0.70),),  # discs: pieces shorter than their caps
    "dot_dashed": ((0.05, 1.45),),
}


@dataclass(frozen=True)
class MapStyle:
    """Numeric drawing rules."""

    name: str = "opengl"
    line_px: float = 12.0  # lane lines, boundaries, stop lines
    pole_px: float = 5.0
    box_edge_px: float = 4.0
    other_factor: float = 3.0  # lane lines of pattern "other" are this much wider
    # widths are measured in normalised coordinates: a horizontal line is H / W times as thick as a
    # vertical one
    ndc_widths: bool = True
    line_width_gain: float = 1.0  # line width is scaled by clamp(gain * (1 - depth / depth_max))
    depth_max_m: float = 200.0  # colours and widths fade to nothing here
    near_m: float = 0.1  # everything nearer along the optical axis is cut off
    patterns: Mapping[Pattern, tuple[tuple[float, float], ...]] = field(
        default_factory=lambda: _OPENGL_PATTERNS
    )
    double_offset_m: float = 0.1  # each line of a pair lies this far from the middle
    typed_lines: bool = True  # False: every lane line solid and of the untyped colour
    # edges of boxes are moved this far towards the camera, so that faces do not swallow them
    edge_bias_m: float = 0.1
    samples: Literal[1, 4] = 4  # per pixel
    colours: Mapping[str, Rgb] = field(default_factory=lambda: COLOURS)
    box_colours: Mapping[str, tuple[Rgb, Rgb]] = field(default_factory=lambda: BOX_COLOURS)


OPENGL = MapStyle()
LUDUS = MapStyle(
    "ludus", 7.0, 5.0, 2.0, 1.0, False, 2.0, patterns=_LUDUS_PATTERNS, double_offset_m=0.075
)
STYLES: Mapping[str, MapStyle] = {style.name: style for style in (OPENGL, LUDUS)}


def box_class(label: str) -> str:
    """Return the colour class of an actor's label; "other" for unknown labels.

    Example:
        >>> box_class("bus"), box_class("motorcycle"), box_class("dog")
        ('truck', 'cyclist', 'other')
    """
    return _CLASS_OF.get(label.lower(), "other")
