"""Scores of finished rollouts are made again when the evaluators have changed, and only then;
nothing is driven again.
"""

from alpasim_plugin.runs.plan import RunOptions, make_plan
from alpasim_plugin.runs.run import execute_run
from scenarios.suite import expand
from tests.runs.test_runs import Announced


def one_rollout():
    refs = expand("smoke/straight", ("timing.duration_us=1200000",))
    return make_plan(refs, ("clean",), ("constant-velocity",), (0,), RunOptions(images="none"))


def run(of, root):
    announced = Announced()
    execute_run(of, root, 1, ["simrun"], announced, report=False)
    return announced.results
