"""What is fuzzed: every reader, with small valid files to damage and a use for what is accepted.

The laboratory's readers (`tests.lab.fuzz_targets`) are among them where it is installed.
"""

from __future__ import annotations

import contextlib
import io
import os
import random
import shutil
import tempfile
import zipfile
from collections.abc import Iterator
from functools import lru_cache
from importlib.metadata import entry_points
from pathlib import Path

from alpasim_plugin.core.errors import SimrunError
from tests.fuzz.mutate import mutate
from tests.fuzz.together import damaged_together
from tests.fuzz.uses import (
    Refused,
    Target,
    command,
    drive,
    one_of,
    resealed,
    use_bundle,
    use_gaussians,
    use_log,
    use_picture,
    use_video,
    use_views,
    use_weights,
)
from tests.fuzz.valid_files import (
    RICH,
    SUITE,
    make_argoverse,
    make_background,
    make_baseline,
    make_bundle,
    make_cloud,
    make_commonroad,
    make_file,
    make_log,
    make_run,
    make_scene_file,
    make_torch_weights,
    make_usdz,
    make_video,
    make_views,
    make_xodr,
    picture_bytes,
)

FORMS = {".json": "json", ".jsonl": "text", ".yaml": "yaml", ".xml": "xml", ".xodr": "xml"}
Files = dict[str, bytes]


def inputs(target: Target, rng: random.Random) -> Files:
    """Return the target's files, one of them damaged, or several that belong together."""
    files = valid(target)
    if target.together is not None:
        return target.together(files, rng)
    names = sorted(
        {name for pattern in target.damage for name in files if Path(name).match(pattern)}
    )
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
    parts = (refusal.message, refusal.hint)
    if refusal.exit_code != 2:
        raise refusal
    assert all(part.strip() and len(part) <= 300 and part.isprintable() for part in parts), (
        f"parts of an error: {parts}"
    )
    return "refused"


def out_of_memory(error: BaseException | None) -> None:
    """Raise the shortage of memory that an error stands for, if it does.

    FFmpeg answers ENOMEM for a size beyond its own bound, without asking for the memory: that is a
    refusal.
    """
    while error is not None:
        if isinstance(error, MemoryError) and not type(error).__module__.startswith("av."):
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
        return tuple(
            (p.relative_to(folder).as_posix(), p.read_bytes())
            for p in sorted(folder.rglob("*"))
            if p.is_file()
        )


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


REPORT = (
    "run.json",
    "summary.json",
    "rollouts.parquet",
    "steps.parquet",
    "scenes/*.json",
    "manifest.json",
    "*.jsonl",
    "*.asl",
)
# One of seven is a report, which takes as long as seven of the others.
TOGETHER = (
    ("report", "@/run"),
    ("compare", "@/run"),
    ("gate", "@/run"),
    ("aggregate", "@/run", "--all"),
    ("check", "@/run"),
    ("runs", "@/run"),
    ("compare", "@/run", "--all"),
)
CORE: tuple[Target, ...] = (
    Target("scenario", make_scene_file("smoke/lead_car.yaml"), one_of("*.yaml", drive)),
    Target("scenario, rich", make_file("scene.yaml", RICH.encode), one_of("*.yaml", drive)),
    Target(
        "scenario, crossing",
        make_scene_file("hard/crossing_pedestrian.yaml"),
        one_of("*.yaml", drive),
    ),
    Target(
        "scenario, junction", make_scene_file("urban/junction_left.yaml"), one_of("*.yaml", drive)
    ),
    Target(
        "suite",
        make_file("scene.yaml", SUITE.encode),
        command("--dry-run", "--policy", "log-replay", "@/scene.yaml"),
    ),
    Target("CommonRoad", make_commonroad, one_of("*.xml", drive)),
    Target("OpenDRIVE", make_xodr, one_of("*.usdz", drive)),
    Target("AlpaSim scene", make_usdz, one_of("*.usdz", drive)),
    Target("Argoverse 2", make_argoverse, lambda folder: drive(folder / "log")),
    Target("PLY", make_cloud("ply"), one_of("*.ply", use_gaussians)),
    Target("compressed PLY", make_cloud("compressed"), one_of("*.ply", use_gaussians)),
    Target("splat", make_cloud("splat"), one_of("*.splat", use_gaussians)),
    Target("SPZ", make_cloud("spz"), one_of("*.spz", use_gaussians)),
    Target(
        "background",
        make_background,
        command("--dry-run", "--policy", "log-replay", "@/scene.yaml"),
        ("a.ply",),
    ),
    Target("weights", make_bundle, one_of("*.safetensors", use_bundle)),
    Target("rollout log", make_log, one_of("*.asl", use_log)),
    Target("run folder, report", make_run, resealed(command("report", "@/run")), REPORT),
    Target("run folder, compare", make_run, resealed(command("compare", "@/run")), REPORT[:4]),
    Target("run folder, gate", make_run, resealed(command("gate", "@/run")), REPORT[:4]),
    *(
        Target(
            f"run folder together, {' '.join(word for word in words if '@' not in word)}",
            make_run,
            resealed(command(*words)),
            together=damaged_together,
        )
        for words in TOGETHER
    ),
    Target(
        "gate and baseline",
        make_baseline,
        command("gate", "@/run", "--gate", "@/gate.yaml", "--baseline-file", "@/baseline.json"),
        ("gate.yaml", "baseline.json"),
    ),
    Target("run folder, check", make_run, command("check", "@/run"), REPORT),
    Target("torch weights", make_torch_weights, one_of("*.pt", use_weights)),
    Target("video", make_video, one_of("*.mp4", use_video)),
    Target("posed views", make_views, use_views),
    Target("PNG", make_file("a.png", lambda: picture_bytes(".png")), one_of("*.png", use_picture)),
    Target("JPEG", make_file("a.jpg", lambda: picture_bytes(".jpg")), one_of("*.jpg", use_picture)),
)


def of_the_laboratory() -> tuple[Target, ...]:
    """Return the laboratory's readers; none where it is not installed."""
    if not entry_points(group="simrun.commands", name="train"):
        return ()
    from tests.lab.fuzz_targets import TARGETS

    return TARGETS


TARGETS = (*CORE, *of_the_laboratory())


@contextlib.contextmanager
def workplace() -> Iterator[Path]:
    """Give a folder for the files of one input after another; the working directory is there
    meanwhile.
    """
    before = os.getcwd()
    with tempfile.TemporaryDirectory(prefix="simrun-fuzz-") as text:
        os.chdir(text)
        try:
            yield Path(text) / "input"
        finally:
            os.chdir(before)
