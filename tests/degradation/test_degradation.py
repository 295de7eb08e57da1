"""A few cells of the matrix, which ``python -m tests.degradation`` tries whole."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.degradation.cells import DRIVE, MACHINES, REPO, make_work, outcome
from tests.other_user import as_root, run_as_nobody, shared_folder

CELLS = (
    ("read-only", "compare", 0),
    *(
        pytest.param(*cell, marks=pytest.mark.slow)
        for cell in (
            ("no home", "compare", 0),
            ("read-only", "run", 4),
            ("hostile run", "check", 1),
            ("nothing", "report", 4),
            ("full disk", "run", 4),
        )
    ),
)


@pytest.fixture(scope="module")
def root() -> Iterator[Path]:
    with shared_folder() as folder:
        (folder / "made").mkdir()
        make_work(folder / "made")
        yield folder


@as_root
@pytest.mark.parametrize(("machine", "verb", "code"), CELLS)
def test_a_verb_on_a_machine_that_lacks_something_ends_as_documented(
    root: Path, machine: str, verb: str, code: int
) -> None:
    found = outcome(
        MACHINES[machine], verb, root / "made", root / f"{machine}-{verb}".replace(" ", "-")
    )
    assert found.wrong == "", found.said
    assert found.code == code, found.said


@as_root
@pytest.mark.parametrize(
    "named",
    [
        "closed/deep",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("closed", "closed/deep/scene.yaml", "scene.yaml")
        ),
    ],
)
def test_a_scenario_that_may_not_be_read_is_an_error_with_four_parts(named: str) -> None:
    with shared_folder() as folder:
        text = (REPO / "scenarios" / "smoke" / "straight.yaml").read_text()
        deep = folder / "closed" / "deep"
        deep.mkdir(parents=True)
        for path in (deep / "scene.yaml", folder / "scene.yaml"):
            path.write_text(text)
            path.chmod(0o600)
        (folder / "closed").chmod(0o700)
        script = f"import sys; sys.path.insert(0, {str(REPO)!r}); from alpasim_plugin.cli.main import main; main()"
        done = run_as_nobody(
            [sys.executable, "-P", "-c", script, *DRIVE, "--dry-run", named],
            cwd=folder,
            TMPDIR=str(folder),
        )
        assert done.returncode == 2, done.stderr
        assert [line.split(":")[0].strip() for line in done.stderr.strip().splitlines()] == [
            "error",
            "with",
            "found",
            "do",
        ], done.stderr
        assert "Permission denied" in done.stderr
