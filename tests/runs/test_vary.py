"""Searches for a boundary over real rollouts: found, continued, out of range, and refused."""

import json
import shutil
from types import SimpleNamespace

import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.seeding import derive_seed
from alpasim_plugin.log.run_folder.records import MetricValue
from alpasim_plugin.log.run_folder.schema import SUMMARY
from alpasim_plugin.runs.plan import RunOptions, make_plan
from alpasim_plugin.runs.vary import BoundarySearch, Sweep, has_failed
from evaluators.statistics.boundary import PARTS
from scenarios.suite import ScenarioRef

DRIVE = ["--renderer", "clean", "--policy", "pure-pursuit", "--workers", "1"]
DRIVE += ["--images", "none", "--video", "none"]
PLAIN = ["--set", "environment.buildings=0"]
GAP = ["--vary", "actors.cutter.s_m=10..30"]


def drive(root, *words):
    assert run_command([*DRIVE, *PLAIN, *words, "hard/cut_in", "--out", str(root)]) == 0
    return json.loads((root / SUMMARY).read_text())["boundary"]


@pytest.fixture(scope="module")
def searched(tmp_path_factory):
    root = tmp_path_factory.mktemp("vary") / "run"
    return root, drive(root, *GAP)


@pytest.mark.slow
def test_the_boundary_of_a_gap_is_found_with_few_rollouts(searched):
    root, found = searched
    facts = found["variants"]["clean/pure-pursuit"]
    fails, holds = facts["stretches"]
    assert (fails["low"], holds["high"]) == (10, 30)
    assert holds["low"] - fails["high"] == pytest.approx(20 / 64)
    assert 21 < fails["high"] < 24
    assert found["apart"] == found["spacing"] == 20 / 16
    assert found["rollouts"] == len(facts["outcomes"]["0"]) == 17 + 2
    for name in ("report.html", "summary.md"):
        assert "pure-pursuit fails from 10 to" in (root / name).read_text()


@pytest.mark.slow
def test_an_interrupted_search_continues_to_the_same_boundary(searched, tmp_path, capsys):
    root = shutil.copytree(searched[0], tmp_path / "again")
    (root / SUMMARY).unlink()
    removed = sorted((root / "rollouts/clean/pure-pursuit").iterdir())[-1]
    shutil.rmtree(removed)
    assert drive(root, *GAP) == searched[1]
    assert removed.exists()


@pytest.mark.slow
def test_a_range_without_a_failure_and_points_that_cannot_be_built_are_said(tmp_path):
    found = drive(tmp_path / "run", "--vary", "actors.cutter.s_m=35..2000")
    assert "no failure from 35 to" in found["sentence"]
    assert found["reachable"][1] < 2000
    assert found["unreachable"]
    assert "cannot be built" in found["sentence"]
    gate = tmp_path / "gate.yaml"
    gate.write_text("version: 1\nboundary_margin: 0.5\n")
    command = ["gate", str(tmp_path / "run"), "--gate", str(gate)]
    assert run_command([*command, "--baseline-file", str(tmp_path / "run")]) == 0
    assert run_command(command) == 2  # one variant, and nothing to compare it with


def test_the_record_of_a_search_is_of_the_part_that_can_be_built_and_of_the_variant_minus_its_base():
    ref = ScenarioRef("hard/cut_in", None, ("environment.buildings=0",))
    options = RunOptions(baseline="constant-velocity")

    def planned(refs):
        return make_plan(refs, ["clean"], ["constant-velocity", "pure-pursuit"], [0], options)

    sweep = Sweep.parse("actors.cutter.s_m=35..435/200")
    search = BoundarySearch(planned([ref]), (sweep,), planned)
    (part,) = search.reached
    assert (part.low, part.high) == (35, 235)
    first = [(step,) for step in part.first]
    policies = {variant.policy: variant for variant in search.variants}
    search.failed[policies["constant-velocity"], 0] = dict.fromkeys(first, False)
    search.failed[policies["pure-pursuit"], 0] = {first[0]: True, **dict.fromkeys(first[1:], False)}
    record = search.record()
    assert record["range"] == [35, 435]
    assert record["reachable"] == [part.low, part.high]
    assert record["spacing"] == (part.high - part.low) / 2
    assert record["first"] == [part.values[step] for step in part.first]
    assert record["grid_rollouts"] == 2 * (2 * PARTS + 1)
    (difference,) = record["differences"].values()
    assert (difference["baseline"], difference["gained"], difference["lost"]) == (
        "clean/constant-velocity",
        1,
        0,
    )
    assert difference["more"] == pytest.approx(record["spacing"] / 2)


@pytest.mark.parametrize(
    ("vary", "named"),
    [
        ("actors.cuter.s_m=4..14", "cutter"),
        ("actors.cutter.s_m=14..4", "14..4"),
        ("actors.cutter.s_m=a..b", "a..b"),
        ("actors.cutter.at_us=0..3", "0..3"),  # four values
        ("version=1..2", "version"),  # built at one of them
        ("actors.cutter.s_m=4..14/0", "step of 0"),
        ("actors.cutter.s_m=4..14/20", "step of 20"),
        ("actors.cutter.s_m=4..14/fine", "fine"),
        ("actors.cutter.s_m", "actors.cutter.s_m"),
        ("seed=0..64", "seed"),
        ("ego.lane=0..1", "lane"),  # a whole number
        ("actors.cutter.s_m=4..14 actors.cutter.s_m=4..15", "actors.cutter.s_m"),
        ("actors.cutter.s_m=4..14 ego.speed_mps=4..4", "4..4"),
        ("actors.cutter.s_m=4..14 ego.sped_mps=4..9", "speed_mps"),
        ("actors.cutter.s_m=4..14 ego.speed_mps=4..9 ego.cruise_mps=4..9", "3"),
    ],
)
def test_a_parameter_or_range_that_is_none_is_refused_before_driving(vary, named, tmp_path, capsys):
    words = [*DRIVE, *(word for one in vary.split() for word in ("--vary", one)), "--dry-run"]
    words += ["hard/cut_in", "--out", str(tmp_path / "run")]
    assert run_command(words) == 2
    assert named in capsys.readouterr().err


@pytest.mark.parametrize("more", [["smoke/straight"], ["--repeat"], ["--until-decided"]])
def test_a_search_takes_one_scene_and_no_other_question(more, tmp_path):
    words = [*DRIVE, *GAP, *more, "--dry-run", "hard/cut_in", "--out", str(tmp_path / "run")]
    assert run_command(words) == 2


def test_a_vehicle_that_follows_exactly_is_refused_on_a_slippery_road(tmp_path, capsys):
    words = ["--set", "environment.friction=0.3", "--dry-run", "hard/cut_in"]
    words += ["--out", str(tmp_path / "run"), "--renderer", "clean", "--policy"]
    assert run_command([*words, "log-replay"]) == 2
    assert "friction = 0.3" in capsys.readouterr().err
    assert run_command([*words, "log-replay", "--controller", "bicycle"]) == 0


def test_a_point_keeps_the_noise_of_its_scene():
    assert (
        derive_seed("a-b@@4.5", 1, "x") == derive_seed("a-b", 1, "x") != derive_seed("a@@b", 1, "x")
    )
    assert derive_seed("a-b@@4.5@@2-seed3", 1, "x") == derive_seed("a-b-seed3", 1, "x")


def test_times_stay_whole():
    sweep = Sweep.parse("actors.cutter.at_us=100..200")
    assert all(value.is_integer() for value in sweep.values)
    with pytest.raises(InputError):
        Sweep.parse("ego.speed_mps=nan..3")


def test_a_step_is_the_largest_distance_of_first_points():
    sweep = Sweep.parse("actors.cutter.s_m=4..14/3")
    assert [sweep.values[step] for step in sweep.first] == [4, 6.5, 9, 11.5, 14]
    sweep = Sweep.parse("actors.cutter.s_m=-3..4/0.1")
    assert (sweep.spacings, len(sweep.first)) == (70, 71)


@pytest.mark.parametrize(
    ("name", "value", "failed"),
    [("ended_in_danger", 1.0, True), ("stalled", 1.0, True), ("collision_any", 0.0, False)],
)
def test_every_outcome_of_a_drive_is_a_failure_of_a_point(name, value, failed):
    values = {"collision_any": 0.0, "offroad": 0.0} | {name: value}
    manifest = SimpleNamespace(
        ok=True,
        metrics={
            metric: MetricValue(number, True, "", "", "lower") for metric, number in values.items()
        },
    )
    assert has_failed(manifest) is failed
    assert has_failed(SimpleNamespace(ok=True, metrics={})) is None
