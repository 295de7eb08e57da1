"""What a size costs is said before its first frame, and a smaller picture may be made and
enlarged.
"""

from __future__ import annotations

import logging
from dataclasses import replace

import cv2
import numpy as np
import pytest

from alpasim_plugin.alpasim.server.assembly import Settings, assemble
from alpasim_plugin.alpasim.server.frames import Announced, cost_s
from alpasim_plugin.alpasim.server.status import CallTime
from alpasim_plugin.alpasim.server.views import View, read_view
from alpasim_plugin.log.images import decode_image
from alpasim_plugin.log.wire import sensorsim_pb2
from tests.alpasim.test_sensorsim_local import SCENE, ask

VIEW = replace(read_view(ask()), width=1920, height=1080)


class Machine:
    """One that needs 20 ms and a microsecond a pixel, and much more the first time."""

    def __init__(self) -> None:
        self.now_s, self.made = 0.0, list[View]()

    def make(self, view: View) -> None:
        self.now_s += 0.02 + 1e-6 * view.width * view.height + (0.0 if self.made else 30.0)
        self.made.append(view)


def test_the_cost_is_read_off_smaller_frames() -> None:
    machine = Machine()
    assert cost_s(machine.make, VIEW, lambda: machine.now_s) == pytest.approx(0.02 + 1.92 * 1.08)
    assert {(view.width, view.height) for view in machine.made} == {(240, 135), (480, 270)}
    assert {view.lens for view in machine.made} == {VIEW.lens}


def test_a_view_of_one_pixel_has_a_cost() -> None:
    machine = Machine()
    assert cost_s(
        machine.make, replace(VIEW, width=1, height=1), lambda: machine.now_s
    ) == pytest.approx(0.02, abs=1e-5)


def test_a_slow_size_is_a_warning_with_the_way_out_and_said_once(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level(logging.INFO, "simrun.serve")
    monkeypatch.setattr(
        "alpasim_plugin.alpasim.server.frames.cost_s", lambda make, view: view.width / 1000
    )
    said = Announced(may_shrink=True)
    for view in (VIEW, VIEW, replace(VIEW, lens=b"another", width=320, height=180)):
        said.before(view, lambda view: None)
    slow, quick = caplog.records
    assert (slow.levelno, quick.levelno) == (logging.WARNING, logging.INFO)
    assert (
        "1920 x 1080: about 1.9 s a frame on this machine; --render-width 960 makes frames of 960 x 540"
        in slow.message
    )
    assert "320 x 180: about 0.32 s" in quick.message


def frames(requests: list[sensorsim_pb2.RGBRenderRequest], **settings: object) -> list[bytes]:
    made = assemble(Settings(scenes=[SCENE], threads=1, **settings))  # type: ignore[arg-type]
    return [made.service.frames.answers([asked], CallTime())[0] for asked in requests]


def test_measuring_changes_no_frame_and_starts_no_history(
    overrides: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "simrun.serve")
    asked = [ask(1.0 + 0.1 * i) for i in range(2)]
    silent, said = (
        frames(asked, renderer="onefixer+clean", overrides=overrides, says_costs=says)
        for says in (False, True)
    )
    assert silent == said
    assert len(caplog.records) == 1


@pytest.mark.parametrize("renderer", ["clean", "onefixer+clean"])
def test_a_smaller_picture_is_enlarged_to_the_size_asked_for(
    renderer: str, overrides: list[str]
) -> None:
    given = {} if renderer == "clean" else {"overrides": overrides}
    asked = [ask(1.0 + 0.1 * i) for i in range(2)]
    small = [ask(1.0 + 0.1 * i) for i in range(2)]
    for one in small:
        one.resolution_w, one.resolution_h = one.resolution_w // 2, one.resolution_h // 2
    size = asked[0].resolution_w, asked[0].resolution_h
    got = [
        decode_image(data)
        for data in frames(asked, renderer=renderer, render_width=size[0] // 2, **given)
    ]
    for image, half in zip(got, frames(small, renderer=renderer, **given), strict=True):
        np.testing.assert_array_equal(
            image, cv2.resize(decode_image(half), size, interpolation=cv2.INTER_CUBIC)
        )
    assert frames(small, renderer=renderer, render_width=size[0], **given) == frames(
        small, renderer=renderer, **given
    )
