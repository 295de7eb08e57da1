"""Scores of finished rollouts are made again when the evaluators have changed, and only then;
nothing is driven again.
"""

from alpasim_plugin.runs.run import execute_run
from tests.runs.short_runs import Announced


def run(of, root):
    announced = Announced()
    execute_run(of, root, 1, ["simrun"], announced, report=False)
    return announced.results
