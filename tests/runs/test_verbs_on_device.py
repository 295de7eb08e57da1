"""Every verb that takes ``--device`` on a pretended one whose kernels compute nothing: how often the
host waits, and how much is launched and copied for a frame.
"""

from dataclasses import replace
from fractions import Fraction
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from alpasim_plugin.alpasim.server.assembly import Settings, assemble
from alpasim_plugin.cli.main import run_command
from alpasim_plugin.drives import build
from alpasim_plugin.gaussians.fit.drive import fit_drive
from alpasim_plugin.gaussians.fit.recipe import SplatRecipe
from alpasim_plugin.log.video import VideoWriter
from tests.alpasim.local_service import SCENE, ask
from tests.drives.street import write_transforms
from tests.pretended_device import pretended_device, traffic

FRAMES = 6
SHORT = (
    "timing.duration_us=500000",
    "timing.warmup_us=100000",
    "environment.buildings=0",
    "environment.trees_per_100m=0",
)


def run(folder, monkeypatch):
    words = ["--renderer", "onefixer+clean", "--policy", "lane-camera", "--device", "cuda", SCENE]
    sets = [word for change in SHORT for word in ("--set", change)]
    return [*words, *sets, "--workers", "1", "--no-report", "--out", str(folder / "run")]


def fork(folder, monkeypatch):
    assert run_command(run(folder, monkeypatch)) == 0
    traffic.reset()
    rollout = str(folder / "run/onefixer+clean/lane-camera/smoke-lead_car/0")
    return ["fork", rollout, "--at", "0.3", "--seed", "1", "--out", str(folder / "fork")]


def refine(folder, monkeypatch):
    with VideoWriter(folder / "in.mp4", Fraction(1, 10), Fraction(10)) as video:
        for i in range(FRAMES):
            video.write(np.full((36, 64, 3), 30 * i, dtype=np.uint8), i)
    files = [str(folder / "in.mp4"), "-o", str(folder / "out.mp4")]
    return ["refine", *files, "--fixer", "onefixer", "--anyway", "--device", "cuda"]


def import_drive(folder, monkeypatch):
    recipe = replace(SplatRecipe.street(), steps=FRAMES, points=200)
    monkeypatch.setattr(build, "fit_drive", partial(fit_drive, recipe=recipe))
    street = str(write_transforms(folder / "street", unit="m"))
    return ["import", "drive", street, "--out", str(folder / "drive"), "--device", "cuda"]


@pytest.mark.parametrize(
    ("verb", "waits", "launches", "megabytes"),
    [
        # Of each drive the first frame is fetched once more: to see whether it shows the road.
        pytest.param(run, 5 + 1, 2000, 1.0, marks=pytest.mark.slow),
        pytest.param(fork, 8 + 2, 2000, 2.0, marks=pytest.mark.slow),
        (refine, FRAMES, 1000, 0.1),
        # Beside its updates: a checkpoint, and the model at the end.
        pytest.param(import_drive, FRAMES + 30, 6000, 1.0, marks=pytest.mark.slow),
    ],
)
def test_a_verb_waits_once_a_frame(verb, waits, launches, megabytes, tmp_path, monkeypatch):
    with pretended_device(monkeypatch, computes=False):
        assert run_command(verb(tmp_path, monkeypatch)) == 0
    assert traffic.waits["copy to the host"] <= waits
    assert traffic.launches <= launches
    assert traffic.bytes_down <= megabytes * 1e6


@pytest.mark.slow
def test_a_served_frame_waits_once(monkeypatch):
    made = assemble(Settings(renderer="onefixer+clean", scenes=[SCENE], device="cuda"))
    context = SimpleNamespace(time_remaining=lambda: 60.0, is_active=lambda: True)
    with pretended_device(monkeypatch, computes=False):
        for i in range(2):
            traffic.reset()
            made.service.render_rgb(ask(1.0 + 0.1 * i), context)
    made.close()
    assert traffic.waits == {"copy to the host": 2}  # the image; and the planes that tell its map
