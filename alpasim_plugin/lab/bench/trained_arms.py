"""Read from a folder of `simrun train arms` how its arms were trained, and which of them another
budget would train the same.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from alpasim_plugin.core.reading import parsing, read_json_object
from alpasim_plugin.lab.paper.training import WITHIN, TrainedArm
from alpasim_plugin.lab.training.arms.run import PLAN_FILE, arms_of, minutes_of
from alpasim_plugin.lab.training.fixer_run import BUNDLE_FILE
from alpasim_plugin.lab.training.snapshots import core_seconds
from alpasim_plugin.lab.video_metrics.perceptual_net import NAME as PERCEPTUAL

DOING = "reading how an arm was trained"
DO = "train the arms again with 'simrun train arms'"
# Arms of which the paper reports some numbers of steps: each is a row of its own, ARM@N.
STEPS: Mapping[str, tuple[int | None, ...]] = {
    "omnidreams": (1, 4),
    "artifixer-pre": (1, 4),
    "gsfix3d": (8,),
    "3dgs-enhancer": (8,),
}
TRANSFER_STEPS: Mapping[str, tuple[int | None, ...]] = {
    "artifixer": (None, 4)
}  # the paper's DL3DV table has it after DMD at 1 and 4


def trained_arms(folder: Path, names: Collection[str] | None = None) -> tuple[TrainedArm, ...]:
    """Return how each arm was trained, in the order in which they were planned.

    Args:
        folder: Of `simrun train arms`; of another one, such as one with arms that were trained one
            by one, nothing is known.
        names: Only these arms; None: those that are finished.

    Raises:
        InputError: A log or a card that is missing or not whole.
    """
    if not (folder / PLAN_FILE).is_file():
        return ()
    found = arms_of(folder)
    finished = (
        [arm for arm in found if (folder / arm / BUNDLE_FILE).is_file()]
        if names is None
        else [arm for arm in found if arm in names]
    )
    return tuple(_trained(folder, arm, found[arm]) for arm in finished)


def within_budget(trained: Sequence[TrainedArm], folder: Path) -> tuple[TrainedArm, ...]:
    """Return the arms that need no second training for equal core-minutes: theirs took as long
    already, within `WITHIN`.

    Args:
        trained: With the paper's updates.
        folder: Of `simrun train arms --budget minutes`; an arm that was trained there is left out.
            Of another folder nothing is known.

    Raises:
        InputError: A plan that is not whole.
    """
    minutes = minutes_of(folder) if (folder / PLAN_FILE).is_file() else None
    if minutes is None:
        return ()
    return tuple(
        one
        for one in trained
        if abs(one.core_minutes / minutes - 1.0) <= WITHIN
        and not (folder / one.arm / BUNDLE_FILE).is_file()
    )


def _trained(folder: Path, arm: str, trainings: list[str]) -> TrainedArm:
    times = {name: core_seconds(folder / name) for name in trainings}
    path = (folder / arm / BUNDLE_FILE).with_suffix(".card.json")
    card = read_json_object(path, do_this=DO)
    with parsing(path, DO, "no card of a training"):
        rate = float(card["training"]["schedule"]["peak_lr"])
        scores = card.get("sweep", {}).get("scores", {})
        swept = {float(at): float(values[PERCEPTUAL]) for at, values in scores.items()}
    stages = {name: len(found) for name, found in times.items()}
    return TrainedArm(arm, stages, sum(found[-1] for found in times.values()) / 60, rate, swept)
