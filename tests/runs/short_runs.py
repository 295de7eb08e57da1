"""Short runs, what they announce, and what of their folders two runs have in common."""

import json

import pyarrow.parquet as pq

from alpasim_plugin.runs.plan import RunOptions, make_plan
from scenarios.suite import expand

SHORT = ("timing.duration_us=1200000", "degradation.kind=none")


class Announced:
    """Remembers what a run announced."""

    def __init__(self):
        self.results = []
        self.notices = []

    def started(self, plan, root, threads):
        self.threads = threads

    def rollout_done(self, manifest, reused):
        self.results.append((manifest.status, reused))

    def noticed(self, text):
        self.notices.append(text)


def plan_of(policies=("lane-camera",), scenes=("smoke/straight",)):
    refs = [ref for name in scenes for ref in expand(name, SHORT)]
    return make_plan(refs, ("clean", "3dgs"), policies, (0,), RunOptions())


def comparable(root):
    """Return everything of a run that must not depend on how it was run."""
    rows = pq.read_table(root / "rollouts.parquet").drop_columns(["wall_s"]).to_pylist()
    logs = {str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("rollout.asl"))}
    steps = pq.read_table(root / "steps.parquet").to_pylist()
    summary = {
        k: v
        for k, v in json.loads((root / "summary.json").read_text()).items()
        if k not in ("speed", "pool")
    }
    return {"rows": repr(rows), "logs": logs, "steps": repr(steps), "summary": summary}
