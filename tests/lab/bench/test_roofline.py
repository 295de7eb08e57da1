"""What frames and blocks cost a card is what the core says."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from alpasim_plugin.lab.bench import roofline
from alpasim_plugin.runs.gpu_work import COUNTED
from tests.gaussians.graph_scenes import blobs
from tests.pretended_device import pretended_device

SMALL = ["blocks=1", "width=32", "head_width=16", "mlp_width=32", "text_width=8", "context_width=8"]
SMALL = [*(f"dit.{size}" for size in SMALL), "vae.base=8", "precision=fp32", "codec_precision=fp32"]


@pytest.mark.parametrize("name", COUNTED)
def test_the_core_states_what_is_counted(name):
    *found, precision = roofline.COUNTS[name]()
    *stated, stated_precision = COUNTED[name]
    assert found == pytest.approx(stated, rel=1e-3)
    assert precision == stated_precision


@pytest.mark.slow
@pytest.mark.parametrize(
    ("history", "gflop", "gb"), [("finalise", 54830.0, 60.985), ("last-forward", 29475.85, 41.772)]
)
def test_the_page_states_what_a_block_costs(history, gflop, gb):
    assert roofline.block_work(history)[:2] == pytest.approx((gflop, gb), rel=1e-3)


def test_a_block_is_timed_beside_a_cards_peak(monkeypatch):
    monkeypatch.setattr(roofline, "facts_of", lambda device: {"card": "NVIDIA H200"})
    monkeypatch.setattr(roofline, "MIDDLE", (32, 32))
    monkeypatch.setattr(roofline, "fixer_settings", partial(small, roofline.fixer_settings))
    with pretended_device(monkeypatch) as traffic:
        said = roofline.timed("cuda:0", "finalise", roofline.Work(1e5, 1.0, "bf16"))
        assert traffic.launches
    assert "ms on NVIDIA H200" in said
    assert said.endswith("of its peak")


def small(make, name, given):
    return make(name, [*given, *SMALL])


def test_bytes_of_a_splat():
    pytest.importorskip("triton", reason="Triton is not installed")
    from alpasim_plugin.gaussians.raster.rasterize_triton import UploadedClouds
    from alpasim_plugin.gaussians.raster.triton_kernels import BOX, RECORD

    cloud = replace(blobs((8, 3, 1), n=12), sh=np.zeros((12, 16, 3)))
    drawn = UploadedClouds([cloud], "cpu")
    parts = drawn.means, drawn.factors, drawn.opacities, drawn.extents, drawn.sh
    written = 4 * (RECORD + BOX) + 8  # its record and box, depth and count
    assert sum(part.nbytes for part in parts) + 2 * 12 * written == roofline.SPLAT_BYTES * 12
