"""The pages about the paper's claims say of every number whether this tree can compute it."""

import re

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.lab.paper.claims import claims
from alpasim_plugin.lab.video_metrics.facts import FACTS
from evaluators.metrics import METRICS

NO_VALUE = "fvmd_lk"  # in the tree, but null for as few clips as that record has


def rows_of(text):
    """Return number, text, verdict and evidence of every row of the table of claims."""
    lines = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|")]
    return [
        (int(cells[0]), cells[1], cells[3], cells[-1])
        for cells in lines
        if len(cells) == 6 and cells[0].isdigit()
    ]


def test_verdicts_without_brackets_rest_on_metrics_of_this_tree(repo):
    rows = rows_of((repo / "docs/experiments/paper-claims.md").read_text(encoding="utf-8"))
    assert [number for number, *_ in rows] == [claim.number for claim in claims().claims]
    for number, _, verdict, evidence in rows:
        metrics = re.findall(r"`([a-z_0-9-]+)`:", evidence)
        computable = all(name in FACTS or name in METRICS for name in metrics)
        assert computable or verdict.startswith("("), number
        assert NO_VALUE not in metrics or verdict.startswith("(") or "trained" in verdict, number


def test_the_page_of_the_command_says_how_many_claims_the_small_budget_tests(
    repo, tmp_path, capsys
):
    out = str(tmp_path / "o")
    assert run_command(["bench", "paper", "--config", "small", "--out", out, "--dry-run"]) == 0
    tested = re.search(r"claims that are tested: (\d+) of 43", capsys.readouterr().out)[1]
    page = (repo / "docs/lab/paper.md").read_text(encoding="utf-8")
    assert f"`small` tests {tested}." in page
