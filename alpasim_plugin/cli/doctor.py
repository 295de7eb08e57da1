"""``simrun doctor``: check that this machine can run each part."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import typer

from alpasim_plugin.cli.options import Json
from alpasim_plugin.cli.output import show
from alpasim_plugin.core.devices import require_device
from alpasim_plugin.core.errors import InfrastructureError, SimrunError
from alpasim_plugin.core.files import places
from alpasim_plugin.core.files.places import temporary_folder
from alpasim_plugin.core.flags import Flag
from alpasim_plugin.core.json_types import JsonView
from alpasim_plugin.runs.provenance import hardware, versions

EPILOG = "Example: `simrun doctor --json`"


def doctor(
    gpu: Annotated[
        bool, Flag("Compare the first CUDA device with the CPU, then time it.", "--gpu")
    ] = False,
    budget_s: Annotated[float, Flag("Seconds that --gpu may take.", "--budget", min=1.0)] = 400.0,
    as_json: Json = False,
) -> None:
    """Test each part on a small case and report what fails."""
    if gpu:
        raise typer.Exit(_check_gpu(budget_s, as_json))
    rows = []
    for name, check in CHECKS.items():
        row = {"check": name, "ok": True, "needed": name in NEEDED, "found": "", "do": ""}
        try:
            row["found"] = check()
        except SimrunError as error:
            row |= {"ok": False, "found": error.message, "do": error.hint}
        rows.append(row)
    machine = hardware() | versions()
    lines = [f"{key:>32}  {value}" for key, value in machine.items()]
    lines += [_check_line(row) for row in rows]
    facts = {"hardware": hardware(), "versions": versions(), "checks": rows}
    show(as_json, facts, *lines)
    raise typer.Exit(4 if any(row["needed"] and not row["ok"] for row in rows) else 0)


def _check_gpu(budget_s: float, as_json: bool) -> int:
    """Compare the card with the CPU and time it, a line a section as it ends; return 0 if they
    agree.
    """
    from alpasim_plugin.runs.gpu_check import check_gpu

    device = require_device("cuda")
    sections = {}
    for section, facts in check_gpu(device, budget_s):
        sections[section] = facts
        if not as_json:
            show(False, facts, f"{section:>12}  {json.dumps(facts)}")
    if as_json:
        show(True, {"device": device, "sections": sections})
    return 0 if all(section["ok"] for section in sections.values()) else 4


def _check_line(row: JsonView) -> str:
    """Return the line of one check: what works, or what is broken or absent and what to do."""
    if row["ok"]:
        mark = "ok"
    elif row["needed"]:
        mark = "BROKEN"
    else:
        mark = "absent"
    advice = f" -> {row['do']}" if row["do"] else ""
    return f"{row['check']:>32}  {mark}: {row['found']}{advice}"


def _raster(backend: Literal["cpu", "triton"]) -> str:
    from alpasim_plugin.gaussians import GaussianCloud, PinholeCamera, rasterize

    cloud = GaussianCloud(
        np.array([[0.0, 0.0, 2.0]]),
        np.array([[1.0, 0.0, 0.0, 0.0]]),
        np.full((1, 3), 0.2),
        np.array([0.9]),
        np.zeros((1, 1, 3)),
    )
    camera = PinholeCamera(32, 32, np.array([[32.0, 0, 16], [0, 32, 16], [0, 0, 1]]), np.eye(4))
    out = rasterize(cloud, camera, background=(0.0, 0.0, 0.0), backend=backend)
    return f"one Gaussian rendered, peak alpha {float(np.asarray(out.alpha).max()):.2f}"


def _fixer() -> str:
    from alpasim_plugin.core.types import Frame
    from alpasim_plugin.fixers import make_fixer

    fixer = make_fixer("onefixer", scene_id="doctor", threads=1)
    grey = [
        Frame(i, "front", np.full((32, 48, 3), 40 * i, dtype=np.uint8))
        for i in range(fixer.blocks.first)
    ]
    fixed = fixer.step(grey, [frame.rgb for frame in grey])
    refused = sum(bool(frame.events) for frame in fixed)
    return (
        f"{fixer.label}: {len(fixed)} of {len(grey)} frames fixed, {refused} refused by its guard"
    )


def _video() -> str:
    from alpasim_plugin.log.video import read_mp4, write_mp4

    frames = [np.full((32, 48, 3), 40 * i, dtype=np.uint8) for i in range(4)]
    with temporary_folder("simrun-doctor-") as folder:
        path = Path(folder) / "test.mp4"
        write_mp4(path, frames, 10)
        return f"H.264: {len(read_mp4(path).frames)} frames written and read back"


def _wire() -> str:
    from alpasim_plugin.log import wire

    return f"compiled messages load: {wire.__name__}"


def _writable(folder: Path) -> str:
    """Return a folder's path; it may not exist yet.

    Raises:
        InfrastructureError: It cannot be written.
    """
    if not places.is_writable(folder):
        raise InfrastructureError(f"{folder}: it cannot be written", places.HINT)
    return str(folder)


def _disk() -> str:
    return f"{shutil.disk_usage(Path.cwd()).free / 2**30:.1f} GiB free here"


CHECKS: dict[str, Callable[[], str]] = {
    "rasteriser (cpu)": lambda: _raster("cpu"),
    "rasteriser (cuda)": lambda: _raster("triton"),
    "fixer": _fixer,
    "video": _video,
    "log messages": _wire,
    "disk": _disk,
    "cache": lambda: _writable(places.cache()),
    "compiled kernels": lambda: _writable(places.kernels()),
}
NEEDED = CHECKS.keys() - {"rasteriser (cuda)", "cache"}
