"""Figures of the comparison: drawn where there are numbers, and a reason where there are none."""

import cv2
import numpy as np

from alpasim_plugin.lab.paper.figures import write_figures
from alpasim_plugin.lab.paper.records import Quality

SCENES = [f"scene-{i}" for i in range(8)]


def values(first):
    return dict(zip(SCENES, np.linspace(first, first + 0.1, len(SCENES)).tolist(), strict=True))


def record(*rows, metrics=("perceptual-syn", "warp_l1_late_road", "ms_per_frame")):
    return Quality(
        {row: {name: values(0.1 + 0.1 * i) for name in metrics} for i, row in enumerate(rows)}, {}
    )


def test_figures_are_images_and_one_without_numbers_has_a_reason(tmp_path):
    rows = ("3dgs", "V9", "V1")
    reasons = write_figures(rows, record(*rows), tmp_path)
    assert reasons["tradeoff.png"] is None
    assert reasons["differences.png"] is None
    assert "400 clips" in reasons["over-a-clip.png"]
    written = sorted(path.name for path in (tmp_path / "figures").iterdir())
    assert written == ["differences.png", "tradeoff.png"]
    for name in written:
        image = cv2.imread(str(tmp_path / "figures" / name), cv2.IMREAD_GRAYSCALE)
        assert np.ptp(image) > 200


def test_a_curve_is_drawn_where_windows_have_a_value(tmp_path):
    windows = [{"first_frame": 0, "value": 3.0}, {"first_frame": 93, "value": 4.0}]
    quality = Quality(record("V9").by_scene, {"V9": {"fvd": {"windows": windows}}})
    assert write_figures(("V9",), quality, tmp_path)["over-a-clip.png"] is None
    assert (tmp_path / "figures" / "over-a-clip.png").is_file()


def test_nothing_is_drawn_without_the_metrics(tmp_path):
    reasons = write_figures(("V9", "V1"), record("V9", "V1", metrics=("psnr_db",)), tmp_path)
    assert None not in reasons.values()
    assert not (tmp_path / "figures").exists()
