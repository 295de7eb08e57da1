"""`simrun bench paper`: two protocols over made-up pairs, once and again."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from alpasim_plugin.block_fixers.sizes import DiTSizes, initial_weights
from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.cli.main import run_command
from alpasim_plugin.fixers.bundle import save_bundle
from alpasim_plugin.lab.bench import paper as bench_paper
from alpasim_plugin.lab.bench import transfer as bench_transfer
from alpasim_plugin.lab.bench.training_memory import MemoryCell
from tests.block_fixers.fixer_cases import small_settings
from tests.lab.training.pair_files import make

pytestmark = pytest.mark.slow


@pytest.fixture
def data(tmp_path: Path) -> Path:
    for name, kind in (
        ("a", "cycle"),
        ("b", "cycle"),
        ("c", "reconstruction"),
        ("d", "reconstruction"),
    ):
        sequence = make(tmp_path / "pairs", "val", name, frames=6)
        path = sequence.folder / "sequence.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), "degradation": {"kind": kind}}))
    return tmp_path / "pairs"


def test_tables_verdicts_and_a_page_and_nothing_is_measured_twice(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench_paper, "SHIPPED", ("onefixer",))
    (tmp_path / "arms").mkdir()
    out = tmp_path / "out"
    command = [
        "bench",
        "paper",
        str(data),
        "--arms",
        str(tmp_path / "arms"),
        "--split",
        "val",
        "--only",
        "cycle,under-trained",
        "--out",
        str(out),
    ]
    assert run_command([*command, "--json"]) == 0
    verdicts = json.loads(capsys.readouterr().out)
    assert [one["verdict"] for one in verdicts] == ["not measured"] * 14
    text = (out / "paper.md").read_text()
    assert "**3dgs** | ours" in text
    assert "**onefixer** | ours" in text
    page = (out / "side-by-side.html").read_text()
    assert page.count('class="arm"') == 3
    rows = {path: path.stat().st_mtime_ns for path in out.rglob("clips/*/*.json")}
    assert len(rows) == 2 * 2 * 3
    assert run_command(command) == 0
    assert {path: path.stat().st_mtime_ns for path in rows} == rows


@pytest.mark.slow
def test_a_second_budget_is_measured_on_the_same_clips_without_measuring_the_shipped_arms_again(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench_paper, "SHIPPED", ("onefixer",))
    settings = small_settings("window=3")
    minutes = {
        "arms/V1": 0.9,
        "arms/V3": 5.0,
        "arms/V9": 7.0,
        "equal/V9": 1.0,
    }  # V1 took about the second budget's minute already
    for seed, (arm, took) in enumerate(minutes.items()):
        parts = {
            "dit": initial_weights(DiTSizes(**settings.dit.model_dump()), seed),
            "vae": TinyVAE.random(seed=3).state_dict(),
        }
        (tmp_path / arm).mkdir(parents=True)
        save_bundle(
            tmp_path / arm / bench_paper.BUNDLE_FILE, parts, settings, trained=True, note="random"
        )
        (tmp_path / arm / "fixer.card.json").write_text(
            json.dumps({"training": {"schedule": {"peak_lr": 1e-3}}})
        )
        (tmp_path / arm / "log.jsonl").write_text(
            json.dumps({"step": 1, "core_s": 60 * took}) + "\n"
        )
    for folder, budget in (("arms", None), ("equal", 1.0)):
        arms_there = [name.partition("/")[2] for name in minutes if name.startswith(folder)]
        (tmp_path / folder / "arms.json").write_text(
            json.dumps({"minutes": budget, "arms": {arm: [arm] for arm in arms_there}})
        )
    long = tmp_path / "long"
    for name, kind in (("e", "reconstruction"), ("f", "reconstruction"), ("g", "cycle")):
        path = make(long, "val", name, frames=7).folder / "sequence.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), "degradation": {"kind": kind}}))
    out, arms = tmp_path / "out", str(tmp_path / "arms")
    command = [
        "bench",
        "paper",
        str(data),
        "--arms",
        arms,
        "--equal-time",
        str(tmp_path / "equal"),
        "--split",
        "val",
        "--long",
        str(long),
    ]
    assert (
        run_command([*command, "--only", "cycle,under-trained", "--out", str(out), "--json"]) == 0
    )
    capsys.readouterr()
    clips = {path.relative_to(out).as_posix() for path in out.rglob("clips/*/*.json")}
    assert {f"under-trained/clips/V9/{name}.json" for name in "ef"} <= clips
    assert "under-trained/clips/V9/g.json" not in clips, (
        "a long cycle render is no under-trained reconstruction"
    )
    assert {name.split("/")[3] for name in clips if name.startswith("equal-time/cycle/")} == {
        "V9",
        "truth",
    }
    text = (out / "paper.md").read_text()
    second = text[text.index("## Equal core-minutes") : text.index("## The paper's claims")]
    assert "**onefixer** | ours" in second
    assert "within 10 %, and their weights stand here too: `V1`." in second
    assert "| V1 | V1 1 | 0.90 |" in second
    assert "| V3 |" not in second
    assert "| V9 | V9 1 | 1.00 |" in second
    keys = [
        json.loads((out / folder / "clips/V9/a.json").read_text())["key"]
        for folder in ("cycle", "equal-time/cycle")
    ]
    assert keys[0] != keys[1], "each budget is measured with its own weights"
    assert "### Under both budgets" in text


@pytest.mark.slow
def test_the_transfer_is_measured_zero_shot_and_tuned_beside_the_papers_table(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench_paper, "SHIPPED", ("onefixer",))
    monkeypatch.setattr(bench_transfer, "SHIPPED", ("3dgs", "onefixer"))
    for folder, count in (("beyond", 2), ("photos", 2)):
        for i in range(count):
            sequence = make(tmp_path / folder, "test", f"{folder}-{i}", frames=20)
            path = sequence.folder / "sequence.json"
            lens = {
                "width": 48,
                "height": 32,
                "K": np.diag([40.0, 40.0, 1.0]).tolist(),
                "T_rig_camera": np.eye(4).tolist(),
            }
            held_out = {"held_out": list(range(i, 20, 2))} if folder == "photos" else {}
            path.write_text(
                json.dumps({**json.loads(path.read_text()), "camera": lens, **held_out})
            )
    settings = small_settings("window=3")
    parts = {
        "dit": initial_weights(DiTSizes(**settings.dit.model_dump()), 3),
        "vae": TinyVAE.random(seed=3).state_dict(),
    }
    for folder in ("arms", "tuned"):
        (tmp_path / folder / "V9").mkdir(parents=True)
        save_bundle(
            tmp_path / folder / "V9" / bench_paper.BUNDLE_FILE,
            parts,
            settings,
            trained=True,
            note="random",
        )
    where = {name: str(tmp_path / name) for name in ("arms", "beyond", "photos", "tuned", "out")}
    command = [
        "bench",
        "paper",
        str(data),
        "--split",
        "val",
        "--only",
        "transfer",
        "--arms",
        where["arms"],
        "--out",
        where["out"],
        "--json",
    ]
    command += [
        "--transfer",
        where["beyond"],
        "--transfer-arms",
        where["tuned"],
        "--photographs",
        where["photos"],
    ]
    assert run_command(command) == 0
    (verdict,) = (
        claim["verdict"] for claim in json.loads(capsys.readouterr().out) if claim["number"] == 13
    )
    assert verdict == "not measured"  # difix and artifixer were not trained
    text = (tmp_path / "out" / "paper.md").read_text()
    section = text[text.index("## Beyond driving") : text.index("## By position")]
    assert "| **V9** | paper | .0201 | 2326 | .126 | .136 | 22.6 |" in section
    ours = section[section.index("| **V9** | paper") :].splitlines()[1]
    assert ours.count("±") == 4  # all but the distance of sets, which has no interval
    assert "**V9 zero shot** | ours" in section
    assert "### Photographs" in section
    rows = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").rglob("clips/*/*.json")}
    assert len(rows) == 2 * 2 * 5
    assert run_command(command) == 0
    assert {path: path.stat().st_mtime_ns for path in rows} == rows


def test_an_arm_with_several_numbers_of_steps_takes_each_though_its_bundle_names_one(
    tmp_path: Path,
) -> None:
    settings = small_settings("window=3")
    assert len(settings.steps) == 1
    parts = {
        "dit": initial_weights(DiTSizes(**settings.dit.model_dump()), 3),
        "vae": TinyVAE.random(seed=3).state_dict(),
    }
    for arm in ("omnidreams", "V9"):
        (tmp_path / arm).mkdir()
        save_bundle(
            tmp_path / arm / bench_paper.BUNDLE_FILE, parts, settings, trained=True, note="random"
        )
    found = bench_paper.arms_in(tmp_path)
    assert {arm.label: len(arm.spec.settings.steps) for arm in found} == {
        "V9": 1,
        "omnidreams@1": 1,
        "omnidreams@4": 4,
    }  # type: ignore[union-attr]
    both = bench_paper.arms_in(tmp_path, steps_of={"V9": (None, 4)})
    assert {arm.label: len(arm.spec.settings.steps) for arm in both} == {
        "V9": 1,
        "V9@4": 4,
        "omnidreams": 1,
    }  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("more", "found"),
    [
        (["--only", "cycle,loop"], "unknown: loop"),
        (["--arms", "nowhere"], "no such folder"),
        (["--equal-time", "nowhere"], "--equal-time nowhere"),
        (["--drives", "."], "run.json"),
        (["--record", "paper.json"], "no such file"),
    ],
)
def test_what_cannot_be_compared_is_refused(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], found: str
) -> None:
    (tmp_path / "arms").mkdir()
    command = [
        "bench",
        "paper",
        str(data),
        "--split",
        "val",
        "--arms",
        str(tmp_path / "arms"),
        "--only",
        "closed-loop",
        "--out",
        str(tmp_path / "out"),
    ]
    assert run_command([*command, *more]) == 2
    assert found in " ".join(capsys.readouterr().err.split())


def test_kept_memory_is_used_while_what_it_depends_on_is_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []

    def measure(*args: object, **options: object) -> list[MemoryCell]:
        asked.append(1)
        return [MemoryCell(8, 1, 500.0, 1.0)]

    monkeypatch.setattr(bench_paper, "measure_memory", measure)
    path = tmp_path / "memory.json"
    assert bench_paper.training_memory(path) == bench_paper.training_memory(path)
    assert len(asked) == 1
    kept = json.loads(path.read_text())
    path.write_text(json.dumps({**kept, "facts": {**kept["facts"], "window": 99}}))
    bench_paper.training_memory(path)
    assert len(asked) == 2
