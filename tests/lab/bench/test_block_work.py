"""Work of a block counted without numbers: it is that of the real networks; what does not fit is
refused before it is allocated.
"""

from __future__ import annotations

import json

import pytest
import torch
from typer.testing import CliRunner

from alpasim_plugin.block_fixers.pipeline import STAGES, BlockPipeline
from alpasim_plugin.block_fixers.sizes import DiTSizes
from alpasim_plugin.core.errors import FixerError, InputError, SimrunError
from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.lab.bench.block_speed import measure_blocks, require_memory
from alpasim_plugin.lab.bench.op_counter import OpCounter
from alpasim_plugin.lab.bench.random_networks import random_networks
from alpasim_plugin.lab.bench.roofline import (
    DEVICES,
    block_work,
    device_of,
    networks_bytes,
    run_block,
)
from alpasim_plugin.lab.cli.bench import app
from tests.block_fixers.fixer_cases import SMALL_DIT, small_settings
from tests.examples import first_of
from tests.lab.bench.dit_work import cache_bytes, forward_work

LAPTOP = "1:0.1:20:8"


@pytest.mark.slow
@pytest.mark.parametrize(
    "overrides",
    first_of(
        [
            ("history=finalise", "window=4", "holes=noise"),
            ("precision=bf16", "codec_precision=bf16", "steps=[1000,500]"),
            ("vae.kind=wan", "vae.base=8", "decoder.kind=taehv", "uses_map=false"),
        ]
    ),
    ids=",".join,
)
def test_work_without_numbers_is_the_work_of_the_real_networks(overrides):
    settings = small_settings(*overrides)
    work = block_work(settings, 32, 48, views=1, text_tokens=3)
    networks = random_networks(settings, "cpu", 3)
    pipeline = BlockPipeline(networks, settings)
    state = pipeline.start(1, 32, 48)
    for block in range(4):
        with OpCounter() as counter:
            _, state = run_block(pipeline, state, block, 1, 32, 48)
    assert sum(stage.flops for stage in work.stages.values()) == counter.flops
    assert work.weight_bytes == networks_bytes(networks)
    assert work.cache_bytes == state.history.cache.nbytes
    assert work.state_bytes == 2 * sum(
        part.nbytes for codec in (state.encoder, state.decoder) for part in codec
    )
    assert set(work.stages) <= set(STAGES)
    assert ("cache write" in work.stages) == (settings.history == "finalise")


def test_transformers_share_is_the_formula():
    settings = small_settings("window=4")
    work = block_work(settings, 32, 48, views=2, text_tokens=3)
    sizes = DiTSizes(**settings.dit.model_dump())
    assert work.stages["dit"].flops == forward_work(sizes, 6, 2, 4, 3, batch=2).flops
    assert work.cache_bytes == cache_bytes(sizes, 6, 4, batch=2, width_bytes=4)
    rows = work.rows(device_of(LAPTOP))
    assert [row.stage for row in rows][-1] == "all"
    assert rows[-1].compute_ms == pytest.approx(sum(row.compute_ms for row in rows[:-1]))
    assert all(row.eager_ms >= row.compute_ms for row in rows)


@pytest.mark.slow
def test_random_networks_run_at_every_precision():
    for precision in ("fp32", "bf16", "fp16"):
        settings = small_settings(f"precision={precision}", "history=finalise")
        pipeline = BlockPipeline(random_networks(settings, "cpu", 2), settings)
        out, _ = run_block(pipeline, pipeline.start(1, 32, 48), 0, 1, 32, 48)
        assert out.isfinite().all(), precision
        assert float(out.std()) > 0
        assert not pipeline.networks.trained


@pytest.mark.slow
def test_measuring_gives_every_stage():
    settings = small_settings()
    work = block_work(settings, 32, 48, text_tokens=1)
    times = measure_blocks(settings, work, 32, 48, "cpu", blocks=2, text_tokens=1)
    assert len(times.all_in) == 2
    assert set(work.stages) <= set(times.stages)
    assert all(
        len(ms) == 2 and min(ms) > 0 for name, ms in times.stages.items() if name in work.stages
    )
    assert (times.calls, times.peak_mb, times.device) == ({}, None, "cpu")


def test_absent_gpu_is_an_error_before_anything_is_made(monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    settings = fixer_settings("onefixer-2b")
    work = block_work(small_settings(), 32, 48, text_tokens=1)
    with pytest.raises(
        FixerError, match=r"measuring onefixer-2b[\s\S]*sees no CUDA device[\s\S]*--device cpu"
    ):
        measure_blocks(settings, work, 544, 960, "cuda")


def test_gpu_that_is_too_small_is_an_error_with_both_numbers(monkeypatch):
    work = block_work(small_settings(), 32, 48, text_tokens=1)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (500_000_000, 8_000_000_000))
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "Small GPU")
    with pytest.raises(
        FixerError,
        match=r"Small GPU[\s\S]*0\.7 GB needed, 0\.5 GB free of 8\.0 GB[\s\S]*fixer.window",
    ):
        require_memory(small_settings(), work, "cuda")


@pytest.mark.slow
def test_command_prints_the_table_and_the_measurement():
    sets = [part for text in SMALL_DIT for part in ("--set", f"fixer.{text}")]
    args = [
        "roofline",
        "--fixer",
        "onefixer-dit-tiny",
        "--size",
        "48x32",
        "--on",
        LAPTOP,
        "--text-tokens",
        "1",
        *sets,
    ]
    plain = CliRunner().invoke(app, args, catch_exceptions=False)
    assert plain.exit_code == 0
    assert "| dit |" in plain.stdout
    assert "measured" not in plain.stdout
    document = json.loads(
        CliRunner()
        .invoke(app, [*args, "--json", "--measure", "--device", "cpu", "--blocks", "1"])
        .stdout
    )
    assert [row["stage"] for row in document["rows"]][-1] == "all"
    assert len(document["measured"]["all_in"]) == 1


@pytest.mark.parametrize(
    ("args", "error", "message"),
    [
        (["--size", "960x540"], InputError, "multiples of 16"),
        (["--fixer", "identity"], SimrunError, "onefixer family"),
        (["--on", "toaster"], InputError, "known are h200"),
    ],
)
def test_command_refuses(args, error, message):
    with pytest.raises(error, match=message):
        CliRunner().invoke(app, ["roofline", *args], catch_exceptions=False)


@pytest.mark.slow
@pytest.mark.parametrize(("window", "ms"), [(6, 25.6), (12, 37.2)])
def test_full_size_transformer_has_the_published_floor(window, ms):
    work = block_work(
        fixer_settings("onefixer-2b", [f"window={window}", "vae.base=24", "history=last-forward"]),
        544,
        960,
    )
    rows = {row.stage: row for row in work.rows(DEVICES["h200"])}
    assert rows["dit"].compute_ms == pytest.approx(ms, abs=0.1)
    assert rows["all"].eager_ms < 80


@pytest.mark.gpu
@pytest.mark.parametrize("window", [6, 12])
def test_full_size_on_a_gpu_fits_the_estimate(window):
    settings = fixer_settings(
        "onefixer-2b", [f"window={window}", "vae.base=24", "history=last-forward"]
    )
    work = block_work(settings, 544, 960)
    times = measure_blocks(settings, work, 544, 960, "cuda", blocks=10)
    assert times.peak_mb * 1e6 < work.memory_bytes
    assert times.calls["replayed"] >= 10
