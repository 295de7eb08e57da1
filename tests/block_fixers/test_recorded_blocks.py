"""Blocks through recordings at fixed addresses are the blocks themselves, also when one is made
again.
"""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from alpasim_plugin.block_fixers.graphs import CudaRecorder, GraphedFunction
from alpasim_plugin.block_fixers.pipeline import BlockPipeline
from tests.block_fixers.eager_recorder import EagerRecorder
from tests.block_fixers.fixer_cases import busy_settings, fixer, run_blocks
from tests.examples import first_of
from tests.fixers.clip_cases import maps_of, moving_picture

CASES = [
    (),
    ("steps=[1000,500]", "window=4", "sink=1"),
    ("history=finalise",),
    ("window=1",),
    ("decoder.kind=latent", "uses_map=false"),
]


def frames_of(session, frames, redo=()):
    """Return every frame's pixels; blocks named in ``redo`` are first made with other pictures and
    taken back.
    """
    maps = maps_of(frames)
    out = []
    block = 0
    while len(out) < len(frames):
        cut = slice(len(out), len(out) + session.blocks.frames(block))
        if block in redo:
            session.preview(frames[cut], [image[::-1].copy() for image in maps[cut]])
        out += session.step(frames[cut], maps[cut])
        block += 1
    return [frame.rgb for frame in out]


@pytest.mark.parametrize("overrides", first_of(CASES, 2), ids=",".join)
def test_recorded_blocks_equal_eager_ones(weights: Path, overrides: tuple[str, ...]) -> None:
    settings = busy_settings(weights, *overrides)
    frames = moving_picture(5 + 8 * 7)
    plain, recorded = fixer(settings), fixer(settings)
    recorded.pipeline = BlockPipeline(recorded.networks, settings, recorder=EagerRecorder())
    for ours, due in zip(
        frames_of(recorded, frames, redo=(2, 6)), frames_of(plain, frames), strict=True
    ):
        assert (ours == due).all()
    history = recorded._history[0].state.history
    assert isinstance(history.fix, GraphedFunction)
    assert history.fix.counts["replayed"] >= 1
    assert history.fix.counts["beyond limit"] == 0


def test_a_clock_at_the_stages_runs_them_one_by_one(weights: Path) -> None:
    settings = busy_settings(weights)
    session = fixer(settings)
    session.pipeline = BlockPipeline(session.networks, settings, recorder=EagerRecorder())
    seen = []

    class Clock:
        def __init__(self, name: str) -> None:
            self.name = name

        def __enter__(self) -> None:
            seen.append(self.name)

        def __exit__(self, *error: object) -> None:
            pass

    session.pipeline.stage = Clock
    frames = moving_picture(5 + 8)
    run_blocks(session, frames, maps_of(frames))
    assert set(seen) == {"encode", "source", "dit", "decode", "cache write"}
    assert session._history[0].state.history.fix.counts == {"unrecorded": 2}


@pytest.mark.gpu
@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_cuda_graphs_equal_eager_blocks(weights: Path, precision: str) -> None:
    settings = busy_settings(weights, f"precision={precision}", f"codec_precision={precision}")
    frames = moving_picture(5 + 8 * 9)
    sessions = [type(fixer(settings))(settings, "scene", 0, "cuda") for _ in range(2)]
    sessions[1].pipeline = BlockPipeline(
        sessions[1].networks, settings.model_copy(update={"graphs": "off"})
    )
    assert isinstance(sessions[0].pipeline.recorder, CudaRecorder)
    assert sessions[1].pipeline.recorder is None
    for ours, due in zip(
        *(frames_of(session, frames, redo=(6,)) for session in sessions), strict=True
    ):
        assert (ours == due).all()
    assert sessions[0]._history[0].state.history.fix.counts["replayed"] >= 3
    torch.cuda.synchronize()
