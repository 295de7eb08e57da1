"""The table that tells what the same rollouts come to under several presets."""

from __future__ import annotations

from alpasim_plugin.core.types import Box, LaneMap
from alpasim_plugin.lab.bench.preset_conversion import as_markdown, conversion_table, convert
from tests.evaluators.eval_build import TWO_LANES, car, rollout, scene, track

NAMES = ("paper", "alpasim", "strict")


def converted():
    runner = rollout(
        track([0.0, 0.1], 0.0), [car("runner", track(1.0, [1.5, -1.5]), Box(0.3, 0.3, 1.0))]
    )
    calm = rollout(track([0.0, 1.0], 0.0), [car("far", track(50.0, 0.0, n=2))])
    lost = rollout(track([0.0, 1.0], -30.0))
    cases = {
        "runner": (runner, TWO_LANES),
        "calm": (calm, TWO_LANES),
        "lost": (lost, TWO_LANES),
        "no map": (calm, LaneMap({})),
    }
    return [convert(name, log, scene(lanes, log), NAMES) for name, (log, lanes) in cases.items()]


def test_counts_means_and_differences_from_the_first_preset():
    rows = {one.metric: one for one in conversion_table(converted(), NAMES)}
    hit = rows["collision_any"]
    assert (hit.n, hit.total, hit.differ) == (
        (4, 4, 3),
        (0.0, 0.0, 1.0),
        (0, 0, 2),
    )  # the runner, and the refused rollout
    off = rows["offroad"]
    # Far beyond the edge is on the road for the first two; AlpaSim's rule gives no value without a
    # map either.
    assert (off.n, off.total, off.differ) == ((3, 3, 3), (0.0, 0.0, 1.0), (0, 0, 1))
    margin = rows["offroad_margin_m"]
    assert margin.n == (0, 0, 3)
    assert margin.differ == (0, 0, 0)
    assert margin.unit == "m"


def test_a_preset_that_refuses_a_rollout_is_named_with_the_reason():
    found = converted()
    assert list(found[3].values) == ["paper", "alpasim"]
    text = as_markdown(conversion_table(found, NAMES), found)
    assert "| `collision_any` | 0 of 4 | 0 of 4 | 1 of 3 | - | 2 |" in text
    assert "`strict` refused 1 of 4 rollouts: the map has no lanes." in text
