"""What newcomers type: other spellings that are understood, and mistakes whose answer names the
value that is wrong.
"""

import pytest

from alpasim_plugin.cli.main import run_command, usual

PARTS = """
import numpy as np
from policies.simple import PurePursuit
from simrun import Frame, SensorSpec

class One(PurePursuit): pass
def made(): return One
class Rear(PurePursuit):
    def __init__(self, scenario):
        self.sensors = (SensorSpec("rear"),)
class Text(PurePursuit):
    sensors = "front"
class NeedsGain(PurePursuit):
    def __init__(self, scenario, gain): ...

class Channels:
    def __init__(self, scenario): ...
    def render(self, request):
        return Frame(request.t_us, request.camera.name, np.zeros((3, 144, 256), np.uint8))
class Floats(Channels):
    def render(self, request):
        return Frame(request.t_us, request.camera.name, np.zeros((144, 256, 3), np.float32))
class Small(Channels):
    def render(self, request):
        return Frame(request.t_us, request.camera.name, np.zeros((9, 16, 3), np.uint8))
class Nothing(Channels):
    def render(self, request): ...
class Raises(Channels):
    def render(self, request):
        return np.argmin([])
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Work in a folder with some files of a newcomer's."""
    (tmp_path / "parts.py").write_text(PARTS)
    (tmp_path / "relative.py").write_text("from .helper import x\nclass One: pass\n")
    (tmp_path / "syntax.py").write_text("class One\n    pass\n")
    (tmp_path / "tabs.yaml").write_text("version: 1\nroad:\n\tsegments: []\n")
    (tmp_path / "empty.yaml").write_text("")
    (tmp_path / "notes.txt").write_text("hello")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("help list", "list --help"),
        ("help", "--help"),
        ("version", "--version"),
        ("-v", "--version"),
        ("-q list presets", "list -q presets"),
        ("--renderer clean, 3dgs smoke/curve", "--renderer clean,3dgs smoke/curve"),
        ("--renderer clean ,3dgs smoke/curve", "--renderer clean,3dgs smoke/curve"),
        ("--set a=[1, 2] smoke/curve", "--set a=[1,2] smoke/curve"),
    ],
)
def test_other_spellings_are_understood(typed, meant):
    assert usual(typed.split()) == meant.split()


@pytest.mark.parametrize(
    "line", ["--out d, smoke/curve", "--out=d, smoke/curve", "smoke/curve, smoke/straight"]
)
def test_a_comma_where_no_list_stands_is_named(line, capsys):
    assert run_command(line.split()) == 2
    assert "a comma between two words" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words", [["--out", ""], ["--out="], ["--renderer", "clean", ""], ["gate", "run", "--gate="]]
)
def test_an_empty_word_is_no_folder_and_no_name(words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run_command([*words, "smoke/straight"]) == 2
    assert "empty" in capsys.readouterr().err
    assert [*tmp_path.iterdir()] == []


@pytest.mark.parametrize(
    "line", ["-v", "version --json", "help", "help why", "list", "--json list presets"]
)
def test_what_asks_for_help_ends_well(line):
    assert run_command(line.split()) == 0


@pytest.mark.parametrize(
    ("line", "named"),
    [
        ("lits", "list"),
        ("-r clean -p lane-camera smoke/curve", "--renderer"),
        ("--renderer clean -p lane-camera smoke/curve", "--policy"),
        ("check-policy parts.py:One smoke/curve", "simrun check policy parts.py:One smoke/curve"),
        ("list-runs", "simrun list runs"),
        ("new my_policy", "simrun new policy my_policy"),
        ("new", "simrun new policy my_policy"),
        ("--renderer clean --policy lane-camera", "smoke/curve"),
        ("drive", "run"),
        ("clean smoke/curve", "--renderer clean"),
        ("smoke/curve lane-camera", "--policy lane-camera"),
        ("--policy parts.py smoke/curve", "parts.py:One"),
        ("--policy parts.py:Onee smoke/curve", "One"),
        ("--policy absent.py:One smoke/curve", "absent.py"),
        ("--policy absent.py smoke/curve", "absent.py"),
        ("--policy relative.py:One smoke/curve", "relative.py:1"),
        ("--policy syntax.py:One smoke/curve", "syntax.py"),
        ("--policy parts.py:NeedsGain --out run smoke/curve", "gain"),
        ("--renderer parts.py smoke/curve", "parts.py:Channels"),
        ("--policy part.py:One smoke/curve", "parts.py"),
        ("--policy parts.py:Nope smoke/curve", "NeedsGain"),
        ("--policy parts.py:made smoke/curve", "One"),
        ("--policy parts.py:Rear --dry-run smoke/curve", "rear"),
        ("--policy parts.py:Rear --out run smoke/curve", "front"),
        ("--policy parts.py:Text --dry-run smoke/curve", "SensorSpec"),
        ("--policy clean smoke/curve", "--renderer clean"),
        ("--renderer parts.py:One smoke/curve", "render"),
        ("--renderer 3dgs+onefixer smoke/curve", "onefixer+3dgs"),
        ("--renderer clean --renderer 3dgs smoke/curve", "--renderer"),
        ("--set roda.x=1 smoke/curve", "--set roda.x=1"),
        ("--set duration_s=3 smoke/curve", "timing.duration_us"),
        ("--set speed_mps=3 smoke/curve", "ego.speed_mps"),
        ("--seeds 5, absent.yaml", "absent.yaml"),
        ("--workers two smoke/curve", "'two', wanted an integer"),
        ("--out notes.txt --renderer clean smoke/curve", "notes.txt"),
        ("--out . --renderer clean smoke/curve", "no run but"),
        ("tabs.yml", "tabs.yaml"),
        ("empty.yaml", "empty.yaml:1"),
        ("--seeds 0..3 smoke/curve", "0..3"),
        ("--workers 0 smoke/curve", "--workers"),
        ("tabs.yaml", "tabs.yaml:3"),
        ("notes.txt", "notes.txt"),
        ("report smoke/curve", "smoke/curve"),
        ("why", "runs/"),
        ("export --mcap a.mcap", "runs/"),
        ("serve --policy lane-camera --scenes absent", "absent"),
        ("serve --policy lane-camera --scenes tabs.yaml", "tabs.yaml:3"),
        ("check renderer parts.py:Channels", "parts.py:18"),
        ("check renderer parts.py:Floats", "parts.py:21"),
        ("check renderer parts.py:Small", "parts.py:24"),
        ("check renderer parts.py:Nothing", "parts.py:27"),
        ("check renderer parts.py:Raises", "parts.py:30"),
    ],
)
def test_a_mistake_is_answered_by_what_is_wrong(line, named, here, capsys):
    assert run_command(line.split()) == 2
    said = capsys.readouterr().err
    assert named in said
    assert "simrun_file_" not in said


def test_a_renderer_of_the_users_own_is_at_fault_in_a_run_as_a_policy_is(here):
    line = "--renderer parts.py:Channels --workers 1 --out run --set timing.duration_us=1000000"
    assert run_command([*line.split(), "smoke/straight"]) == 2
    assert run_command(["why", "run"]) == 0
