"""The map that a fixer sees and the road that is built show the same paint, whatever the map
knows.
"""

from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from alpasim_plugin.core.geometry import arc_lengths, resample
from alpasim_plugin.streets.markings import marking_strokes
from alpasim_plugin.streets.site import make_site
from alpasim_plugin.world.ground import height_at
from alpasim_plugin.world.markings import marking_lines
from scenarios.load import load_scenario

COMMONROAD = Path(str(resources.files("scenarios"))) / "data" / "USA_US101-3_3_T-1.xml"


@pytest.mark.parametrize("name", ["smoke/curve", "smoke/straight", str(COMMONROAD)])
def test_every_stroke_of_paint_lies_on_a_line_of_the_map(name):
    scenario = load_scenario(name)
    site = make_site(scenario, lambda xy: height_at(scenario.ground, xy))
    strokes = marking_strokes(site)
    on_walks = len(scenario.lane_map.crosswalks) or len(scenario.lane_map.stop_lines)
    lines = [site.frame.to_ground(xyz) for xyz, _ in marking_lines(scenario.lane_map)]
    dense = np.concatenate(
        [resample(line, np.arange(0, arc_lengths(line)[-1], 0.2)) for line in lines]
    )
    middle = (strokes.start + strokes.end) / 2
    distance = np.array([np.linalg.norm(dense - point, axis=1).min() for point in middle])
    assert on_walks or distance.max() < 0.35
    assert len(strokes.start) > 0
