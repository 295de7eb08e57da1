"""One bound per quantity: its name, unit, range, and why. Schemas, readers and the command line
take their limits from here.

What a scene may cost as a whole
is in `scenarios.budget`.
"""

import math
from dataclasses import dataclass

from alpasim_plugin.core.errors import InputError


@dataclass(frozen=True)
class Bound:
    """The range of one quantity, both ends allowed."""

    name: str
    unit: str
    low: float
    high: float
    reason: str

    def holds(self, value: float) -> bool:
        """Return whether a value is in the range; NaN never is."""
        return self.low <= value <= self.high

    def check(self, value: float, location: object, quantity: str = "") -> None:
        """Refuse a value outside the range.

        Args:
            value: In the bound's unit.
            location: File and place that the value stands in.
            quantity: Its name there; by default the quantity's.

        Raises:
            InputError: It is outside, or NaN.
        """
        if not self.holds(value):
            unit = f" {self.unit}" if self.unit else ""
            raise InputError(
                f"{location}: {quantity or self.name} = {number(value)}{unit}, outside {self.range_text}",
                f"correct it: {self.reason}",
            )

    @property
    def range_text(self) -> str:
        """Return the range with its unit."""
        return f"{number(self.low)} to {number(self.high)}{f' {self.unit}' if self.unit else ''}"


def number(value: float) -> str:
    """Write a number shortly: whole ones with separators, very large ones as powers.

    Example:
        >>> number(10_000.0), number(0.01), number(2**63 - 1), number(1e300)
        ('10,000', '0.01', '9.22e+18', '1e+300')
    """
    if math.isfinite(value) and abs(value) < 1e15 and value == int(value):
        return f"{int(value):,}"
    return f"{value:.3g}"


MIB = 1 << 20
GIB = 1 << 30

# Files
FILE_BYTES = Bound(
    "file size", "bytes", 0, 2 * GIB, "no scene, log or table that this machine could use is larger"
)
SOURCE_BYTES = Bound(
    "size of a source file",
    "bytes",
    0,
    256 * MIB,
    "maps, tracks and tables of recorded scenes are a few MiB",
)
ARCHIVE_BYTES = Bound(
    "size of a scene archive",
    "bytes",
    0,
    64 * GIB,
    "scenes carry checkpoints of several GB, which are not read",
)
JSON_BYTES = Bound(
    "JSON size", "bytes", 0, 64 * MIB, "parsed JSON takes about ten times its size in memory"
)
YAML_BYTES = Bound("YAML size", "bytes", 0, MIB, "a scenario takes a few KiB")
PARSED_VALUES = Bound(
    "values of a document", "", 0, 5_000_000, "each takes some hundred bytes in memory"
)
XML_ELEMENTS = Bound(
    "elements of an XML document", "", 1, 2_000_000, "maps of towns have some 100,000"
)
XML_TAG_BYTES = Bound(
    "size of a tag of an XML document", "bytes", 0, 4 * MIB, "a tag has a few attributes"
)
XML_MARKS = Bound(
    "tags and attributes of an XML document", "", 0, 8_000_000, "maps of towns have a million"
)
DEPTH = Bound(
    "depth of nesting", "levels", 0, 64, "no format here nests deeper than a dozen levels"
)
MEMBERS = Bound("members of an archive", "", 0, 20_000, "scenes hold a few hundred")
DIRECTORY_BYTES = Bound(
    "list of an archive's members", "bytes", 0, 8 * MIB, "some hundred bytes name a member"
)
SCENE_BYTES = Bound(
    "what is read of a scene archive", "bytes", 0, 512 * MIB, "map, drive and tracks take megabytes"
)
SCENE_TABLE_BYTES = Bound(
    "unpacked size of a map table", "bytes", 0, 256 * MIB, "the lanes of a town take megabytes"
)
TABLE_VALUES = Bound(
    "values of a map table, counted once a level of nesting",
    "",
    0,
    20_000_000,
    "the lanes of a town have a million",
)
UNPACKED_BYTES = Bound(
    "unpacked size", "bytes", 0, 2 * GIB, "what is packed may not fill the memory"
)
TABLE_ROWS = Bound(
    "rows of a table", "", 0, 100_000_000, "a thousand rollouts have some millions of steps"
)
TABLE_COLUMNS = Bound("columns of a table", "", 0, 4_096, "each metric has two")
TABLE_BYTES = Bound("unpacked size of a table", "bytes", 0, 4 * GIB, "it must fit into the memory")
TABLE_TEXT_BYTES = Bound(
    "text of a table", "bytes", 0, GIB, "names and messages of a million rollouts take less"
)
LOG_BYTES = Bound("size of a rollout log", "bytes", 0, 64 * GIB, "it is read one entry at a time")
ENTRY_BYTES = Bound(
    "log entry", "bytes", 1, GIB, "a session request with whole maps takes megabytes"
)

WEIGHT_BYTES = Bound(
    "size of network weights",
    "bytes",
    0,
    32 * GIB,
    "a network of 14 billion weights in two bytes each",
)
GAUSSIANS = Bound(
    "Gaussians of a file", "", 0, 20_000_000, "each takes some 250 bytes while it is read"
)

# Images
IMAGE_SIDE_PX = Bound("image side", "px", 8, 8192, "no camera of a car is larger")
STORED_SIDE_PX = Bound("side of a stored image", "px", 1, 16_384, "no camera of a car is larger")
STORED_PIXELS = Bound(
    "pixels of a stored image", "", 1, 1 << 26, "67 megapixels take 200 MB decoded"
)

# Places and sizes
COORDINATE_M = Bound("coordinate", "m", -25_000, 25_000, "no scene reaches farther from its drive")
SEGMENT_M = Bound(
    "length of a road element", "m", 0.1, 10_000, "longer roads are built of several elements"
)
ROAD_M = Bound("length of a road", "m", 0.1, 20_000, "a drive of ten minutes on a highway")
MAP_ROAD_M = Bound(
    "length of a road in a map", "m", 0, 200_000, "no road of a recorded map is longer"
)
CURVATURE_PER_M = Bound("curvature", "1/m", -0.2, 0.2, "a car cannot turn on a radius below 5 m")
MAP_CURVATURE_PER_M = Bound(
    "curvature in a map", "1/m", -20, 20, "corners of junctions turn on five centimetres"
)
LATERAL_OFFSET_M = Bound(
    "distance beside a reference line", "m", -1000, 1000, "no lane lies farther beside its road"
)
BODY_M = Bound("side of a body", "m", 0.01, 200, "trains and buildings beside the road included")
VEHICLE_M = Bound("side of the ego", "m", 0.3, 30, "from a wheelbarrow to a road train")
AXLE_M = Bound("axle distance", "m", -30, 30, "axles lie inside the body")
OFFSET_M = Bound(
    "offset beside a lane", "m", -100, 100, "a larger lateral offset is no lane any more"
)
MOUNT_M = Bound("camera mount", "m", -30, 30, "cameras stand on the vehicle")
DISTANCE_M = Bound("distance", "m", 0, 20_000, "as long as a road")
STATION_M = Bound("place along a road", "m", -20_000, 20_000, "as long as a road")
GAP_M = Bound("gap", "m", 0, 1000, "a driver does not see farther")
SPACING_M = Bound("spacing of a row", "m", 0.1, 1000, "bodies do not overlap")
SPEED_MPS = Bound("speed", "m/s", 0, 100, "360 km/h")
CRUISE_MPS = Bound("desired speed", "m/s", 0.01, 100, "360 km/h")
ACCEL_MPS2 = Bound("acceleration", "m/s2", 0.01, 20, "tyres give about 10")
HEADWAY_S = Bound("time gap", "s", 0.01, 60, "a minute behind is not following")
STEER_RAD = Bound("steering angle", "rad", 0.01, 1.5, "a wheel does not turn across the road")
STEER_RATE_RADPS = Bound("steering rate", "rad/s", 0.01, 20, "a full turn in a tenth of a second")
ANGLE_DEG = Bound("angle", "degrees", -360, 360, "a full turn each way")
LIMIT_MPS = Bound("speed limit", "m/s", 0.1, 100, "360 km/h")

# Surroundings
BUILDING_M = Bound("height of a building", "m", 2, 300, "the tallest facades of a street")
TREES_PER_100M = Bound("trees per 100 m", "", 0, 50, "a tree every two metres is a hedge")
POLES_M = Bound("spacing of poles", "m", 1, 1000, "lamp posts stand tens of metres apart")

# Time
TIME_US = Bound(
    "time in a scenario",
    "us",
    0,
    600_000_000,
    "ten minutes: the expert drives the whole scene when it is loaded",
)
LOG_S = Bound("length of a recording", "s", 0, 7200, "recorded drives are minutes long")
MOMENT_S = Bound("moment", "s", -86_400, 86_400, "a day before or after the log's start")
PERIOD_US = Bound("period", "us", 1_000, 10_000_000, "1 ms to 10 s")
SHUTTER_US = Bound("exposure", "us", 0, 1_000_000, "a second")
TIME_STEP_S = Bound("time step", "s", 1e-4, 10, "recordings have 1 to 100 states a second")

# Counts
STEP = Bound("time step of a recording", "", 0, 1_000_000, "a day at ten a second")
SEED = Bound("seed", "", 0, 2**63 - 1, "int64 in the tables")
SEEDS = Bound("number of seeds", "", 1, 10_000, "each seed is a rollout of every scene")
ROLLOUTS = Bound("rollouts of a run", "", 1, 1_000_000, "each is a row and a folder")
ELEMENTS = Bound("elements of a road", "", 1, 1_000, "each is a stretch of road")
ACTOR_ENTRIES = Bound("entries under actors", "", 0, 1_000, "each is an actor or a row of them")
POINTS = Bound("rows of a track", "", 1, 100_000, "an hour at 25 a second")
CAMERAS = Bound("cameras", "", 1, 32, "no car carries more")
LANE_INDEX = Bound("lane number", "", 0, 20, "no road has more lanes")
LISTED = Bound("entries of a list", "", 0, 10_000, "a person reads them")
YAML_VALUES = Bound("values of a YAML file", "", 0, 200_000, "once aliases are expanded")
