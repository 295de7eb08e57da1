"""The wall clock, which may jump, is read for dates and for the age of files alone: limits, waits and
shown durations are those of the monotonic clock.
"""

import ast

from tests.source_modules import dotted, foreign_names, modules

WALL_CLOCK = {
    "time.time",
    "time.time_ns",
    "time.localtime",
    "time.gmtime",
    "datetime.datetime.now",
    "datetime.datetime.utcnow",
    "datetime.datetime.today",
    "datetime.date.today",
}
# Module -> why it reads the wall clock.
READERS = {
    "alpasim_plugin.core.files.inputs": "the age of a file, whose times are of this clock",
    "alpasim_plugin.runs.run": "the date of a run",
}


def reads(tree_nodes, names):
    """Yield the calls that read the wall clock, by their names in their libraries."""
    for call in tree_nodes:
        if isinstance(call, ast.Call):
            first, _, following = dotted(call.func).partition(".")
            name = ".".join(filter(None, (names.get(first, first), following)))
            if name in WALL_CLOCK:
                yield name


def test_limits_and_durations_do_not_follow_the_wall_clock():
    readers = {module.name for module in modules() if [*reads(module.nodes, foreign_names(module))]}
    assert readers == set(READERS)


def test_each_way_to_read_the_wall_clock_is_noticed():
    text = (
        "import time\nfrom datetime import datetime\ntime.time()\ndatetime.now()\ntime.monotonic()"
    )
    tree = ast.parse(text)
    names = {"time": "time", "datetime": "datetime.datetime"}
    assert [*reads(ast.walk(tree), names)] == ["time.time", "datetime.datetime.now"]
