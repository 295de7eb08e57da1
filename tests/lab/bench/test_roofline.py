"""What frames and blocks cost a card is what the core says."""

from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.lab.bench import roofline
from alpasim_plugin.runs.gpu_work import COUNTED
from tests.gaussians.test_scene_graph import blobs

BLOCKS = [pytest.param(name, marks=pytest.mark.slow) for name in ("finalise", "last-forward")]


@pytest.mark.parametrize("name", ["splats", "cameras: 1", "cameras: 6", *BLOCKS])
def test_the_core_states_what_is_counted(name):
    *found, precision = roofline.COUNTS[name]()
    *stated, stated_precision = COUNTED[name]
    assert found == pytest.approx(stated, rel=1e-3)
    assert precision == stated_precision


def test_bytes_of_a_splat():
    pytest.importorskip("triton", reason="Triton is not installed")
    from alpasim_plugin.gaussians.raster.rasterize_triton import UploadedClouds
    from alpasim_plugin.gaussians.raster.triton_kernels import BOX, RECORD

    cloud = replace(blobs((8, 3, 1), n=12), sh=np.zeros((12, 16, 3)))
    drawn = UploadedClouds([cloud], "cpu")
    parts = drawn.means, drawn.factors, drawn.opacities, drawn.extents, drawn.sh
    written = 4 * (RECORD + BOX) + 8  # its record and box, depth and count
    assert sum(part.nbytes for part in parts) + 2 * 12 * written == roofline.SPLAT_BYTES * 12
