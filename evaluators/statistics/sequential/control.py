"""Take out variance that is known beforehand: families of scenes, or how hard an earlier run found
each scene.

For a finite suite the mean of anything known of its scenes is known, over all of them and over
those that are left. So a prediction of a scene's difference may be taken off, and the mean
prediction over the scenes left put back: the expectation given all earlier scenes stays, whatever
the prediction is worth. Its coefficients come from earlier scenes alone (a control variate with
predictable coefficients; families as control give what stratified order gives, `draws.py`, once
their means are learnt). A poor control costs a little speed, never the guarantee.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.parts import digest
from alpasim_plugin.core.types import F64, I64
from alpasim_plugin.log.run_folder.sides import Row, by_renderer
from evaluators.statistics.sequential.draws import (
    Draws,
    Strata,
    families_of,
    stratified,
    without_replacement,
)
from evaluators.statistics.sequential.question import MetricQuestion

LEAST_SCENES = 5  # before the first coefficient
RIDGE = 1.0  # scenes' worth of shrinkage of every standardised coefficient
LEAST_KNOWN = 0.5  # share of the suite that an earlier run must hold
DOING = "reading a control"


@dataclass(frozen=True)
class Control:
    """What is known of every scene of a suite.

    Attributes:
        features: SCENE -> ``(q,)`` numbers.
        names: What they are, ``q`` of them.
    """

    features: Mapping[str, tuple[float, ...]]
    names: tuple[str, ...]

    @property
    def digest(self) -> str:
        """Give a digest of all values."""
        return digest(
            [self.names, sorted((scene, values) for scene, values in self.features.items())]
        )

    @property
    def facts(self) -> dict[str, Any]:
        """Give what decision.json says of it."""
        return {"features": list(self.names), "digest": self.digest[:12]}


def join(first: Control, second: Control) -> Control:
    """Return both controls as one."""
    return Control(
        {scene: (*values, *second.features[scene]) for scene, values in first.features.items()},
        (*first.names, *second.names),
    )


def of_families(paths: Mapping[str, str]) -> Control:
    """Return the families of scenes as control (`families_of`).

    Args:
        paths: SCENE -> path of its scenario.

    Raises:
        InputError: There is only one family.
    """
    family = families_of(paths, "--control family")
    names = sorted(set(family.values()))
    short = [PurePath(name).stem for name in names]
    return Control(
        {s: tuple(float(family[s] == name) for name in names) for s in paths},
        tuple(f"family {name}" for name in short),
    )


def of_rows(
    rows: Sequence[Row],
    metric: str,
    scenes: Sequence[str],
    candidate: str,
    baseline: str,
    where: str,
) -> Control:
    """Return an earlier run as control: its paired difference scene by scene, and how hard the
    baseline found the scene.

    A scene that the earlier run does not hold gets the mean of the others.

    Args:
        rows: Of the earlier run.
        metric: Its name.
        scenes: Of the suite.
        candidate: Renderer in question.
        baseline: Renderer that it is compared with.
        where: The earlier run, for errors.

    Raises:
        InputError: The run has fewer than half of the scenes with a value of the metric.
    """
    sides = by_renderer(rows)
    means = {
        name: _scene_means(sides[name], metric) for name in (candidate, baseline) if name in sides
    }
    found: dict[str, dict[str, float]] = {}
    if len(means) == 2:
        both = means[candidate].keys() & means[baseline].keys()
        found[f"earlier difference of {candidate}"] = {
            scene: means[candidate][scene] - means[baseline][scene] for scene in both
        }
    found |= {
        f"earlier {metric} of {name}": values
        for name, values in means.items()
        if name == baseline or len(means) == 1
    }
    known = [scene for scene in scenes if all(scene in values for values in found.values())]
    if not found or len(known) < LEAST_KNOWN * len(scenes):
        raise InputError(
            f"{where}: {len(known) if found else 0} of {len(scenes)} scenes have {metric} of {baseline} or {candidate}",
            "name a run of the same suite with one of the two renderers",
        )
    middle = {
        name: float(np.mean([values[scene] for scene in known])) for name, values in found.items()
    }
    return Control(
        {s: tuple(values.get(s, middle[name]) for name, values in found.items()) for s in scenes},
        tuple(found),
    )


def adjusted_draws(
    values: F64,
    one: MetricQuestion,
    order: Sequence[str],
    control: Control | None,
    strata: Strata | None = None,
) -> Draws:
    """Return the draws of a finite suite, less what a control predicts.

    Args:
        values: ``(n,)`` differences of the first n scenes, positive is worse; scenes without one
            are NaN and are left out of the suite.
        one: The question about the metric.
        order: All scenes of the suite in the order of the drawing.
        control: None: nothing is taken off.
        strata: Of the order; None: it is random.
    """
    low, high = one.harm_bounds
    known = np.isfinite(values)
    at = np.flatnonzero(known)
    begin = (
        np.arange(len(at))
        if strata is None
        else np.searchsorted(at, strata.begins(len(values))[at])
    )
    kept = [scene for i, scene in enumerate(order) if i >= len(values) or known[i]]
    x = values[known]
    features = None if control is None else np.array([control.features[scene] for scene in kept])
    removed, reach = (None, None) if features is None else predictions(x, features, begin)
    if strata is None:
        return without_replacement(x, low, high, len(kept), removed, reach)
    return stratified(
        x,
        low,
        high,
        strata.numbers(kept),
        begin,
        removed,
        reach,
        less_means=one.method == "asymptotic",
    )


def predictions(x: F64, z: F64, begin: I64 | None = None) -> tuple[F64, F64]:
    """Return what is taken off each draw, and its greatest possible size, both ``(n,)``.

    Args:
        x: ``(n,)`` differences in the order drawn.
        z: ``(size, q)`` features of all scenes, those drawn first.
        begin: ``(n,)`` first scenes of the batches, before which all is known; None: every scene is
            a batch.
    """
    n, size = len(x), len(z)
    begin = np.arange(n) if begin is None else begin
    z = (z - z.mean(axis=0)) / np.where(np.ptp(z, axis=0) > 0.0, z.std(axis=0), 1.0)
    coefficients = _coefficients(x, z[:n])[begin]
    rest = (z.sum(axis=0) - np.cumsum(z[:n], axis=0) + z[:n])[begin] / (size - begin)[
        :, None
    ]  # mean over the scenes left
    removed = np.sum(coefficients * (z[:n] - rest), axis=1)
    reach = np.array(
        [np.max(np.abs((z[i:] - rest[i]) @ coefficients[i])) for i in np.unique(begin)]
    )
    return removed, reach[np.unique(begin, return_inverse=True)[1].reshape(-1)]


def _coefficients(x: F64, z: F64) -> F64:
    """Return the ridge coefficients ``(n, q)`` that the scenes before each give; 0 for the first
    few.
    """
    n, q = z.shape
    count = np.arange(n, dtype=np.float64)[:, None]  # scenes before
    before = np.maximum(count, 1.0)
    sum_x, sum_z = np.cumsum(x)[:, None] - x[:, None], np.cumsum(z, axis=0) - z
    zz = np.cumsum(z[:, :, None] * z[:, None, :], axis=0) - z[:, :, None] * z[:, None, :]
    zx = np.cumsum(z * x[:, None], axis=0) - z * x[:, None]
    centred = zz - sum_z[:, :, None] * sum_z[:, None, :] / before[:, :, None]
    found = np.linalg.solve(centred + RIDGE * np.eye(q), (zx - sum_z * sum_x / before)[:, :, None])[
        :, :, 0
    ]
    return np.where(count >= LEAST_SCENES, found, 0.0)


def _scene_means(side: Any, metric: str) -> dict[str, float]:
    values = side.values(metric)
    found: dict[str, list[float]] = {}
    for (_, scene, _), value in zip(side.cells, values, strict=True):
        if np.isfinite(value):
            found.setdefault(scene, []).append(float(value))
    return {scene: float(np.mean(some)) for scene, some in found.items()}
