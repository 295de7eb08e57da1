"""A result is what made it: each input of each maker is in its key, and whoever drives again says
why.
"""

import hashlib
import json
import shutil
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core import kernels
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import content_of, read_json
from alpasim_plugin.core.files.arrays import open_npy, read_npz
from alpasim_plugin.core.files.inputs import ABSENT, Inputs, note_files, unrecorded
from alpasim_plugin.core.parts import resolve
from alpasim_plugin.core.parts.source import package_digest
from alpasim_plugin.core.parts.spec import part_digest
from alpasim_plugin.drives import build as imports
from alpasim_plugin.drives.build import KEY_FILE, SCENARIO_FILE, finished
from alpasim_plugin.drives.build import read_inputs as drive_inputs
from alpasim_plugin.drives.splat import read_inputs as splat_inputs
from alpasim_plugin.gaussians.files.ply import write_ply
from alpasim_plugin.gaussians.fit.start import cloud_from_points
from alpasim_plugin.log.run_folder.manifests import read_run_json
from alpasim_plugin.log.run_folder.schema import LOG_NAME
from alpasim_plugin.renderers import reconstruction_key as fits
from alpasim_plugin.renderers.reconstruction_key import recipe_of, reconstruction_key
from alpasim_plugin.runs import plan as plan_of_runs
from alpasim_plugin.runs.changes import changed_evaluators
from alpasim_plugin.runs.plan import RunOptions, make_plan
from alpasim_plugin.runs.same_poses import images_key
from evaluators import resolve_evaluators
from scenarios import cameras
from scenarios.load import load_scenario
from scenarios.suite import ScenarioRef, expand
from tests.drives.splat_model import poses_of, street_cloud
from tests.drives.street import RIG_FROM_CAMERA, edited
from tests.gaussians.sog_writer import write_sog
from tests.run_records import manifest

SCENE = """version: 1
road: {segments: [{kind: straight, length_m: 200}]}
timing: {duration_us: 1200000}
cameras: {from: rig.json}
background: {file: hills.ply}
actors:
  - {id: lead, kind: drive, s_m: 20, speeds: [[0, 10]], appearance: car.ply}
"""
HILLS = "background: {file: hills.ply}\n"
CAMERA = {
    "camera": "front",
    "axes": "opencv",
    "w": 96,
    "h": 64,
    "fl_x": 137.0,
    "fl_y": 137.0,
    "cx": 48.0,
    "cy": 32.0,
    "transform_matrix": [[0, 0, 1, 1.6], [-1, 0, 0, 0], [0, -1, 0, 1.4], [0, 0, 0, 1]],
}


def write_rig(folder, **keys):
    (folder / "rig.json").write_text(json.dumps({"frames": [CAMERA | keys]}))


def write_model(path, seed, half_m=0.7):
    points = np.random.default_rng(seed).uniform(-half_m, half_m, (50, 3))
    write_ply(path, cloud_from_points(points, np.full((50, 3), 0.5)))


def module_of(folder, name):
    """Return the name of a module in a test's folder: a process imports each name from one place, so
    that tests of one process, in any order, share none.
    """
    place = hashlib.sha256(str(folder).encode()).hexdigest()[:8]
    return f"{name}_{place}"


@pytest.fixture
def scene(tmp_path):
    """Write a scenario that names a calibration, a background and an actor's appearance."""
    write_rig(tmp_path)
    write_model(tmp_path / "hills.ply", 1, 60.0)
    write_model(tmp_path / "car.ply", 2)
    (tmp_path / "scene.yaml").write_text(SCENE)
    return tmp_path


FILES_OF_A_SCENE = {
    "rig.json": lambda folder: write_rig(folder, fl_x=60.0),
    "hills.ply": lambda folder: write_model(folder / "hills.ply", 3),
    "car.ply": lambda folder: write_model(folder / "car.ply", 3),
}


@pytest.mark.parametrize("name", FILES_OF_A_SCENE)
def test_each_file_of_a_scene_makes_another_scene(scene, name):
    before = load_scenario(scene / "scene.yaml")
    assert load_scenario(scene / "scene.yaml").content_hash == before.content_hash
    assert str(scene / name) in before.files
    FILES_OF_A_SCENE[name](scene)
    assert load_scenario(scene / "scene.yaml").content_hash != before.content_hash


def test_a_scene_is_the_same_wherever_it_lies_and_however_it_is_written(scene, tmp_path):
    before = load_scenario(scene / "scene.yaml")
    moved = shutil.copytree(scene, tmp_path / "moved" / scene.name)
    (moved / "scene.yaml").write_text(f"# words\n{SCENE}")
    assert load_scenario(moved / "scene.yaml").content_hash == before.content_hash


def test_a_shipped_rig_counts_by_what_it_holds(tmp_path, monkeypatch):
    (tmp_path / "scene.yaml").write_text(SCENE.split("cameras")[0] + "cameras: {rig: front}\n")
    before = load_scenario(tmp_path / "scene.yaml").content_hash
    rigs = cameras.RIGS_FILE.read_text()
    (tmp_path / "rigs.yaml").write_text(
        rigs.replace("- {name: front}", "- {name: front, hfov_deg: 50}", 1)
    )
    monkeypatch.setattr(cameras, "RIGS_FILE", tmp_path / "rigs.yaml")
    assert load_scenario(tmp_path / "scene.yaml").content_hash != before


@pytest.mark.parametrize("name", ["hills.ply", "car.ply"])
def test_a_fit_is_named_by_the_files_that_the_scene_shows(scene, name):
    scenario = load_scenario(scene / "scene.yaml")
    before = reconstruction_key(scenario, None)
    assert reconstruction_key(replace(scenario, content_hash="other"), None) == before
    write_model(scene / name, 3)
    assert reconstruction_key(load_scenario(scene / "scene.yaml"), None) != before
    assert reconstruction_key(scenario, None) != before  # of an object that was loaded before


def edit_photograph(folder):
    path = folder / "images" / "003.png"
    cv2.imwrite(str(path), 255 - cv2.imread(str(path)))


def edit_points(folder):
    points = np.random.default_rng(5).uniform(0, 3, (40, 3))
    write_ply(folder / "points.ply", cloud_from_points(points, np.full((40, 3), 0.5)))


def edit_key(**keys):
    def edit(folder):
        with edited(folder) as document:
            document |= keys

    return edit


def keep_from_the_fit(folder):
    with edited(folder) as document:
        document["frames"][3]["use"] = "never-fitted"


EDITS_OF_A_DRIVE = {
    "unit": edit_key(unit="m"),
    "lens": edit_key(camera_model="OPENCV_FISHEYE"),
    "never fitted": keep_from_the_fit,
    "points": edit_points,
    "photograph": edit_photograph,
}


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    """Write a street with photographs and points, not to be changed."""
    folder = tmp_path_factory.mktemp("street") / "street"
    (folder / "images").mkdir(parents=True)
    frames = []
    for i in range(8):
        pose = np.eye(4)
        pose[:3, :3] = RIG_FROM_CAMERA
        pose[0, 3] = 0.6 * i
        cv2.imwrite(str(folder / f"images/{i:03d}.png"), np.full((32, 64, 3), i, dtype=np.uint8))
        frames.append(
            {
                "file_path": f"images/{i:03d}.png",
                "transform_matrix": pose.tolist(),
                "camera": "front",
            }
        )
    lens = {"w": 64, "h": 32, "fl_x": 40.0, "fl_y": 40.0, "cx": 32.0, "cy": 16.0}
    document = {**lens, "axes": "opencv", "ply_file_path": "points.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(document))
    points = np.random.default_rng(4).uniform(0, 3, (40, 3))
    write_ply(folder / "points.ply", cloud_from_points(points, np.full((40, 3), 0.5)))
    return folder


def drive_key(folder, height_m=None, road=None, device="cpu"):
    return drive_inputs(folder, height_m, road, device)[1]


@pytest.mark.parametrize("edit", EDITS_OF_A_DRIVE)
def test_each_input_of_an_imported_drive_makes_another_import(street, tmp_path, edit):
    folder = shutil.copytree(street, tmp_path / "street")
    assert drive_key(folder) == drive_key(street)
    EDITS_OF_A_DRIVE[edit](folder)
    assert drive_key(folder) != drive_key(street)


def test_each_option_of_an_import_makes_another_one(street, tmp_path):
    (tmp_path / "road.xodr").write_text("one")
    mapped = drive_key(street, road=tmp_path / "road.xodr")
    (tmp_path / "road.xodr").write_text("two")
    keys = [
        drive_key(street),
        drive_key(street, height_m=1.2),
        drive_key(street, device="cuda"),
        drive_key(street, road=tmp_path / "road.xodr"),
        mapped,
    ]
    assert len(set(keys)) == len(keys)


def test_each_file_of_an_imported_model_makes_another_import(tmp_path):
    poses = poses_of(tmp_path / "poses")
    file = tmp_path / "street.ply"
    write_ply(file, street_cloud())
    keys = [splat_inputs(file, poses)[1]]
    assert splat_inputs(file, poses)[1] == keys[0]
    still = {"transform": np.eye(4)[:3].tolist(), "scale": 1.0}
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(still))
    keys.append(splat_inputs(file, poses)[1])
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(still | {"scale": 1.001}))
    keys.append(splat_inputs(file, poses)[1])
    write_ply(file, street_cloud(turn=np.eye(3) * 1.0001))
    keys.append(splat_inputs(file, poses)[1])
    document = json.loads(poses.read_text())
    document["frames"][0]["transform_matrix"][0][3] += 0.001
    poses.write_text(json.dumps(document))
    keys.append(splat_inputs(file, poses)[1])
    assert len(set(keys)) == len(keys)


def test_the_planes_of_a_model_in_a_folder_are_read_through_the_record(tmp_path):
    from alpasim_plugin.gaussians.files import read_gaussians

    write_sog(tmp_path / "model")
    with Inputs() as inputs:
        read_gaussians(tmp_path / "model")
    read = {path.rpartition("/")[2] for path in inputs.files}
    assert {"meta.json", "means_l.webp", "quats.webp", "sh0.webp"} <= read


POLICY = """
import {gains}
from policies.simple import ConstantVelocity

class Mine(ConstantVelocity):
    gain = {gains}.GAIN
"""


@pytest.mark.parametrize("place", ["beside", "elsewhere"])
def test_a_policy_is_all_code_that_it_imports(tmp_path, monkeypatch, place):
    """An editable package and ``PYTHONPATH`` both put a folder on Python's path."""
    gains = module_of(tmp_path, "gains")
    constant = module_of(tmp_path, "constant")
    (tmp_path / "mine.py").write_text(POLICY.replace("{gains}", gains))
    folder = tmp_path if place == "beside" else tmp_path / "elsewhere"
    folder.mkdir(exist_ok=True)
    if folder != tmp_path:
        monkeypatch.syspath_prepend(folder)
    (folder / f"{gains}.py").write_text(f"from {constant} import GAIN\n")
    inner = folder / f"{constant}.py"
    inner.write_text("GAIN = 1.0\n")
    name = f"{tmp_path / 'mine.py'}:Mine"
    before = resolve("policy", name)
    names = {path.rpartition("/")[2] for path in before.code}
    assert names == {"mine.py", f"{gains}.py", f"{constant}.py"}
    inner.write_text("GAIN = 2.0\n")
    assert part_digest([tmp_path / "mine.py"], "Mine", None, {}) != before.digest


WORDS = ("--workers", "1", "--images", "none", "--no-report")


def driven(folder, capfd, renderer="clean", policy="constant-velocity", length_m=200):
    """Drive the scene of a folder; return when each log was written, and what was said."""
    text = SCENE.replace(HILLS, "").replace("200", str(length_m))
    (folder / "scene.yaml").write_text(text)
    words = ["--renderer", renderer, "--policy", policy]
    command = [*words, *WORDS, "--out", str(folder / "run")]
    assert run_command([*command, str(folder / "scene.yaml")]) == 0
    logs = sorted((folder / "run").glob("rollouts/*/*/*/*/rollout.asl"))
    return [log.stat().st_mtime_ns for log in logs], capfd.readouterr().err


def test_an_edited_calibration_is_driven_again_with_its_name_and_nothing_else_is(scene, capfd):
    first, _ = driven(scene, capfd)
    same, said = driven(scene, capfd)
    assert same == first
    assert "again" not in said
    write_rig(scene, fl_x=60.0)
    other, said = driven(scene, capfd)
    assert other != first
    assert f"1 rollout is driven again: {scene / 'rig.json'} was edited" in said
    assert f"its file {scene / 'scene.yaml'}" in driven(scene, capfd, length_m=210)[1]


RENDERER = """
import numpy as np
from alpasim_plugin.core.files import read_json
from alpasim_plugin.core.types import Frame

class Grey:
    def __init__(self):
        self.grey = read_json("{path}")["grey"]
    def render(self, request):
        shape = (request.camera.height, request.camera.width, 3)
        return Frame(request.t_us, request.camera.name, np.full(shape, self.grey, dtype=np.uint8))
"""


def test_a_file_that_is_in_no_key_and_was_read_is_driven_again_when_it_changes(
    scene, capfd, monkeypatch
):
    monkeypatch.chdir(scene)
    grey = scene / "grey.json"
    grey.write_text('{"grey": 90}')
    (scene / "grey.py").write_text(RENDERER.replace("{path}", str(grey)))
    words = ("grey.py:Grey", "lane-camera")
    first, _ = driven(scene, capfd, *words)
    assert driven(scene, capfd, *words)[0] == first
    manifest = read_json(next((scene / "run").glob("rollouts/*/*/*/*/manifest.json")))
    assert manifest["inputs"] == {str(grey): content_of(grey)}
    grey.write_text('{"grey": 60}')
    other, said = driven(scene, capfd, *words)
    assert other != first
    assert f"{grey} was edited" in said
    unseen = read_json(scene / "run" / "run.json")["unseen"]
    assert "opens by itself" in unseen["renderer grey.py:Grey"]


def test_images_of_other_renderers_are_those_of_their_log_and_renderers(scene, monkeypatch):
    monkeypatch.chdir(scene)
    (scene / "scene.yaml").write_text(SCENE.replace(HILLS, ""))
    (scene / "grey.py").write_text(RENDERER.replace("{path}", "grey.json"))
    (scene / "other.py").write_text(RENDERER.replace("{path}", "other.json"))

    def key(*renderers, log="one", grey="90"):
        refs = [ScenarioRef(str(scene / "scene.yaml"))]
        plan = make_plan(refs, renderers, ("constant-velocity",), (0,), RunOptions())
        files = {LOG_NAME: {"bytes": 1, "mtime_ns": 1, "sha256": log}}
        of_grey = {"renderer": "grey.py:Grey", "scene": plan.cells[0].scene}
        other = manifest({**of_grey, "inputs": {"grey.json": grey}})
        return images_key(plan, plan.cells[0], manifest({"files": files}), [other])

    keys = [
        key("clean", "grey.py:Grey"),
        key("clean", "grey.py:Grey", log="two"),
        key("clean", "grey.py:Grey", "broken-black"),
        key("clean", "other.py:Grey"),
        key("clean", "grey.py:Grey", grey="60"),
    ]
    assert key("clean", "grey.py:Grey") == keys[0]
    write_rig(scene, fl_x=60.0)
    assert len({*keys, key("clean", "grey.py:Grey")}) == len(keys) + 1


def test_a_record_holds_files_by_content_settings_by_value_and_inner_records(tmp_path):
    np.save(tmp_path / "a.npy", np.arange(3))
    np.savez(tmp_path / "b.npz", x=np.arange(3))
    (tmp_path / "c.json").write_text("{}")
    with Inputs() as outer:
        with Inputs() as inner:
            open_npy(tmp_path / "a.npy")
            inner.setting("size", 3)
        read_npz(tmp_path / "b.npz", ["x"])
        with unrecorded():
            read_json(tmp_path / "c.json")
        assert content_of(tmp_path / "d.json") == ABSENT
        note_files({"e": "content"})
    assert list(inner.files) == [str(tmp_path / "a.npy")]
    assert [name.rpartition("/")[2] for name in outer.files] == ["a.npy", "b.npz", "d.json", "e"]
    assert (inner.settings, outer.settings) == ({"size": 3}, {})
    with pytest.raises(ValueError, match="size"):
        inner.setting("size", 4)


EVALUATOR = """
import {scale}
from alpasim_plugin.core.files import read_json
from alpasim_plugin.core.types import MetricInfo
from evaluators.metrics.score import series

class Mine:
    metrics = {"mine_m": MetricInfo("m", "lower", "max", "a constant", margin=0.1)}

    def __call__(self, rollout, scene):
        value = {scale}.SCALE * read_json("{path}")["value"] * {scale}.UNIT
        return [series("mine_m", rollout.ego.t_us, value)]
"""
SCALE = """
from alpasim_plugin.core.files import read_json
UNIT = read_json("{path}")["unit"]
SCALE = 2.0
"""


def scale_of(folder):
    """Return the module that an evaluator imports."""
    return folder / f"{module_of(folder, 'scale')}.py"


@pytest.fixture
def evaluator(scene, monkeypatch):
    """Give an evaluator that reads a file, and a module of its own that reads one."""
    monkeypatch.chdir(scene)
    (scene / "value.json").write_text('{"value": 1.5}')
    (scene / "unit.json").write_text('{"unit": 1.0}')
    text = EVALUATOR.replace("{scale}", scale_of(scene).stem)
    (scene / "mine.py").write_text(text.replace("{path}", str(scene / "value.json")))
    text = SCALE.replace("{path}", str(scene / "unit.json"))
    scale_of(scene).write_text(text)
    (scene / "scene.yaml").write_text(SCENE.replace(HILLS, ""))
    return scene


EDITS_OF_AN_EVALUATOR = (
    ({"value.json": ("1.5", "2.5"), "unit.json": ("1.0", "10.0")}, 50.0),
    ({"scale": ("SCALE = 2.0", "SCALE = 3.0")}, 75.0),
)


def own_metric(folder, capfd, code, command):
    """Return the metric of a run's one rollout, and what its command said."""
    said = capfd.readouterr().err
    assert code == 0, (command, said)
    (manifest,) = (folder / "run").glob("rollouts/*/*/*/*/manifest.json")
    return read_json(manifest)["metrics"]["mine_m"]["value"], said


@pytest.mark.slow
def test_an_evaluator_is_all_that_it_imports_and_reads(evaluator, capfd):
    command = ["--renderer", "clean", "--policy", "constant-velocity", *WORDS]
    command += ["--evaluator", "mine.py:Mine", "--out", "run", "scene.yaml"]
    assert own_metric(evaluator, capfd, run_command(command), command)[0] == 3.0
    (log,) = (evaluator / "run").glob("rollouts/*/*/*/*/rollout.asl")
    driven_ns = log.stat().st_mtime_ns
    for edits, expected in EDITS_OF_AN_EVALUATOR:
        files = {
            scale_of(evaluator) if name == "scale" else evaluator / name: words
            for name, words in edits.items()
        }
        for file, (before, after) in files.items():
            file.write_text(file.read_text().replace(before, after))
        if "scale" in edits:  # a process does not import a module twice
            words = [sys.executable, "-m", "alpasim_plugin.cli.main", *command]
            code = subprocess.run(words, check=False).returncode
        else:
            code = run_command(command)
        value, said = own_metric(evaluator, capfd, code, command)
        assert value == expected
        assert "1 rollout is scored again: " in said
        assert [file for file in files if f"{file} was edited" not in said] == []
    assert log.stat().st_mtime_ns == driven_ns


def test_score_states_evaluators_and_says_which_was_edited(evaluator, tmp_path, capfd):
    """Scoring a log again into one folder is another command with other evaluators."""
    driven(evaluator, capfd)
    command = ["score", "run", "--scene", "scene.yaml", "--out", "scored"]
    own = ["--evaluator", "mine.py:Mine"]
    assert run_command([*command, *own]) == 0
    info = read_json(evaluator / "scored" / "run.json")
    assert "opens by itself" in info["unseen"]["evaluator mine.py:Mine"]
    (manifest,) = (evaluator / "scored").glob("rollouts/*/*/*/*/manifest.json")
    read = {evaluator / "value.json", evaluator / "unit.json"}
    assert {Path(path) for path in read_json(manifest)["score_inputs"]} == read
    assert run_command(command) == 2
    parts = read_run_json(evaluator / "scored").parts
    name = "evaluator mine.py:Mine"
    stated = parts | {name: replace(parts[name], digest="other", code={})}
    evaluators = resolve_evaluators(["mine.py:Mine"])
    changes = changed_evaluators(stated, evaluators)
    assert f"{scale_of(evaluator)} was not read before" in changes
    assert changed_evaluators(parts, evaluators) == []
    assert changed_evaluators(parts, evaluators[:-1]) == ["evaluator mine.py:Mine is left out"]


def test_each_setting_of_a_rollout_makes_another_rollout_and_of_scores_other_scores(monkeypatch):
    usual = {"renderers": ("clean",), "policies": ("pure-pursuit",), "seeds": (0,)}

    def cell(options=RunOptions(), overrides=(), **named):
        plan = make_plan(expand("smoke/straight", overrides), **usual | named, options=options)
        return plan.cells[0]

    first = cell()
    assert (cell().rollout_key, cell().score_key) == (first.rollout_key, first.score_key)
    of_rollout = [
        cell(renderers=("3dgs",)),
        cell(renderers=("onefixer",)),
        cell(renderers=("onefixer",), options=RunOptions(fixer=("references=0",))),
        cell(renderers=("onefixer+clean",)),
        cell(policies=("constant-velocity",)),
        cell(seeds=(1,)),
        cell(RunOptions(images="none")),
        cell(RunOptions(controller="perfect")),
        cell(overrides=("timing.duration_us=1200000",)),
    ]
    of_scores = [cell(RunOptions(preset="paper"))]
    with monkeypatch.context() as patch:
        patch.setattr(plan_of_runs, "require_device", lambda name: "cuda:0")
        of_rollout.append(cell())
    with monkeypatch.context() as patch:
        patch.setattr(plan_of_runs, "package_digest", lambda: "edited")
        of_rollout.append(cell())
    assert len({first.rollout_key, *(one.rollout_key for one in of_rollout)}) == 12
    assert {one.rollout_key for one in of_scores} == {first.rollout_key}
    every = [first, *of_rollout, *of_scores]
    assert len({one.score_key for one in every}) == len(every)


def test_machine_code_is_named_by_compiler_and_processor(monkeypatch):
    before = kernels.folder_of(kernels.__file__)
    assert kernels.folder_of(kernels.__file__) == before
    for home, name in (
        (kernels.numba, "__version__"),
        (kernels.binding, "get_host_cpu_name"),
        (kernels, "sources_digest"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(home, name, "other" if name[0] == "_" else lambda *of: "other")
            assert kernels.folder_of(kernels.__file__) != before


def test_a_fit_is_named_by_its_recipe_and_by_simrun(scene, monkeypatch):
    (scene / "scene.yaml").write_text(SCENE.replace(HILLS, ""))
    scenario = load_scenario(scene / "scene.yaml")
    recipe = recipe_of(scenario)
    keys = [reconstruction_key(scenario, recipe)]
    for field in fields(recipe):
        other = replace(recipe, **{field.name: "other"})
        keys.append(reconstruction_key(scenario, other))
    monkeypatch.setattr(fits, "package_digest", lambda: "edited")
    keys.append(reconstruction_key(scenario, recipe))
    assert len(set(keys)) == len(keys)


def test_an_import_by_another_simrun_is_no_finished_one(tmp_path, monkeypatch):
    for name, content in (
        (SCENARIO_FILE, {}),
        (KEY_FILE, {"key": "k", "code": package_digest()}),
        ("quality.json", {"psnr_db": 1.0}),
    ):
        (tmp_path / name).write_text(json.dumps(content))
    assert finished(tmp_path, "k") == {"psnr_db": 1.0}
    with pytest.raises(InputError, match="other files"):
        finished(tmp_path, "other")
    monkeypatch.setattr(imports, "package_digest", lambda: "edited")
    with pytest.raises(InputError, match="another version of simrun"):
        finished(tmp_path, "k")
