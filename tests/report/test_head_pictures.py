"""The pictures at the head of a report."""

from __future__ import annotations

import base64
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from evaluators.report.html import _shot


@pytest.mark.parametrize(("failed_us", "shown"), [(3_300_000, 1), (500_000, 0), (None, 2)])
def test_a_failure_is_shown_by_the_last_picture_before_it(
    tmp_path: Path, failed_us: int | None, shown: int
) -> None:
    times = [
        600_000,
        2_200_000,
        3_800_000,
        5_400_000,
    ]  # the third is nearer to 3.3 s, after the contact
    strip = np.concatenate([np.full((90, 160, 3), 60 * i, np.uint8) for i in range(4)], axis=1)
    path = tmp_path / "strip.png"
    cv2.imwrite(str(path), strip)
    events = (
        []
        if failed_us is None
        else [{"metric": "collision_front", "t_us": failed_us, "t_s": failed_us * 1e-6}]
    )
    manifest = {"strip_t_us": times, "events": events}
    run: Any = SimpleNamespace(
        file_of=lambda *_: path,
        manifest=lambda _: manifest,
        href=lambda *_: None,
        renderers=["a"],
        policies=["b"],
        folder=tmp_path,
    )
    rollout: Any = SimpleNamespace(
        ok=True, metrics={}, policy="b", renderer="a", scene="s", variant="a", flag=lambda _: False
    )
    shot = _shot(run, rollout)
    assert shot is not None
    picture: Any = cv2.imdecode(
        np.frombuffer(base64.b64decode(shot["src"].split(",")[1]), np.uint8), cv2.IMREAD_COLOR
    )
    assert abs(float(picture.mean()) - 60 * shown) < 3
