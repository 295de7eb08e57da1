"""Which faults of a policy the shipped scenes catch: each drives into the event that its scene names
it for, where the recorded drive and the same policy without the fault have none.
"""

import functools
from pathlib import Path

import pytest

from alpasim_plugin import load_scenario, make_renderer, run_rollout
from evaluators import rollout_values, score
from evaluators.metrics.outcomes import OUTCOMES
from policies.lane_camera import LaneCamera
from policies.simple import LogReplay, PurePursuit
from scenarios.load import catches_of
from scenarios.schema import FAULTS
from scenarios.suite import load_suite, suites
from tests.runs.faulty_policies import (
    BlackImages,
    BrakesLate,
    LateFrames,
    MirroredImages,
    NeverBrakes,
    SpeedInKmh,
)

FAULTY = {
    "blind": PurePursuit,
    "never_brakes": NeverBrakes,
    "brakes_late": BrakesLate,
    "mirrored": MirroredImages,
    "speed_unit": SpeedInKmh,
    "sensor_black": BlackImages,
    "latency": LateFrames,
}
BLIND_SHARE = 1 / 5  # of the scenes of a suite stop a blind driver
QUICK = {"hard-hard_brake", "urban-s_bend"}


@functools.cache
def entries():
    """Return every scene of every suite once, as the suite sets it, by a name for people."""
    refs = {(ref.path, ref.overrides): ref for name in suites() for ref in load_suite(name)}
    return {
        name_of(ref) + (" as suites/first sets it" if ref.overrides else ""): ref
        for ref in refs.values()
    }


def name_of(ref):
    """Return a scene's folder and file, without reading it: names are wanted for every collection."""
    return "-".join(Path(ref.path).with_suffix("").parts[-2:])


def outcomes(scenario, policy):
    """Drive, and return the events that the preset strict counts."""
    renderer = make_renderer("clean", scenario)  # it draws nothing that nobody looks at
    log = run_rollout(scenario, renderer, policy, 0).log()
    values = rollout_values(score(log, scenario.scene, "strict"), "strict")
    return {name for name in OUTCOMES if name in values and values[name].value}


def check(ref, faults):
    scenario = load_scenario(ref.path, ref.seed, ref.overrides)
    assert outcomes(scenario, LogReplay(scenario)) == set()
    if any(issubclass(FAULTY[fault], LaneCamera) for fault in faults):
        assert outcomes(scenario, LaneCamera(scenario)) == set()
    for fault in faults:
        events = outcomes(scenario, FAULTY[fault](scenario))
        assert events, f"{scenario.scene_id} does not catch {fault}"
        if fault == "blind":  # as docs/ci.md says
            assert "collision_at_fault" in events


def test_every_fault_has_a_policy():
    assert FAULTY.keys() == FAULTS.keys()


def test_every_shipped_scene_names_a_fault():
    assert [name for name, ref in entries().items() if not catches_of(ref)] == []


@pytest.mark.parametrize("suite", suites())
def test_every_suite_covers_all_faults_and_a_fifth_of_it_stops_a_blind_driver(suite):
    named = [catches_of(ref) for ref in load_suite(suite)]
    assert {fault for faults in named for fault in faults} == FAULTS.keys()
    assert sum("blind" in faults for faults in named) >= BLIND_SHARE * len(named)


@pytest.mark.parametrize("scene", sorted(QUICK))
def test_scenes_catch_what_shows_without_images(scene):
    ref = entries()[scene]
    faults = [fault for fault in catches_of(ref) if not issubclass(FAULTY[fault], LaneCamera)]
    assert faults
    check(ref, faults)


@pytest.mark.slow
@pytest.mark.parametrize("scene", entries())
def test_every_scene_catches_the_faults_that_it_names(scene):
    check(entries()[scene], catches_of(entries()[scene]))
