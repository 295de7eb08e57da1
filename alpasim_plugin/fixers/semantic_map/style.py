"""How the semantic map is drawn: colours, widths in pixels, dashes, fade.

The colours and sizes are those of the conditioning videos of NVIDIA's cosmos-transfer2.5. Widths
are defined at 1280 pixels of image width. They are measured in normalised coordinates: a horizontal
line is H / W times as thick as a vertical one.
"""

from collections.abc import Mapping

Rgb = tuple[int, int, int]

WIDTH_DEFINED_AT_PX = 1280.0
LINE_PX = 12.0  # lane lines, boundaries, stop lines
POLE_PX = 5.0
BOX_EDGE_PX = 4.0
DEPTH_MAX_M = 200.0  # colours and widths fade to nothing here
NEAR_M = 0.1  # everything nearer along the optical axis is cut off
# Repeated from the first point of a line
DASH_M = 3.0
GAP_M = 9.0
DOUBLE_OFFSET_M = 0.1  # each line of a pair lies this far from the middle
# Edges of boxes are moved this far towards the camera, so that faces do not hide them.
EDGE_BIAS_M = 0.1

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

LABELS: Mapping[str, str] = {
    "car": "automobile car vehicle other_vehicle",
    "truck": "truck heavy_truck bus trolley_bus train_or_tram_car trailer large_vehicle",
    "pedestrian": "person pedestrian",
    "cyclist": "rider cyclist bicycle motorcycle",
}
CLASSES = {label: kind for kind, labels in LABELS.items() for label in labels.split()}


def box_class(label: str) -> str:
    """Return the colour class of an actor's label; "other" for unknown labels.

    Example:
        >>> box_class("bus"), box_class("motorcycle"), box_class("dog")
        ('truck', 'cyclist', 'other')
    """
    return CLASSES.get(label.lower(), "other")
