"""The numbers of scenes on the page of statistics follow from the rule in the code."""

import re

from evaluators.metrics.table import METRICS
from evaluators.statistics.paired import least_scenes


def test_how_many_scenes_a_margin_takes(repo):
    page = (repo / "docs" / "statistics.md").read_text()
    section = page.partition("| margin | scenes |")[2].partition("\n\n")[0]
    rows = re.findall(r"^\| ([\d.]+) (points|m) .* \| (\d+) \|$", section, re.M)
    assert len(rows) == 5
    for margin, unit, scenes in rows:
        names = ["offroad", "progress"] if unit == "points" else ["lateral_distance_m"]
        share = float(margin) / 100 if unit == "points" else float(margin)
        assert [least_scenes(METRICS[name], share) for name in names] == [int(scenes)] * len(names)
