"""``simrun bench paper`` from drawn scenes to verdicts: stopped in a training, continued, and with
another budget.
"""

import json
import shutil

import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import InputError, Stopped
from alpasim_plugin.core.parts import split_names
from alpasim_plugin.core.parts.grammar import RendererName, parse_renderer
from alpasim_plugin.lab.cli.training_options import Progress
from alpasim_plugin.lab.paper.comparison import Effort, comparison
from alpasim_plugin.lab.paper.config import load_config
from alpasim_plugin.lab.paper.printed import printed

TINY = """
version: 1
train: {split: train, scenes: 1, duration_s: 1.6}
test: {split: val, scenes: 2, duration_s: 1.0}
frames: 5
least_power: 0.0
training:
  autoencoder_updates: 1
  base_updates: 1
  detector_updates: 1
  updates: 1
  updates_of: {V9: UPDATES}
  clips: 1
  accumulate: 1
  latents: 4
  columns: 4
systems: [V9]
ablation: [V2]
times: {scenes: 2, frames: 5}
pilot: {quality: pilot.json}
"""
PILOT = {
    "sets": {},
    "by_scene": {
        "a": {"perceptual-syn": {"x": 0.1, "y": 0.2, "z": 0.3}},
        "b": {"perceptual-syn": {"x": 0.1, "y": 0.3, "z": 0.2}},
    },
}
STOP_AT = 6  # checkpoints are written every fifth update


def paper(folder, *options):
    """Run the command on the configuration in a folder."""
    command = ["bench", "paper", "--config", str(folder / "tiny.yaml"), "--out", str(folder / "o")]
    return run_command([*command, *options])


def write_config(folder, updates):
    (folder / "tiny.yaml").write_text(TINY.replace("UPDATES", str(updates)))
    (folder / "pilot.json").write_text(json.dumps(PILOT))


def states(folder, capsys):
    assert paper(folder, "--dry-run", "--json") == 0
    plan = json.loads(capsys.readouterr().out)
    return {stage["name"]: stage["state"] for stage in plan["stages"]}


def stopping(monkeypatch):
    """Let a signal arrive after update `STOP_AT` of a training, before its last checkpoint."""
    update = Progress.update

    def stop(self, step, numbers):
        update(self, step, numbers)
        if step == STOP_AT:
            raise Stopped(15)

    monkeypatch.setattr(Progress, "update", stop)


@pytest.mark.slow
def test_a_stopped_comparison_goes_on_and_another_budget_remakes_what_depends_on_it(
    tmp_path, capsys, monkeypatch
):
    write_config(tmp_path, updates=STOP_AT)
    with monkeypatch.context() as patched:
        stopping(patched)
        assert paper(tmp_path) == 128 + 15
    assert "the same command continues" in capsys.readouterr().err
    begun = states(tmp_path, capsys)
    assert begun["base"] == "done"
    assert begun["train-V9"] == "begun"
    assert begun["quality-V9"] == "open"

    kept = tmp_path / "kept"
    assert paper(tmp_path, "--json", "--keep", str(kept)) == 0
    out, err = capsys.readouterr()
    said = err.replace("\n", "")
    record = json.loads(out)
    assert "stage base" in said
    trained = next(stage for stage in record["stages"] if stage["name"] == "train-V9")
    assert f"stage train-V9 ({trained['key']}): goes on" in said
    folder = tmp_path / "o" / "stages" / f"train-V9-{trained['key']}"
    log = [json.loads(line)["step"] for line in (folder / "log.jsonl").read_text().splitlines()]
    assert log == list(range(1, STOP_AT + 1))  # the update after the checkpoint was made again
    assert json.loads((folder / "stage.json").read_text())["was_resumed"] is True

    right = json.loads((kept / "detectors" / "detectors.json").read_text())["clean_frames"]
    assert set(right["cuboid_f1"]) == set(right["lane_f1"]) == {"precision", "recall", "f1"}
    cell = record["tables"]["ablation"]["V2"]["lpips"]
    assert (cell["metric"], cell["paper"]) == ("perceptual-syn", ".155±.017")
    measured = next((tmp_path / "o" / "stages").glob("quality-V2-*")) / "quality.json"
    arm = json.loads(measured.read_text())["arms"]["V2"]["perceptual-syn"]
    assert cell["value"] == pytest.approx(arm["mean"])  # of two scenes, mean and median are one
    gap = next(claim for claim in record["claims"] if claim["claim"] == 28)
    assert gap["verdict"] == "undecided"  # two scenes show nothing
    assert gap["comparisons"][0]["n"] == 2
    assert (tmp_path / "o" / "paper.md").read_text().count("| V2 |") == 1

    truths = list((tmp_path / "o" / "truth-rows").iterdir())
    assert len(truths) == 2  # of two scenes, for three rows

    shutil.rmtree(tmp_path / "o")
    shutil.rmtree(kept / "quality-V2")
    assert paper(tmp_path, "--json", "--keep", str(kept)) == 0
    out, err = capsys.readouterr()
    begun = [line.split()[1] for line in err.splitlines() if line.endswith(": begins")]
    assert begun == ["scenes-test", "pairs-test", "quality-V2"]
    again = json.loads(out)["tables"]["ablation"]["V2"]["lpips"]
    assert again == record["tables"]["ablation"]["V2"]["lpips"]

    write_config(tmp_path, updates=STOP_AT + 1)
    changed = states(tmp_path, capsys)
    assert {name for name, state in changed.items() if state != "done"} == {
        "scenes-train",  # not made again so far: nobody needed it
        "pairs-train",
        "train-V9",
        "quality-V9",
        "times",
    }
    assert paper(tmp_path, "--weights", str(kept)) == InputError.exit_code
    assert f"--steps {STOP_AT + 1}, kept {STOP_AT}" in capsys.readouterr().err


def test_kept_weights_that_lack_a_system_are_refused(tmp_path, capsys):
    write_config(tmp_path, updates=1)
    assert paper(tmp_path, "--weights", str(tmp_path)) == InputError.exit_code
    assert "no " in capsys.readouterr().err
    both = ("--weights", str(tmp_path), "--keep", str(tmp_path))
    assert paper(tmp_path, *both) == InputError.exit_code


@pytest.mark.parametrize("name", ["small", "published"])
def test_the_shipped_configurations_hold_every_row_of_the_papers_tables(name):
    config, _, _ = load_config(name)
    tables = printed().tables
    assert list(config.systems) == list(tables["cycle"].rows)
    assert list(config.ablation) == list(tables["ablation"].rows)
    assert list(config.drive.renderers) == list(tables["closed-loop"].rows)


def test_the_renderers_of_the_closed_loop_are_understood(tmp_path):
    """Weights are only named here: what counts is that each name means its fixer and its steps."""
    config, _, _ = load_config("small")
    stages = comparison(config, None, Effort(), tmp_path)
    drive = next(stage for stage in stages if stage.name == "drive")
    words = drive.command[drive.command.index("--renderer") + 1]
    systems = {"difix": "difix", "omnidreams@4": "omnidreams@4", "self-forcing": "self-forcing"}
    systems["V9"] = "onefixer-dit-tiny"
    names = split_names(words)
    assert names[0] == "3dgs"
    for name, (row, fixer) in zip(names[1:], systems.items(), strict=True):
        parsed = parse_renderer(name, [fixer.partition("@")[0] for fixer in systems.values()])
        plain, _, steps = fixer.partition("@")
        bundle = f"weights.bundle={{train-{row.partition('@')[0]}}}/fixer.safetensors"
        assert parsed == RendererName(plain, steps, (bundle,), "3dgs")


def test_the_plan_of_a_shipped_configuration_says_power_and_what_is_left_out(tmp_path, capsys):
    out = str(tmp_path / "o")
    assert run_command(["bench", "paper", "--config", "small", "--out", out, "--dry-run"]) == 0
    text = capsys.readouterr().out
    assert "claims that are tested" in text
    assert "its power is" in text
    assert "it is about FVD at several times of a training" in text
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("systems: [V9]", "systems: [V99]", "no system 'V99'"),
        ("systems: [V9]", "systems: [3dgs]", "3dgs is always measured"),
        ("split: train,", "split: val,", "networks are trained on the split 'train'"),
        ("pilot.json", "absent.json", "absent.json"),
        ("ablation", "ablations", "ablations"),
    ],
)
def test_a_configuration_that_cannot_be_run_is_refused_before_anything_begins(
    old, new, message, tmp_path, capsys
):
    write_config(tmp_path, updates=1)
    path = tmp_path / "tiny.yaml"
    path.write_text(path.read_text().replace(old, new, 1))
    assert paper(tmp_path) == InputError.exit_code
    assert message in capsys.readouterr().err
    assert not (tmp_path / "o").exists()
