"""Twenty bad parts as a policy, a renderer, a fixer, an evaluator and a served policy: each is named
as what it is, and every other rollout is byte-equal to one of a run without it.
"""

import json
import shlex
import sys
import time
from pathlib import Path

import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.log.run_folder.reader import read_json
from tests.runs.bad_parts import FAULTS, FAULTS_OF_PLANS, HARMLESS

FILE = Path(__file__).with_name("bad_parts.py")
SHORT = ("--set", "timing.duration_us=900000", "--set", "timing.warmup_us=200000", "--no-report")
LIMIT_S = 30  # three times what a rollout takes with the start of its worker on a busy machine
START_S = 120  # for a run to start and to end on a busy machine
CLASSES = {"policy": "policy", "renderer": "renderer fault", "fixer": "fixer fault"}
HANGING = {"sleep", "spin"}


def bad(kind, faults):
    """Return the parts of a kind as a list of names on the command line."""
    over = "+clean" if kind == "fixer" else ""
    return [f"{FILE}:{kind}_{fault}{over}" for fault in faults]


def drive(folder, policies, renderers=("clean",), workers=2, *more):
    words = ["run", "--policy", ",".join(policies), "--renderer", ",".join(renderers), *SHORT]
    words += ["--workers", str(workers), *more]
    code = run_command([*words, "--out", str(folder), "smoke/straight"])
    manifests = [read_json(path) for path in folder.glob("rollouts/*/*/*/*/manifest.json")]
    return code, manifests


def limit(faults):
    return ("--time-limit", str(LIMIT_S)) if HANGING & {*faults} else ()


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Give the logs of a run without bad parts, by policy."""
    folder = tmp_path_factory.mktemp("alone")
    _, manifests = drive(folder, ["constant-velocity", f"{FILE}:Watcher"])
    return {one["policy"]: log_of(folder, one) for one in manifests}


def log_of(folder, manifest):
    return (folder / manifest["path"] / "rollout.asl").read_bytes()


def named(manifests, key, fault):
    names = [one[key].removesuffix("+clean").rpartition(":")[2] for one in manifests]
    return manifests[[name.partition("_")[2] for name in names].index(fault)]


def check(folder, manifests, key, kind, faults):
    for fault in faults:
        manifest = named(manifests, key, fault)
        if manifest["status"] != "ok":
            assert manifest["error"]["failure_class"] == CLASSES[kind], (fault, manifest["error"])
            assert "bad_parts.py:" in manifest["error"]["message"], (fault, manifest["error"])
        assert manifest["status"] == "failed" or fault in HARMLESS, fault


@pytest.mark.slow
@pytest.mark.parametrize("faults", [(*FAULTS, *FAULTS_OF_PLANS)], ids=["all"])
def test_a_bad_policy_is_named_and_ends_no_other_rollout(tmp_path, alone, faults):
    code, manifests = drive(
        tmp_path, ["constant-velocity", *bad("policy", faults)], ("clean",), 2, *limit(faults)
    )
    check(tmp_path, manifests, "policy", "policy", faults)
    good = next(one for one in manifests if one["policy"] == "constant-velocity")
    assert log_of(tmp_path, good) == alone["constant-velocity"]
    assert code == 2
    assert (tmp_path / "summary.json").exists()


@pytest.mark.parametrize("kind", ["renderer", "fixer"])
@pytest.mark.slow
@pytest.mark.parametrize("faults", [tuple(FAULTS)], ids=["all"])
def test_a_bad_renderer_or_fixer_is_named_and_ends_no_other_rollout(tmp_path, alone, kind, faults):
    watcher = f"{FILE}:Watcher"
    renderers = ["clean", *bad(kind, faults)]
    code, manifests = drive(tmp_path, [watcher], renderers, 2, *limit(faults))
    check(tmp_path, manifests, "renderer", kind, faults)
    good = next(one for one in manifests if one["renderer"] == "clean")
    assert log_of(tmp_path, good) == alone[watcher]
    assert code == 2


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_a_bad_evaluator_is_named_and_keeps_the_logs(tmp_path, alone, fault):
    more = ("--evaluator", f"{FILE}:evaluator_{fault}", *limit([fault]))
    began_s = time.monotonic()
    code, (manifest,) = drive(tmp_path, ["constant-velocity"], ("clean",), 1, *more)
    if fault in HANGING:
        assert time.monotonic() - began_s < LIMIT_S + 10 + START_S
    assert log_of(tmp_path, manifest) == alone["constant-velocity"]
    if fault not in HARMLESS:
        assert code == 5
        assert manifest["error"]["failure_class"] == "evaluator"
        assert "bad_parts.py:" in manifest["error"]["message"]


@pytest.mark.slow
def test_a_bad_served_policy_is_named_and_ends_no_other_rollout(tmp_path, alone):
    python = shlex.quote(sys.executable)
    faults = (*FAULTS, *FAULTS_OF_PLANS)
    commands = [f"exec:{python} {FILE} {fault}" for fault in faults]
    driven = ["constant-velocity", *commands]
    code, manifests = drive(tmp_path, driven, ("clean",), 2, *limit(faults))
    good = next(one for one in manifests if one["policy"] == "constant-velocity")
    assert log_of(tmp_path, good) == alone["constant-velocity"]
    for fault in faults:
        (manifest,) = [one for one in manifests if one["policy"].endswith(f" {fault}")]
        if manifest["status"] != "ok":
            assert manifest["error"]["failure_class"] == "policy", (fault, manifest["error"])
        assert manifest["status"] == "failed" or fault in HARMLESS, fault
    assert code == 2


def test_what_checks_and_scores_take_from_a_part_that_leaves(tmp_path, capsys):
    assert run_command(["check", "policy", f"{FILE}:policy_leave"]) == 1
    assert run_command(["check", "renderer", f"{FILE}:renderer_leave"]) == 2
    assert "SystemExit: 0" in capsys.readouterr().err
    drive(tmp_path / "run", ["constant-velocity"])
    logs = str(next((tmp_path / "run").rglob("rollout.asl")))
    for fault in ("leave", "end_process"):
        capsys.readouterr()
        words = ["score", logs, "--scene", "smoke/straight", *("--out", str(tmp_path / fault))]
        code = run_command([*words, "--evaluator", f"{FILE}:evaluator_{fault}", "--json"])
        assert code == 5
        (failed,) = json.loads(capsys.readouterr().out)["summary"]["failures"]["cells"]
        assert "bad_parts.py:" in failed["error"]["message"]
