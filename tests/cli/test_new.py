"""``simrun new``: what it writes works, and its test passes."""

import importlib.util
import json
import shlex

import pytest

from alpasim_plugin.cli.main import run_command
from tests.docs.parsed_commands import parse


def run_tests_of(file):
    """Import a test file and call its tests; return how many there are."""
    spec = importlib.util.spec_from_file_location(file.stem, file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    tests = [value for name, value in vars(module).items() if name.startswith("test_")]
    for test in tests:
        test()
    return len(tests)


@pytest.mark.parametrize("kind", ["policy", "scenario", "renderer", "fixer", "metric"])
def test_a_template_works_as_it_is_written(kind, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run_command(["new", kind, "my_own", "--json"]) == 0
    made = json.loads(capsys.readouterr().out)
    main, test = (tmp_path / name for name in made["files"])
    assert main.is_file()
    assert "$" not in main.read_text() + test.read_text()
    assert run_tests_of(test) == 1
    parse(shlex.split(made["try"])[1:])
    if main.suffix == ".py":
        compile(main.read_text(), str(main), "exec")
    assert run_command(["new", kind, "my_own"]) == 2
    assert "it exists already" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["MyPolicy", "my-policy", "class", "../up"])
def test_a_name_that_is_no_file_of_python_is_refused(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run_command(["new", "policy", name]) == 2
    assert "not a name of a Python file" in capsys.readouterr().err


def test_an_empty_name_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run_command(["new", "policy", ""]) == 2
    assert "is empty" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("kind", "name"),
    [("policy", "plan"), ("renderer", "frame"), ("policy", "simrun"), ("metric", "numpy")],
)
def test_a_name_that_hides_an_import_is_refused(kind, name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run_command(["new", kind, name]) == 2
    assert f"choose another name: my_{name}" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
