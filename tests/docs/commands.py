"""The commands that the pages name: found, split into words, and sorted by what it takes to run
them.
"""

import re
import shlex
from dataclasses import dataclass

LAB = "docs/lab"
LAB_VERBS = ("bench", "train")
SHELL = ("bash", "sh", "console", "")
SIMRUN = re.compile(r"^(?:\$ )?(?:\.venv/bin/)?simrun\s+(.*)$")
OTHER = re.compile(r"^(?:\$ )?(?:\.venv/bin/)?(?:python3?(?:\.\d+)?|pip|pytest)\s")
STEP = re.compile(r"^\s*- run: (.*)$", re.M)
TUTORIALS = ("docs/good-renderer.md", "docs/first-gate.md", "docs/recorded-street.md")
# Pages whose commands are run one after another, and where.
WALKED = dict.fromkeys(TUTORIALS, "test_commands.py") | {
    "docs/first-policy.md": "test_first_policy.py"
}
NO_COMMAND = (
    r"──",  # a picture of the order of commands
)
NOT_RUN = (  # the first rule that fits counts
    *((pattern, "not understood yet") for pattern in NO_COMMAND),
    (
        r"runs/versions|exec:env|exec:\?cameras=all env",
        "of the challenge's page; test_challenge_page.py runs it",
    ),
    (r"gate --self-test", "minutes; tests/runs/test_self_test.py runs it"),
    (r"onefixer-2b|--device cuda|doctor --gpu", "needs weights of 4 GB, or a GPU"),
    (
        r"^train |^bench |FILE|fixer\.weights\.bundle| data/scenes/",
        "trains or measures for minutes to days, or needs what that made",
    ),
    (r"path/to/|rollouts/|--scene scenes|runs/RUN", "names a file of the reader's"),
    (
        r"Town03\.xodr|mapping_example\.osm",
        "drives on a map of the reader's; tests/scenarios/test_map_drive.py drives on both",
    ),
    (r"^why\b", "names a rollout of the reader's; tests/runs/test_why.py runs it"),
    (
        r"^serve|127\.0\.0\.1:|can://|scene\.usdz",
        "needs a service or a bus, or goes on until it is stopped: test_service_commands.py",
    ),
    (r"--executor ", "needs a cluster of the reader's; tests/runs/test_ray.py runs it"),
    (r"exec:docker", "needs a container of the reader's"),
    (
        r"gate runs/|compare runs/night|my_policy:Mine",
        "a record of several runs; tests/cli/test_gate_and_compare.py runs each case",
    ),
)
# In one process: workers are started by the pages that are walked, as often as their commands do.
SHORT = ("--set", "timing.duration_us=1200000", "--workers", "1")
LONGER = (
    "--set",
    "timing.duration_us=3000000",
    *SHORT[2:],
)  # for AlpaSim's time line, which drives by the log for 1.7 s
TINY = ("--set", "cameras=[{width: 96, height: 54}]")
NOTHING_FITTED = (
    "--set",
    "degradation.kind=none",
)  # for scenes that say nothing about their reconstruction


@dataclass(frozen=True)
class Command:
    """One command of a page."""

    page: str
    words: tuple[str, ...]  # without ``simrun``

    def __str__(self):
        return f"{self.page}: {' '.join(self.words)}"

    @property
    def is_of_lab(self):
        """Tell whether it is a verb of the laboratory's."""
        return bool(self.words) and self.words[0] in LAB_VERBS

    @property
    def why_not_run(self):
        """Say why it is only parsed; empty if it is run."""
        if self.page in WALKED:
            return f"walked as a whole: {WALKED[self.page]}"
        line = " ".join(self.words)
        return next((why for pattern, why in NOT_RUN if re.search(pattern, line)), "")


def pages(repo):
    """Return README and every page of docs/ but the laboratory's, which are not there where it is
    not (`tests/lab/docs`).
    """
    return [
        repo / "README.md",
        *(page for page in sorted((repo / "docs").rglob("*.md")) if not is_of_lab(repo, page)),
    ]


def lab_pages(repo):
    """Return the laboratory's pages; none where it is not."""
    return sorted((repo / LAB).rglob("*.md"))


def is_of_lab(repo, path):
    """Tell whether a file is one of the laboratory's pages or pictures."""
    return path.is_relative_to(repo / LAB)


def lines_of(page):
    """Return the lines of a page's shell blocks and of the steps of its CI jobs, each whole."""
    text = page.read_text(encoding="utf-8")
    blocks = [
        body
        for language, body in re.findall(r"^```(\w*)\n(.*?)^```", text, re.S | re.M)
        if language in SHELL
    ]
    steps = [
        step
        for body in re.findall(r"^```yaml\n(.*?)^```", text, re.S | re.M)
        for step in STEP.findall(body)
    ]
    return [
        line.strip() for body in blocks for line in body.replace("\\\n", " ").splitlines()
    ] + steps


def commands(repo, of):
    """Return every ``simrun`` command of some pages, in their order."""
    found = []
    for page in of:
        for line in lines_of(page):
            match = SIMRUN.match(line)
            if match:
                words = shlex.split(match[1], comments=True)
                found.append(Command(str(page.relative_to(repo)), tuple(words)))
    return found
