"""What families of scenes say about a difference: an interval with families as the unit, and the
difference without one of them.

Scenes of one family have their road or their script in common. Where few families differ much, an
interval over scenes is too short for a claim about scenes of other families.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

import numpy as np
import scipy  # its submodules load on first use

from alpasim_plugin.core.metric_types import MetricInfo
from alpasim_plugin.core.types import F64, I64
from alpasim_plugin.log.run_folder.sides import Side
from evaluators.statistics.intervals import cluster_means, within
from evaluators.statistics.paired import Pairs, difference_bounds

LEAST_FAMILIES = 3


def grouped(paths: Mapping[str, str]) -> dict[str, str]:
    """Return SCENE -> its family: the file of scenes made from one by seeds, else the folder of the
    scene's file.
    """
    by_file = len(set(paths.values())) <= len(paths) / 2
    return {scene: path if by_file else PurePath(path).parent.name for scene, path in paths.items()}


def family_bounds(means: F64, family: I64) -> list[float]:
    """Return [low, high] of the mean ``(G,)`` of scenes with their families ``(G,)`` as clusters: t
    with one degree less than families.

    The variance is that of sums of families' residuals (Liang and Zeger, Biometrika 73, 1986),
    times F / (F - 1).

    >>> [round(end, 3) for end in family_bounds(np.array([0.0, 0.0, 1.0, 1.0, 2.0, 2.0]), np.array([0, 0, 1, 1, 2, 2]))]
    [-1.484, 3.484]
    """
    centre, sums = float(np.mean(means)), np.bincount(family, means - np.mean(means))
    n = len(sums)
    half = float(
        scipy.special.stdtrit(n - 1, 0.975) * np.sqrt(n / (n - 1) * np.sum(sums**2)) / len(means)
    )
    return [centre - half, centre + half]


def by_family(
    here: Side, there: Side, metric: MetricInfo, family_of: Mapping[str, str], margin: float
) -> dict[str, Any] | None:
    """Return the families' view of a difference; None with fewer than three of them.

    Args:
        here, there: The rollouts of both arms.
        metric: What is compared.
        family_of: SCENE -> its family; a scene that it lacks is a family of its own.
        margin: How much worse is accepted.

    Returns:
        ``n``; ``ci95`` with families as the unit; ``without``: the ``family`` that moves the
        difference most, and ``diff`` and ``ci95`` (scenes as unit) of the scenes of the others.
    """
    pairs = Pairs(here, there, metric.name)
    if not len(pairs.mine):
        return None
    delta = pairs.mine - pairs.base
    code, first = np.unique(here.scene, return_index=True)
    scene_name = {int(k): here.cells[int(i)][1] for k, i in zip(code, first, strict=True)}
    names = [family_of.get(scene_name[k], scene_name[k]) for k in pairs.scenes.tolist()]
    labels = sorted(set(names))
    if len(labels) < LEAST_FAMILIES or not np.isfinite(delta).all():
        return None
    family = np.array([labels.index(name) for name in names])
    means, _ = cluster_means(delta, pairs.scenes)
    of_scene = family[np.unique(pairs.scenes, return_index=True)[1]]
    low, high = metric.difference_range
    ends = [float(np.clip(end, low, high)) for end in family_bounds(means, of_scene)]
    left = [abs(float(np.mean(means[of_scene != k]) - np.mean(means))) for k in range(len(labels))]
    out = int(np.argmax(left))
    rest, _ = difference_bounds(delta[family != out], pairs.scenes[family != out], metric, margin)
    rest = within(rest, low, high)
    return {
        "n": len(labels),
        "ci95": ends,
        "without": {"family": labels[out], "diff": rest.centre, "ci95": rest.bounds},
    }
