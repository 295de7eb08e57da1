"""What is fuzzed: every reader, with small valid files to damage and a use for what is accepted."""

from __future__ import annotations

import contextlib
import io
import json
import os
import random
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from alpasim_plugin.config import load_yaml
from alpasim_plugin.errors import SimrunError
from tests.fuzz.mutate import mutate
from tests.fuzz.seen import compressed_ply, xodr
from tests.vouching import vouch_for

REPO = Path(__file__).resolve().parents[2]
FORMS = {".json": "json", ".jsonl": "text", ".yaml": "yaml", ".xml": "xml", ".xodr": "xml"}
Files = dict[str, bytes]


class Refused(Exception):
    """The input was refused as it should be."""


@dataclass(frozen=True)
class Target:
    """A reader: how valid files are made, and what is done with a folder of damaged ones."""

    name: str
    make: Callable[[Path], None]  # writes valid files into an empty folder
    use: Callable[[Path], None]  # reads the folder; raises what the reader raises
    damage: Sequence[str] = ("*",)  # patterns of the files to damage


def inputs(target: Target, rng: random.Random) -> Files:
    """Return the target's files, one of them damaged."""
    files = valid(target)
    names = sorted({name for pattern in target.damage for name in files if Path(name).match(pattern)})
    name = rng.choice(names)
    if name.endswith(".usdz") and rng.random() < 0.85:
        files[name] = _inside_zip(files[name], rng)
    else:
        files[name] = mutate(files[name], FORMS.get(Path(name).suffix, "binary"), rng)
    return files


def check(target: Target, files: Files, folder: Path) -> str:
    """Use the files; return ``refused`` or ``accepted``.

    Raises:
        AssertionError: The refusal is not one of four parts with code 2.
        Exception: Whatever else came out.
    """
    shutil.rmtree(folder, ignore_errors=True)
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    try:
        target.use(folder)
    except Refused:
        return "refused"
    except SimrunError as error:
        refusal = error
    else:
        return "accepted"
    out_of_memory(refusal)
    parts = (refusal.doing, refusal.with_what, refusal.found, refusal.do_this)
    if refusal.exit_code != 2:
        raise refusal
    assert all(part.strip() and len(part) <= 300 and part.isprintable() for part in parts), f"parts of an error: {parts}"
    return "refused"


def out_of_memory(error: BaseException | None) -> None:
    """Raise the shortage of memory that an error stands for, if it does."""
    while error is not None:
        if isinstance(error, MemoryError):
            raise error
        error = error.__cause__


def valid(target: Target) -> Files:
    """Return the target's files undamaged."""
    return dict(_valid(target.name))


@lru_cache(maxsize=64)
def _valid(name: str) -> tuple[tuple[str, bytes], ...]:
    target = next(t for t in TARGETS if t.name == name)
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text) / "it"
        folder.mkdir()
        target.make(folder)
        return tuple((p.relative_to(folder).as_posix(), p.read_bytes()) for p in sorted(folder.rglob("*")) if p.is_file())


def _inside_zip(data: bytes, rng: random.Random) -> bytes:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {info.filename: archive.read(info) for info in archive.infolist()}
    name = rng.choice(sorted(members))
    members[name] = mutate(members[name], FORMS.get(Path(name).suffix, "binary"), rng)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for member, content in members.items():
            archive.writestr(member, content)
    return out.getvalue()


# --- uses ---------------------------------------------------------------------------------------------------------------------------


def drive(path: Path, *overrides: str) -> None:
    """Load a scenario and drive three steps of it."""
    from alpasim_plugin.runtime.rollout import run_rollout
    from alpasim_plugin.types import Renderer
    from policies import make_policy
    from scenarios.load import load_scenario

    class Blind(Renderer):
        def render(self, request: Any) -> Any:
            raise AssertionError("the policy has no camera")

    scenario = load_scenario(path, overrides=overrides)
    steps = min(scenario.end_us - scenario.start_us, 3 * scenario.rates.control_us)
    short = replace(scenario, end_us=scenario.start_us + steps, warmup_us=0)
    run_rollout(short, Blind(), make_policy("constant-velocity", short))


def command(*args: str) -> Callable[[Path], None]:
    """Run a command line in this process; codes 0 and 1 to 3 are verdicts, a printed error with code 2 is a refusal."""

    def use(folder: Path) -> None:
        from alpasim_plugin.cli.main import run_command

        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = run_command([arg.replace("@", str(folder)) for arg in args])
        if code == 2:
            lines = [line for line in err.getvalue().strip().splitlines() if line and not line.startswith("warning: ")]
            assert [line.split(":")[0].strip() for line in lines] == ["error", "with", "found", "do"], err.getvalue()[:400]
            raise Refused
        assert code in (0, 1, 3), f"exit code {code}: {err.getvalue()[:400]}"

    return use


def resealed(use: Callable[[Path], None]) -> Callable[[Path], None]:
    """Seal a damaged run folder anew, as whoever damaged it on purpose would, so that what reads it behind the seal is reached."""

    def sealed(folder: Path) -> None:
        with contextlib.suppress(Exception):  # damage that cannot even be sealed is read as it is
            vouch_for(folder / "run")
        use(folder)

    return sealed


def one_of(pattern: str, use: Callable[[Path], object]) -> Callable[[Path], None]:
    """Use the one file of a folder."""
    return lambda folder: use(next(folder.glob(pattern))) and None


def _gaussians(path: Path) -> None:
    from alpasim_plugin.gaussians import PinholeCamera, rasterize
    from alpasim_plugin.gaussians.files.formats import read_gaussians

    cloud, _ = read_gaussians(path)
    camera = PinholeCamera(16, 12, np.array([[12.0, 0, 8], [0, 12.0, 6], [0, 0, 1]]), np.eye(4))
    picture = rasterize(cloud, camera, background=(0.0, 0.0, 0.0), backend="reference")
    assert np.isfinite(picture.rgb).all()


def _log(path: Path) -> None:
    from alpasim_plugin.log import read_asl, read_facts
    from alpasim_plugin.log.trace import trace_log
    from alpasim_plugin.runtime.scoring import contacts_of
    from evaluators import PRESETS, reduce_rollout, score
    from scenarios.load import load_scenario

    log = read_asl(path)
    facts = path.with_name("frames.jsonl")
    trace_log(path, read_facts(facts) if facts.exists() else ())
    series = tuple(score(log, load_scenario("smoke/straight").scene, PRESETS["paper"]))
    reduce_rollout(series, PRESETS["paper"])
    contacts_of(log, PRESETS["paper"])


def _bundle(path: Path) -> None:
    from alpasim_plugin.fixers.bundle import bundle_fixer
    from alpasim_plugin.nets.checkpoints import load_weights

    bundle_fixer(path)
    load_weights(path)


def _picture(path: Path) -> None:
    from alpasim_plugin.log import decode_image

    assert decode_image(path.read_bytes()).ndim == 3


def _pairs(folder: Path) -> None:
    from alpasim_plugin.training.pair_store import PairDataset

    for sequence in PairDataset(folder, "train").sequences:
        clip = sequence.clip
        assert len(np.asarray(clip.t_us)) == len(clip) > 0


def _poses(path: Path) -> None:
    from alpasim_plugin.training.pair_import import read_poses

    read_poses(path, 10.0)


def _views(folder: Path) -> None:
    from alpasim_plugin.gaussians.fit.view_files import read_views

    read_views(folder)


# --- valid files --------------------------------------------------------------------------------------------------------------------


def _scene_file(name: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        merged = load_yaml(REPO / "scenarios" / name).data  # what it extends does not lie beside the damaged file
        (folder / "scene.yaml").write_text(yaml.safe_dump(merged, sort_keys=False))

    return make


def _write(name: str, content: Callable[[], bytes]) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_bytes(content()) and None


RICH = """version: 1
seed: 3
description: everything at once
road:
  lanes_forward: 2
  segments: [{kind: straight, length_m: 120}, {kind: arc, length_m: 30, curvature_per_m: 0.01}, {kind: clothoid, length_m: 30}, {kind: straight, length_m: 80}]
ego: {lane: 0, speed_mps: 8, cruise_mps: 9, lane_changes: [{at_m: 20, to_lane: 1}]}
actors:
  - {kind: parked, id: a, s_m: 40, count: 2}
  - {kind: idm, id: b, s_m: 50, speed_mps: 9, lane: 1}
  - {kind: drive, id: c, s_m: 45, lane: 0, speeds: [[0, 9], [4, 9]]}
  - {kind: oncoming, id: d, s_m: 120, speed_mps: 9}
  - {kind: logged, id: e, points: [[0, 100, 40, 0], [4, 110, 40, 0]]}
timing: {duration_us: 2000000, warmup_us: 200000}
cameras: [{name: front, width: 64, height: 36}]
variations: {ego.cruise_mps: {low: 8, high: 10}}
samples: [{timing.warmup_us: 100000}]
"""  # noqa: E501 - one segment list a line


SUITE = """version: 1
description: two scenes
scenarios: [smoke/straight, {path: smoke/curve, seeds: [0, 3], set: {timing.warmup_us: 100000}}]
"""


def _png(form: str) -> bytes:
    import cv2

    done, data = cv2.imencode(form, np.arange(24 * 32 * 3, dtype=np.uint8).reshape(24, 32, 3))
    assert done
    return data.tobytes()


def _make_usdz(folder: Path) -> None:
    from tests.scenarios import make_usdz

    make_usdz.write(folder / "scene.usdz")


def _make_xodr(folder: Path) -> None:
    xodr("200", '<arc curvature="0.001"/>')(folder)


def _make_argoverse(folder: Path) -> None:
    from tests.scenarios.make_argoverse import write_argoverse

    write_argoverse(folder / "log")


def _make_cosmos(folder: Path) -> None:
    from tests.scenarios.make_cosmos import write_cosmos

    write_cosmos(folder / "clip")


def _make_commonroad(folder: Path) -> None:
    from tests.scenarios.make_commonroad import write_commonroad

    write_commonroad(folder / "scene.xml")


def _make_cloud(writer: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        from alpasim_plugin.gaussians import write_ply
        from alpasim_plugin.gaussians.files.splat import write_splat
        from tests.gaussians.gaussian_scenes import random_cloud

        if writer == "ply":
            write_ply(folder / "a.ply", random_cloud(6, degree=1))
        elif writer == "splat":
            write_splat(folder / "a.splat", random_cloud(6, degree=0))
        elif writer == "spz":
            import gzip
            import struct

            head = struct.pack("<IIIBBBB", 0x5053474E, 2, 4, 0, 12, 0, 0)
            (folder / "a.spz").write_bytes(gzip.compress(head + random.Random(0).randbytes(4 * 20)))
        else:
            (folder / "a.ply").write_bytes(compressed_ply().replace(b"property float packed_", b"property uint packed_"))

    return make


def _make_log(folder: Path) -> None:
    from alpasim_plugin.log import write_facts
    from tests.log.make_rollout import write_rollout

    write_rollout(folder / "rollout.asl")
    write_facts(folder / "frames.jsonl", [{"t_us": 100_000, "camera": "front", "alpha_mean": 0.5}])


def _make_bundle(folder: Path) -> None:
    from safetensors.numpy import save

    settings = json.dumps({"name": "onefixer-tiny", "steps": [1000.0], "vae": {"kind": "tiny"}})
    tensors = {f"{part}.a": np.zeros((2, 3), np.float32) for part in ("dit", "vae")}
    (folder / "a.safetensors").write_bytes(save(tensors, {"format": "simrun-fixer-1", "settings": settings, "trained": "true"}))


def _make_run(folder: Path) -> None:
    from tests.report.make_run import Plan, make_run

    vouch_for(make_run(folder / "run", Plan(scenes=("plain", "other"), seeds=(0, 1), steps=20, pictures=False, clips=False)))


def _make_baseline(folder: Path) -> None:
    from evaluators.gate import write_baseline
    from evaluators.report.run_folder import read_run

    _make_run(folder)
    write_baseline(read_run(folder / "run"), folder / "baseline.json")
    shutil.copy(REPO / "configs" / "gates" / "default.yaml", folder / "gate.yaml")


def _make_pairs(folder: Path) -> None:
    from tests.training.pair_files import make

    make(folder, frames=2, height=8, width=8)


def _make_poses(folder: Path) -> None:
    rows = [{"T_world_camera": np.eye(4).tolist(), "t_us": 100_000 * i} for i in range(3)]
    (folder / "poses.json").write_text(json.dumps(rows))


def _make_views(folder: Path) -> None:
    (folder / "images").mkdir()
    (folder / "images" / "0.png").write_bytes(_png(".png"))
    frame = {"file_path": "images/0.png", "transform_matrix": np.eye(4).tolist(), "t_us": 0}
    lens = {"axes": "opencv", "w": 32, "h": 24, "fl_x": 30.0, "fl_y": 30.0, "cx": 16.0, "cy": 12.0}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": [frame]}))


REPORT = ("run.json", "summary.json", "rollouts.parquet", "steps.parquet", "scenes/*.json", "manifest.json", "*.jsonl", "*.asl")
TARGETS: tuple[Target, ...] = (
    Target("scenario", _scene_file("smoke/lead_car.yaml"), one_of("*.yaml", drive)),
    Target("scenario, rich", _write("scene.yaml", RICH.encode), one_of("*.yaml", drive)),
    Target("scenario, crossing", _scene_file("hard/crossing_pedestrian.yaml"), one_of("*.yaml", drive)),
    Target("scenario, junction", _scene_file("urban/junction_left.yaml"), one_of("*.yaml", drive)),
    Target("suite", _write("scene.yaml", SUITE.encode), command("--dry-run", "--policy", "log-replay", "@/scene.yaml")),
    Target("CommonRoad", _make_commonroad, one_of("*.xml", drive)),
    Target("OpenDRIVE", _make_xodr, one_of("*.usdz", drive)),
    Target("AlpaSim scene", _make_usdz, one_of("*.usdz", drive)),
    Target("Argoverse 2", _make_argoverse, lambda folder: drive(folder / "log")),
    Target("Cosmos-Drive-Dreams", _make_cosmos, lambda folder: drive(folder / "clip", "timing.warmup_us=100000")),
    Target("PLY", _make_cloud("ply"), one_of("*.ply", _gaussians)),
    Target("compressed PLY", _make_cloud("compressed"), one_of("*.ply", _gaussians)),
    Target("splat", _make_cloud("splat"), one_of("*.splat", _gaussians)),
    Target("SPZ", _make_cloud("spz"), one_of("*.spz", _gaussians)),
    Target("weights", _make_bundle, one_of("*.safetensors", _bundle)),
    Target("rollout log", _make_log, one_of("*.asl", _log)),
    Target("run folder, report", _make_run, resealed(command("report", "@/run")), REPORT),
    Target("run folder, compare", _make_run, resealed(command("compare", "@/run")), REPORT[:4]),
    Target("run folder, gate", _make_run, resealed(command("gate", "@/run")), REPORT[:4]),
    Target("gate and baseline", _make_baseline, command("gate", "@/run", "--gate", "@/gate.yaml", "--baseline-file", "@/baseline.json"),
           ("gate.yaml", "baseline.json")),
    Target("pairs", _make_pairs, _pairs),
    Target("poses", _make_poses, one_of("*.json", _poses)),
    Target("posed views", _make_views, _views),
    Target("PNG", _write("a.png", lambda: _png(".png")), one_of("*.png", _picture)),
    Target("JPEG", _write("a.jpg", lambda: _png(".jpg")), one_of("*.jpg", _picture)),
)  # fmt: skip


@contextlib.contextmanager
def workplace() -> Iterator[Path]:
    """Give a folder for the files of one input after another; the working directory is there meanwhile."""
    before = os.getcwd()
    with tempfile.TemporaryDirectory(prefix="simrun-fuzz-") as text:
        os.chdir(text)
        try:
            yield Path(text) / "input"
        finally:
            os.chdir(before)
