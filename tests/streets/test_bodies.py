"""Bodies of road users as they are drawn: no larger than the box with which they touch others."""

import numpy as np
import pytest

from alpasim_plugin.core.geometry import matrix_from_quat
from alpasim_plugin.streets.build_actors import _SHAPES, CELLS_M
from scenarios.traffic import SIZES

PROUD_M = 0.06  # lamps, plates and wheels stand out by so much


def extent(cloud):
    """Return the lowest and the highest corner of a cloud: each Gaussian up to one deviation."""
    turns = np.array([matrix_from_quat(quat) for quat in cloud.quats.astype(np.float64)])
    deviation_m = np.sqrt(np.einsum("nij,nj->ni", turns**2, cloud.scales.astype(np.float64) ** 2))
    return (cloud.means - deviation_m).min(axis=0), (cloud.means + deviation_m).max(axis=0)


@pytest.mark.parametrize("label", ["car", "truck", "bus", "pedestrian", "cyclist", "motorcycle"])
def test_a_body_is_drawn_inside_its_box(label):
    rng = np.random.default_rng(1)
    box = SIZES[label]
    half = np.array(box.size_m) / 2 + PROUD_M
    for draw in rng.random((6, 8)):
        cloud = _SHAPES[label](box, draw, rng.standard_normal(4096), CELLS_M[0])
        low, high = extent(cloud)
        assert (low >= -half).all()
        assert (high <= half).all()
        assert high[0] - low[0] > 0.8 * box.length_m * (label != "pedestrian")
