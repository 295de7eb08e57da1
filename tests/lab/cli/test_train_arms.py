"""`simrun train arms`: two arms with a stage in common, trained, resumed, measured against their
time; and what is refused.
"""

from __future__ import annotations

import json
from collections import defaultdict
from pathlib import Path

import pytest

from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.block_fixers.tiny_vae_nets import TinySizes
from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.bench.cost import cost_curves
from alpasim_plugin.lab.cli.arms_tasks import StageTask, chosen_rates, tasks_of
from alpasim_plugin.lab.cli.train_arms import seconds_left
from alpasim_plugin.lab.training.arms.budget import in_equal_time, related
from alpasim_plugin.lab.training.arms.plan import comparison, plan, training_names
from alpasim_plugin.lab.training.arms.run import PROBE_FILE, ArmsRun
from alpasim_plugin.lab.training.clip_batches import BatchForm
from alpasim_plugin.lab.training.latent_clips import ClipForm
from alpasim_plugin.lab.training.snapshots import core_seconds, snapshots_of
from alpasim_plugin.lab.training.trainer import Schedule
from tests.lab.training.pair_files import make

CLIPS = ["--latents", "2", "--stride", "4", "--clips", "1", "--size", "48x32"]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("arms")
    make(root / "pairs", "train", "a", frames=9)
    make(root / "pairs", "train", "wide", frames=9, width=64)
    for name in ("b", "c"):
        sequence = make(root / "pairs", "val", name, frames=9)
        path = sequence.folder / "sequence.json"
        path.write_text(
            json.dumps({**json.loads(path.read_text()), "degradation": {"kind": "cycle"}})
        )
    TinyVAE.random(TinySizes(16, 16, 16, 16, 16)).save(root / "vae.safetensors")
    return root


def command(
    data: Path, *more: str, out: str = "arms", only: str = "omnidreams,self-forcing"
) -> list[str]:
    fixed = [*CLIPS, "--accumulate", "1", "--columns", "4", "--base-steps", "1"]
    names = ["--vae", str(data / "vae.safetensors"), "--out", str(data / out), "--only", only]
    return ["train", "arms", str(data / "pairs"), *names, *fixed, *more]


@pytest.mark.slow
def test_arms_share_a_stage_resume_and_are_measured_against_their_time(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    train = command(data, "--steps", "2", "--snapshots", "2")
    assert run_command([*train, "--json"]) == 0
    got = capsys.readouterr()
    rows = {row["arm"]: row for row in json.loads(got.out)["arms"]}
    assert rows["self-forcing"]["stages"] == {
        "self-forcing/teacher": 2,
        "omnidreams": 2,
        "self-forcing": 2,
    }
    out = data / "arms"
    assert sorted(path.parent.name for path in out.glob("*/fixer.safetensors")) == [
        "omnidreams",
        "self-forcing",
    ]
    assert [snapshot.step for snapshot in snapshots_of(out / "omnidreams")] == [1, 2]
    card = json.loads((out / "self-forcing" / "fixer.card.json").read_text())["training"]
    teacher = json.loads((out / "self-forcing" / "teacher" / "fixer.card.json").read_text())[
        "training"
    ]
    assert (card["start"]["real"], card["start"]["dit"]) != (
        teacher["start"]["dit"],
        card["start"]["real"],
    )

    written = {path: path.stat().st_mtime_ns for path in out.rglob("*.safetensors")}
    assert run_command(train) == 0
    assert "was finished" in capsys.readouterr().err
    assert {path: path.stat().st_mtime_ns for path in written} == written
    assert run_command([*train, "--lr", "1e-3"]) == 2
    assert "it was begun as" in capsys.readouterr().err

    (curve,), variants = cost_curves([out])
    before = core_seconds(out / "self-forcing" / "teacher")[-1] / 60
    assert [point.stage for point in curve.points] == ["omnidreams"] * 2 + ["self-forcing"] * 2, (
        "the teacher's time counts alone"
    )
    assert (
        before
        < curve.points[0].core_minutes
        < curve.core_minutes
        == pytest.approx(rows["self-forcing"]["core_minutes"])
    )
    assert len(variants) == 4
    with pytest.raises(InputError, match="self-forcing of seed 0, which another folder has too"):
        cost_curves([out, out])
    assert (
        run_command(
            [
                "bench",
                "paper",
                str(data / "pairs"),
                "--arms",
                str(out),
                "--other-seed",
                str(out),
                "--out",
                str(data / "no"),
            ]
        )
        == 2
    )
    assert "add the protocol cost to --only" in capsys.readouterr().err

    measure = [
        "bench",
        "paper",
        str(data / "pairs"),
        "--arms",
        str(out),
        "--only",
        "cost",
        "--out",
        str(data / "cost"),
        "--json",
    ]
    assert run_command(measure) == 0
    text = (data / "cost" / "paper.md").read_text()
    assert "9 frames each (the shortest clip has no more" in text
    assert "| self-forcing | 0 | omnidreams | 1 |" in text
    assert (data / "cost" / "cost.png").stat().st_size > 10_000


@pytest.mark.slow
def test_a_sweep_makes_the_best_candidate_the_arm_whatever_the_number_of_processes(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sweep = ["--steps", "2", "--snapshots", "1", "--sweep", "1e-4,3e-3", "--json"]
    found = {}
    for out, jobs in (("one", "1"), ("two", "2")):
        assert run_command(command(data, *sweep, "--jobs", jobs, out=out, only="omnidreams")) == 0
        row = json.loads(capsys.readouterr().out)["arms"][0]
        arm = data / out / "omnidreams"
        card = json.loads((arm / "fixer.card.json").read_text())["sweep"]
        best = min(card["scores"], key=lambda rate: card["scores"][rate]["perceptual-syn"])
        assert f"{row['rate']:g}" == f"{card['rate']:g}" == best
        assert (arm / "fixer.safetensors").samefile(
            data / out / "sweep" / f"omnidreams@{best}" / "fixer.safetensors"
        )
        found[out] = card["scores"]
    assert found["one"] == found["two"]
    assert run_command(command(data, "--steps", "2", out="one", only="omnidreams")) == 2
    assert "chosen by a sweep" in capsys.readouterr().err
    assert (
        run_command(command(data, *sweep, "--sweep-steps", "1", out="short", only="omnidreams"))
        == 0
    )
    row = json.loads(capsys.readouterr().out)["arms"][0]
    assert row["stages"] == {"omnidreams": 2}
    assert len(core_seconds(data / "short" / "sweep" / f"omnidreams@{row['rate']:g}")) == 1
    assert (
        json.loads((data / "short" / "omnidreams" / "fixer.card.json").read_text())["sweep"]["rate"]
        == row["rate"]
    )


@pytest.mark.slow
def test_a_budget_of_minutes_is_kept_with_recorded_times(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    train = command(
        data,
        "--budget",
        "minutes",
        "--minutes",
        "0.02",
        "--probe-updates",
        "5",
        "--json",
        out="timed",
    )
    assert run_command(train) == 0
    rows = json.loads(capsys.readouterr().out)["arms"]
    probed = (data / "timed" / PROBE_FILE).read_text()
    assert {"self-forcing/teacher", "omnidreams", "self-forcing", "one-forcing"} == set(
        json.loads(probed)["seconds_of_update"]
    )
    assert run_command(train) == 0, "the same updates again, by the recorded times"
    assert json.loads(capsys.readouterr().out)["arms"] == rows
    assert (data / "timed" / PROBE_FILE).read_text() == probed


def test_the_time_left_of_a_stage_without_an_update_goes_by_its_latents() -> None:
    latents = {"V9": 12, "harmonizer": 1, "one-forcing": 12}
    left = {"V9": 10, "harmonizer": 100, "one-forcing": 5}
    assert seconds_left(left, latents, {}) is None
    assert seconds_left(left, latents, {"V9": [2.0, 4.0]}) == pytest.approx(
        10 * 3 + 100 * 3 / 12 + 5 * 3
    )
    assert seconds_left(left, latents, {"V9": [3.0], "harmonizer": [0.5]}) == pytest.approx(
        10 * 3 + 100 * 0.5 + 5 * 12 * 0.375
    )


def test_rates_of_a_sweep_reach_the_arm_and_the_same_stage_of_another_arm(data: Path) -> None:
    sweep = data / "rates" / "sweep"
    sweep.mkdir(parents=True)
    for arm, rate in (("omnidreams", 1e-3), ("self-forcing", 1e-4)):
        score = {"perceptual-syn": 0.3, "psnr_db": 20.0}
        (sweep / f"{arm}.json").write_text(
            json.dumps({"rate": rate, "scores": {f"{rate:g}": score}, "clips": ["b"]})
        )
    rates = chosen_rates(data / "rates")
    assert rates == {"omnidreams": 1e-3, "self-forcing": 1e-4}

    schedule = Schedule(steps=2, peak_lr=2e-4)
    run = ArmsRun(
        data / "pairs",
        data / "vae.safetensors",
        data / "rated",
        ClipForm(2, 4),
        BatchForm(1),
        schedule,
        schedule,
    )
    names, seconds = training_names(comparison()), defaultdict(lambda: 1.0)
    timed = in_equal_time(
        related(comparison(), ["self-forcing"]), names, seconds, 1.0, 2
    )  # its student is then no arm
    for recipes, student in ((comparison(), "omnidreams"), (timed, "self-forcing/student")):
        tasks = {
            task.name: task for task in tasks_of(run, plan(recipes, ["self-forcing"]), None, rates)
        }
        given = {name: task.peak_lr for name, task in tasks.items() if isinstance(task, StageTask)}
        assert given == {
            "initial/base": None,
            "initial/base-bi": None,
            "self-forcing/teacher": None,
            student: 1e-3,
            "self-forcing": 1e-4,
        }


def test_one_fixer_and_its_decoder_are_trained_on_the_sequences_of_one_size(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fixer = [
        "train",
        "fixer",
        str(data / "pairs"),
        "--vae",
        str(data / "vae.safetensors"),
        "--recipe",
        "base",
        "--steps",
        "1",
    ]
    assert run_command([*fixer, *CLIPS[:-2], "--out", str(data / "fixer")]) == 2
    assert "48x32 (1), 64x32 (1)" in capsys.readouterr().err
    assert run_command([*fixer, *CLIPS, "--out", str(data / "fixer")]) == 0
    bundle = data / "fixer" / "fixer.safetensors"
    decoder = [
        "train",
        "decoder",
        str(data / "pairs"),
        "--init",
        str(bundle),
        "--steps",
        "1",
        "--rows",
        "2",
        "--columns",
        "2",
    ]
    assert run_command([*decoder, *CLIPS, "--perceptual", "0", "--out", str(data / "decoder")]) == 0
    assert json.loads((data / "decoder" / "fixer.card.json").read_text())["data"]["clips"] == 4


@pytest.mark.parametrize(
    ("more", "found"),
    [
        (["--budget", "minutes"], "minutes without a number"),
        (["--minutes", "3"], "a number of minutes for a budget of updates"),
        (["--jobs", "2", "--threads", "2"], "several threads in several processes"),
        (["--sweep", "1e-4"], "not at least two different learning rates"),
        (["--sweep", "1e-4,nan"], "not at least two different learning rates"),
        (["--sweep-steps", "3"], "no rates to choose from"),
        (["--sweep", "1e-4,1e-3", "--rates", "."], "rates to choose from, and chosen ones"),
        (["--rates", "."], "no rates that a sweep chose"),
        (["--weights", "init=x"], "no initial network"),
        (["--size", "48"], "not two positive integers"),
        (["--size", "32x48"], "no sequence of 32x48; there are 48x32 (1), 64x32 (1)"),
    ],
)
def test_options_that_do_not_fit_together_are_refused(
    data: Path, capsys: pytest.CaptureFixture[str], more: list[str], found: str
) -> None:
    assert run_command(command(data, *more)) == 2
    assert found in " ".join(capsys.readouterr().err.split())
