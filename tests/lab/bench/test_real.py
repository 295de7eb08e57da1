"""`simrun bench real` on a drive made by hand: rows by camera, set and distance, and what is
refused.
"""

import json
from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.interfaces import BlockRule, Renderer
from alpasim_plugin.core.types import Frame
from alpasim_plugin.lab.bench.real import METRICS, Judges, intervals, measure_drive, shots_of
from alpasim_plugin.lab.cli import bench_real
from alpasim_plugin.renderers import make_renderer
from tests.gaussians.scene_maps import straight
from tests.renderers.recorded_drive import EXPOSURE, SKY_LEVEL, recorded_drive

KEYS = ["drive", "renderer", "camera", "set", "distance_m", "n_frames", *METRICS]


class Difference:
    """Mean absolute difference, in place of a network."""

    def distance(self, a, b):
        return (a - b).abs().mean(dim=(1, 2, 3))


class Truth(Renderer):
    """Show what the photographs of the drive show, and note the order of requests."""

    def __init__(self):
        self.asked = []

    def render(self, request):
        self.asked.append(request.t_us)
        picture = np.full((request.camera.height, request.camera.width, 3), 122, dtype=np.uint8)
        picture[: request.camera.height // 2] = round(SKY_LEVEL * EXPOSURE)
        return Frame(request.t_us, request.camera.name, picture)


class Blocks(Truth):
    block = BlockRule(5, 8)


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return recorded_drive(tmp_path_factory.mktemp("drive"))


def test_photographs_that_no_fit_saw_make_rows_by_camera_and_distance(drive):
    truth = Truth()
    rows = measure_drive("d", drive, {"truth": lambda: truth}, Judges(Difference(), None))
    assert [list(row) for row in rows] == [KEYS] * 2
    held, beside = rows
    assert (held["camera"], held["set"], held["n_frames"], held["distance_m"]) == (
        "front",
        "held-out",
        1,
        0.0,
    )
    assert (beside["camera"], beside["set"], beside["n_frames"]) == ("right", "never-fitted", 9)
    assert beside["distance_m"] == pytest.approx(0.5, abs=0.02)
    assert held["psnr_db"] == 100.0
    assert held["perceptual_syn"] == 0.0
    assert held["cvvdp_jod"] is None
    assert held["paint_precision"] is None, "there is no paint"
    assert truth.asked == sorted(truth.asked[:9]) * 2, (
        "every photograph in order of time, so that a fixer has its history"
    )


def test_the_model_is_near_its_photographs_and_a_second_drive_gives_intervals(
    drive,
):
    judges = Judges(Difference(), None)
    rows = measure_drive(
        "d", drive, {"3dgs": lambda: make_renderer("3dgs", drive, threads=1)}, judges
    )
    assert all(float(row["psnr_db"]) > 17 for row in rows)  # type: ignore[arg-type]
    assert intervals(rows) == []
    other = [{**row, "drive": "e", "psnr_db": float(row["psnr_db"]) + 2.0} for row in rows]  # type: ignore[arg-type]
    found = next(
        row
        for row in intervals([*rows, *other])
        if row["metric"] == "psnr_db" and row["set"] == "held-out"
    )
    assert found["drives"] == 2
    assert found["mean"] == pytest.approx(float(rows[0]["psnr_db"]) + 1.0)  # type: ignore[arg-type]
    assert found["median_ci95"] is None, "two drives bound nothing"
    six = [{**row, "drive": n, "psnr_db": n * n} for n in range(6) for row in rows]
    wide = next(row for row in intervals(six) if row["metric"] == "psnr_db")
    assert (wide["mean"], wide["median"]) == (pytest.approx(55 / 6), 6.5)
    assert wide["median_ci95"] == [0.0, 25.0], "the least and the greatest of six hold it in 97 %"


def test_what_cannot_be_measured_is_refused(drive):
    with pytest.raises(InputError):
        shots_of(straight())
    with pytest.raises(InputError):
        shots_of(
            replace(drive, recording=tuple(one for one in drive.recording if one.use == "fitted"))
        )
    with pytest.raises(InputError):
        measure_drive("d", drive, {"blocks": Blocks}, Judges(Difference(), None))


def test_the_command_prints_one_document(drive, monkeypatch, capsys):
    monkeypatch.setattr(bench_real, "_loaded", lambda drives: {"d": drive})
    monkeypatch.setattr(
        bench_real,
        "load_metric",
        lambda: (None, "cvvdp_jod is not measured: there is no module 'pycvvdp'"),
    )
    monkeypatch.setattr(bench_real, "load_distance", lambda name: Difference())
    assert (
        run_command(
            [
                "bench",
                "real",
                "d",
                "--renderer",
                "3dgs,nearest[references=2]",
                "--json",
                "--threads",
                "1",
                "--seed",
                "1",
                "--device",
                "cpu",
            ]
        )
        == 0
    )
    out, err = capsys.readouterr()
    document = json.loads(out)
    assert list(document) == ["rows"]
    assert [list(row) for row in document["rows"]] == [KEYS] * 4
    assert [row["renderer"] for row in document["rows"]] == [
        "3dgs",
        "3dgs",
        "nearest[references=2]",
        "nearest[references=2]",
    ]
    assert document["rows"][2]["psnr_db"] > 12
    assert "one drive: no interval" in err
    assert "cvvdp_jod is not measured" in err
    assert run_command(["bench", "real", "d", "--renderer", "3dgs,3dgs"]) == 2
    assert run_command(["bench", "real", "d", "--renderer", "3dgs,onefixr"]) == 2
