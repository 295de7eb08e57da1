"""`simrun bench quality`: the raw render, an identity and a small network over made-up pairs, whole
and resumed.
"""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from alpasim_plugin.block_fixers.dit import initial_weights
from alpasim_plugin.block_fixers.sizes import DiTSizes
from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import EvaluatorError, InputError
from alpasim_plugin.core.files import file_sha256
from alpasim_plugin.fixers.bundle import save_bundle
from alpasim_plugin.lab.bench import quality
from alpasim_plugin.lab.bench.quality import Work, finish, measure_quality, shown_frames
from alpasim_plugin.lab.cli.bench_quality import parse_variants
from alpasim_plugin.lab.training.bundle_fixer import bundle_fixer
from alpasim_plugin.lab.video_metrics.clip import clip_quality
from alpasim_plugin.lab.video_metrics.summary import summarise
from alpasim_plugin.lab.video_metrics.table import markdown
from tests.block_fixers.fixer_cases import small_settings
from tests.lab.training.pair_files import make
from tests.lab.video_metrics.scripted_detectors import LaneDetector, save_script

FRAMES = 14


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    path = tmp_path_factory.mktemp("bundle") / "small.safetensors"
    settings = small_settings("holes=noise", "window=3")
    parts = {
        "dit": initial_weights(DiTSizes(**settings.dit.model_dump()), 3),
        "vae": TinyVAE.random(seed=3).state_dict(),
    }
    prompt = {"text": torch.zeros(1, settings.dit.text_width)}
    save_bundle(path, {**parts, "prompt": prompt}, settings, trained=True, note="random")
    return path


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    root = tmp_path_factory.mktemp("pairs")
    for name in ("a", "b"):
        make(root, "test-known", name, frames=FRAMES)
    return root


def test_a_table_a_document_charts_and_pictures(data, bundle, tmp_path, capsys):
    out = tmp_path / "out"
    command = [
        "bench",
        "quality",
        str(data),
        "--fixer",
        f"3dgs,identity,small={bundle}",
        "--pictures",
        "1",
        "--out",
        str(out),
    ]
    assert run_command([*command, "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    variants = summary["arms"]
    assert list(variants) == ["3dgs", "identity", "small", "truth"]
    assert sorted(variants["truth"]) == ["warp_l1", "warp_l1_late", "warp_l1_late_road"]
    for metric in ("psnr_db", "ssim", "perceptual-syn", "warp_l1"):
        assert variants["identity"][metric] == variants["3dgs"][metric]
        assert summary["paired"]["identity"][metric]["diff"] == 0.0
        difference = variants["small"][metric]["mean"] - variants["3dgs"][metric]["mean"]
        assert summary["paired"]["small"][metric]["diff"] == pytest.approx(difference)
    assert "ms_per_frame" in variants["small"]
    assert "ms_per_frame" not in variants["3dgs"]
    assert summary["run"]["fixers"]["small"]["settings"]["window"] == 3
    assert summary["run"]["fixers"]["small"]["trained"] is True
    unit = {
        "frames": 8,
        "network_calls": 1,
        "latents": 2,
        "lookahead_frames": 7,
        "calls_per_frame": 0.125,
    }
    assert summary["run"]["units"] == {"3dgs": None, "identity": None, "small": unit}
    for name in ("quality.json", "quality.md", "sheets/a.png"):
        assert (out / name).stat().st_size > 0
    laid = cv2.imread(str(out / "sheets" / "a.png"))
    assert laid.shape[1] > 4 * 48
    stored = json.loads((out / "clips" / "small" / "b.json").read_text())["row"]
    assert len(stored["series"]["psnr_db"]) == FRAMES
    assert len(stored["series"]["warp_l1"]) == FRAMES - 1

    table = (out / "quality.md").read_text()
    assert table.count("| identity |") == 2


def test_detectors_from_the_folder_of_weights_are_in_the_table(tmp_path, capsys):
    root = tmp_path / "pairs"
    camera = {"K": [[20.0, 0.0, 24.0], [0.0, 20.0, 16.0], [0.0, 0.0, 1.0]]}
    make(root, "test-known", "a", frames=2, camera=camera)
    weights = tmp_path / "weights"
    weights.mkdir()
    save_script(LaneDetector(), weights / "lane_detector.pt")
    command = ["bench", "quality", str(root), "--out", str(tmp_path / "out"), "--pictures", "0"]
    assert run_command([*command, "--metric-weights", str(weights), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["arms"]["3dgs"]["lane_f1"]["mean"] == 1.0
    sha256 = file_sha256(weights / "lane_detector.pt")
    assert summary["run"]["networks"]["lane_f1"] == sha256
    assert "cuboid_f1" not in summary["arms"]["3dgs"]
    assert "Lane F1" in (tmp_path / "out" / "quality.md").read_text()

    make(root, "test-known", "b", frames=2)
    assert run_command([*command, "--metric-weights", str(weights)]) == 2
    assert "camera" in capsys.readouterr().err


def test_clips_that_end_in_another_order_keep_their_rows_and_pictures(tmp_path, monkeypatch):
    root = tmp_path / "pairs"
    for name, frames in (("long", FRAMES), ("short", 9)):
        make(root, "test-known", name, frames=frames)
    works = [
        Work(root / "test-known" / name, "render", variant, FRAMES, 0, "cpu", 1, None,
             tmp_path / "out", True)
        for variant in parse_variants("3dgs,identity", [])
        for name in ("long", "short")
    ]  # fmt: skip

    def last_first(work, jobs, workers):
        yield from ((job, work(job)) for job in reversed(jobs))

    monkeypatch.setattr(quality, "map_jobs", last_first)
    told = []
    summary = measure_quality(
        works, "3dgs", 2, tmp_path / "out", lambda i, n, work, row: told.append(row["clip"])
    )
    assert told == ["short", "long"] * 2
    assert list(summary["arms"]) == ["3dgs", "identity"], "in the order of the command"
    assert summary["frames"]["identity"] == [9, FRAMES]
    sheets = {path.stem for path in (tmp_path / "out" / "sheets").iterdir()}
    assert sheets == {"long", "short"}


def test_finished_clips_are_kept_until_something_differs(data, tmp_path):
    variant = parse_variants("identity", [])[0]
    work = Work(
        data / "test-known" / "b",
        "render",
        variant,
        FRAMES,
        0,
        "cpu",
        1,
        None,
        tmp_path,
        True,
    )
    row = finish(work)
    stamp = work.row_file.stat().st_mtime_ns
    assert finish(work) == row
    assert work.row_file.stat().st_mtime_ns == stamp
    picture = work.picture_file(shown_frames(FRAMES)[1])
    picture.unlink()
    finish(work)
    assert picture.is_file()
    key = json.loads(work.row_file.read_text())["key"]
    other = parse_variants("identity", ["fixer.block_latents=3"])[0]
    for changed in (
        replace(work, seed=1),
        replace(work, frames=9),
        replace(work, variant=other),
        replace(work, input_kind="truth"),
    ):
        assert finish(changed)["frames"] == changed.frames
        assert json.loads(work.row_file.read_text())["key"] != key


def test_labels_overrides_and_bundles_are_told_apart(bundle):
    variants = parse_variants(
        f"3dgs,two=onefixer-dit-tiny@2,small={bundle}", ["fixer.mode=chunk", "small:fixer.window=5"]
    )
    assert [variant.label for variant in variants] == ["3dgs", "two", "small"]
    assert variants[0].spec is None
    two, small = (variant.spec.settings for variant in variants[1:] if variant.spec)
    assert (two.mode, small.mode) == ("chunk", "chunk")
    assert (two.window, small.window, len(two.steps)) == (6, 5, 2)
    assert small.dit.width == 24
    assert small.weights.bundle == str(bundle)
    assert bundle_fixer(bundle)[0] == "onefixer-dit-tiny"


@pytest.mark.parametrize(
    ("text", "overrides", "words"),
    [
        ("3dgs,3dgs", [], "taken"),
        ("truth=identity", [], "taken"),
        ("a/b=identity", [], "taken"),
        ("nothing", [], "nothing"),
        ("identity", ["other:fixer.mode=chunk"], "no fixer of this label"),
        ("identity", ["window=3"], "not a key of the fixer"),
    ],
)
def test_variants_that_cannot_be_are_refused(text, overrides, words):
    with pytest.raises(InputError, match=words):
        parse_variants(text, overrides)


def row(variant, clip, psnr, frames=200):
    values = {"psnr_db": psnr}
    series = {"psnr_db": [psnr] * frames}
    return {
        "arm": variant,
        "clip": clip,
        "scene": clip.split("_")[0],
        "seed": 0,
        "frames": frames,
        "values": values,
        "series": series,
        "identical": 0,
        "ms_per_frame": [],
        "events": {},
    }


def test_means_have_a_spread_over_clips_and_differences_an_interval_of_their_median():
    rows = [row("3dgs", c, p) for c, p in zip("abcdef", (20, 22, 24, 30, 24, 24), strict=True)]
    fixed = (21.0, 23.1, 25.0, 31.1, 25.2, 23.9)
    rows += [row("f", c, p) for c, p in zip("abcdef", fixed, strict=True)]
    found = summarise(rows, "3dgs")
    arm = found["arms"]["3dgs"]["psnr_db"]
    assert (arm["mean"], arm["n"]) == (24.0, 6)
    assert arm["spread"] == pytest.approx(np.std([20, 22, 24, 30, 24, 24], ddof=1))
    pair = found["paired"]["f"]["psnr_db"]
    assert pair["diff"] == pytest.approx(5.3 / 6)
    assert pair["median"] == pytest.approx(1.05)
    assert pair["median_ci95"] == pytest.approx([-0.1, 1.2])
    assert (pair["n_better"], pair["n_worse"], pair["n"]) == (5, 1, 6)
    assert "| f | +0.88 (-0.10 to +1.20) |" in markdown(found)
    assert "| 3dgs | 24.00 (3.35) |" in markdown(found)
    few = summarise([row for row in rows if row["clip"] in "ab"], "3dgs")["paired"]["f"]["psnr_db"]
    assert few["median_ci95"] is None
    assert few["reason"] == "needs at least 6 scenes, found 2"
    with pytest.raises(EvaluatorError):
        summarise(rows, "x")


def test_phases_and_cameras_of_one_street_are_one_sample():
    clips = [f"{scene}_{phase}" for scene in "ab" for phase in range(4)]
    rows = [row("3dgs", clip, 20.0) for clip in clips]
    rows += [row("f", clip, 21.0 + i % 4 + 10 * (clip[0] == "b")) for i, clip in enumerate(clips)]
    summary = summarise(rows, "3dgs")
    assert (summary["clips"]["f"], summary["scenes"]["f"]) == (8, 2)
    arm = summary["arms"]["f"]["psnr_db"]
    assert (arm["mean"], arm["n"]) == (27.5, 2)
    assert arm["spread"] == pytest.approx(np.std([22.5, 32.5], ddof=1))
    pair = summary["paired"]["f"]["psnr_db"]
    assert (pair["diff"], pair["n"], pair["n_better"]) == (7.5, 2, 2)
    assert pair["median_ci95"] is None, "eight clips of two streets are two samples"
    assert "| 2 scenes, 8 clips x 200 |" in markdown(summary)


def test_drift_holds_the_end_against_frames_50_to_100():
    black = np.zeros((150, 16, 16, 3), dtype=np.uint8)
    made = black + np.uint8(1)
    made[100:] = 2
    assert clip_quality(made, black, {}).means["drift_psnr_db"] == pytest.approx(20 * np.log10(0.5))
    assert "drift_psnr_db" not in clip_quality(made[:149], black[:149], {}).means
