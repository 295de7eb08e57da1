"""What every verb of ``simrun`` has in common, found by walking over all that are registered."""

import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
from rich.table import Table

from alpasim_plugin.cli.output import Progress, show
from alpasim_plugin.core.garbage import OBJECTS
from tests.cli.verb_options import CORE, OWN, options_of

REPO = Path(__file__).resolve().parents[2]
MOST_VERBS = 17
MOST_OPTIONS = 143


@pytest.mark.parametrize("path", sorted(CORE), ids=" ".join)
def test_every_verb_takes_json_and_debug_and_shows_an_example(path):
    assert {"--json", "--debug"} <= set(options_of(CORE[path]))
    assert (
        f"simrun {' '.join(path)}" in (CORE[path].epilog or "")
        or CORE[path].hidden
        or path == ("run",)
    )


def test_the_core_has_few_verbs_and_options():
    assert len(OWN) <= MOST_VERBS
    assert sum(len(options_of(command)) for command in CORE.values()) <= MOST_OPTIONS


@cache
def written(folder, ending):
    """Return the text of all files of a folder, but for this one."""
    return "\n".join(
        path.read_text(encoding="utf-8")
        for path in sorted((REPO / folder).rglob(f"*{ending}"))
        if path != Path(__file__)
    )


@pytest.mark.parametrize(("folder", "ending"), [("tests", ".py"), ("docs", ".md")])
def test_every_option_of_the_core_is_in_a_test_and_on_a_page(folder, ending):
    named = sorted({option for command in CORE.values() for option in options_of(command)})
    absent = [
        option
        for option in named
        if not re.search(rf"{re.escape(option)}(?![\w-])", written(folder, ending))
    ]
    assert absent == []


def test_a_listing_loads_no_numerical_library():
    code = "import sys; from alpasim_plugin.cli.main import run_command; run_command(['--help']); print('numpy' in sys.modules)"
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        .stdout.strip()
        .endswith("False")
    )


def test_a_command_looks_for_cycles_seldom():
    """At Python's own threshold that took a twentieth of the README's main job."""
    code = "import atexit, gc, sys; atexit.register(lambda: print(gc.get_threshold()[0])); sys.argv = ['simrun', '--version']; from alpasim_plugin.cli.main import main; main()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split()[-1] == str(OBJECTS)


def test_a_run_is_planned_and_reported_without_plots_networks_or_kernels():
    """Its workers load what drives; while they are started, nothing else is to load here."""
    code = "import sys, alpasim_plugin.cli.run; print({'matplotlib', 'numba', 'pandas', 'scipy.spatial', 'scipy.stats', 'torch', 'av'} & sys.modules.keys())"
    assert (
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        ).stdout.strip()
        == "set()"
    )


@pytest.mark.slow
def test_a_drive_loads_no_library_of_scipy_of_which_it_would_use_one_function(tmp_path):
    libraries = "{'scipy.interpolate', 'scipy.optimize', 'scipy.spatial', 'scipy.stats'}"
    code = f"import sys; from alpasim_plugin.cli.main import run_command; print(run_command(sys.argv[1:])); print({libraries} & sys.modules.keys())"
    words = ["--renderer", "clean", "--policy", "lane-camera", "--workers", "1", "smoke/curve"]
    done = subprocess.run(
        [sys.executable, "-c", code, *words, "--out", str(tmp_path / "run")],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.splitlines()[-2:] == ["0", "set()"]


def test_the_name_of_a_class_is_no_emoji(capsys):
    Progress().say("check of mine.py:Feet: at 10 m/s")
    table = Table("policy")
    table.add_row("mine.py:Feet: at")
    show(False, {}, table)
    captured = capsys.readouterr()
    assert ":Feet:" in captured.err
    assert ":Feet:" in captured.out
