"""Class-colour augmentation of a drawn map equals drawing it with the other class, and changes
nothing else.
"""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import se2
from alpasim_plugin.fixers.semantic_map.draw import draw_map
from alpasim_plugin.fixers.semantic_map.prepare import ActorBox, prepare_map
from alpasim_plugin.fixers.semantic_map.style import COLOURS
from alpasim_plugin.lab.training.class_colours import OTHERS, swap_class_colours
from tests.fixers.views import CAR, EMPTY, PIN, at, line

LABELS = {"truck": "truck", "cyclist": "rider", "pedestrian": "person", "other": "dog"}


def drawn(label):
    edges = replace(
        EMPTY,
        road_edges=(line((2, 3, 0), (60, 3, 0)),),
        crosswalks=(np.array([[14, -4, 0], [17, -4, 0], [17, 4, 0], [14, 4, 0.0]]),),
    )
    boxes = (
        ActorBox(se2(10, 0.5, 0.4, 0.8), CAR, label),
        ActorBox(se2(30, -3, 2.0, 0.8), CAR, label),
    )
    return draw_map(prepare_map(edges), PIN, at(), boxes)


@pytest.mark.parametrize("kind", OTHERS)
def test_augmented_cars_have_the_colours_of_the_other_class(kind):
    car = drawn("car")
    wanted = drawn(LABELS[kind])
    made = swap_class_colours(car, kind)
    differs = (car != wanted).any(axis=-1)
    off = np.abs(made.astype(int) - wanted).max(axis=-1)
    assert differs.sum() > 100
    assert (off[differs] <= 6).mean() > 0.85, (
        "but for pixels that a box shares with its grey edges or with paint"
    )
    assert_array_equal(made[~differs], car[~differs])


@pytest.mark.parametrize("paint", COLOURS)
@pytest.mark.parametrize("kind", OTHERS)
def test_paint_of_every_colour_and_darkness_stays(paint, kind):
    shares = np.linspace(0.1, 1.0, 64)[None, :, None]
    faded = np.rint(shares * np.array(COLOURS[paint])).astype(np.uint8)
    assert_array_equal(swap_class_colours(faded, kind), faded)


def test_an_unknown_class_is_refused():
    with pytest.raises(InputError):
        swap_class_colours(drawn("car"), "tram")
