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


def test_how_often_students_interval_holds_the_mean_is_what_the_calibration_found(repo):
    page = (repo / "docs" / "statistics.md").read_text()
    (said,) = re.findall(
        r"holds the mean in (\d+), (\d+) and (\d+) % of runs with 3, 12 and 20", page
    )
    calibration = (repo / "docs" / "experiments" / "calibration.md").read_text()
    (row,) = re.findall(r"^\| the distance to obstacles, 5 % 20 m \|(.*)$", calibration, re.M)
    student = [float(cell.partition("/")[0]) for cell in row.split("|")[:3]]
    assert [int(number) for number in said] == [round(share) for share in student]
