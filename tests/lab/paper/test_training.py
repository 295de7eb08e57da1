"""What every arm was given: stages, time, and the learning rate with its sweep."""

from __future__ import annotations

import pytest

from alpasim_plugin.lab.paper.training import TrainedArm, edge_of, training_section


@pytest.mark.parametrize(
    ("rate", "swept", "edge"),
    [
        (1e-3, (1e-4, 3e-4, 1e-3), "highest"),
        (1e-4, (1e-3, 1e-4), "lowest"),
        (3e-4, (1e-4, 3e-4, 1e-3), None),
        (1e-3, (1e-3,), None),
        (1e-3, (), None),
    ],
)
def test_the_ends_of_a_sweep_are_known(
    rate: float, swept: tuple[float, ...], edge: str | None
) -> None:
    assert edge_of(rate, swept) == edge


def test_the_section_has_every_arm_and_names_those_at_the_end_of_their_sweep() -> None:
    arms = [
        TrainedArm("V9", {"V9": 200}, 9.6, 3e-4, {1e-4: 0.34, 3e-4: 0.33, 1e-3: 0.35}),
        TrainedArm("difix", {"difix": 400}, 0.8, 1e-3, {3e-4: 0.27, 1e-3: 0.26}),
        TrainedArm("gsfix3d", {"teacher": 10, "gsfix3d": 20}, 8.0, 1e-3, {3e-4: 0.5, 1e-3: 0.4}),
    ]
    section = training_section(arms)
    assert (
        "| gsfix3d | teacher 10 + gsfix3d 20 | 8.00 | 0.001 (0.0003: 0.500, 0.001: 0.400) |"
        in section
    )
    assert "The highest rate of its sweep was the best of `difix`, `gsfix3d`:" in section
    assert "lowest rate of its" not in section
    assert training_section([]) == ""
