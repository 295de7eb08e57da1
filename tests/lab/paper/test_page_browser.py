"""The page of all arms side by side in a browser: what is hidden, and which curves stand out."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from alpasim_plugin.lab.paper.page import ShownClip, render_side_by_side
from tests.report.browser import Browser


@pytest.fixture
def page(tmp_path: Path) -> Path:
    film = [
        cv2.imencode(".jpg", np.full((9, 16, 3), level, np.uint8))[1].tobytes()
        for level in (40, 200)
    ]
    arms = [f"arm-{k}" for k in range(10)]
    clip = ShownClip(
        "one",
        dict.fromkeys(arms, film),
        {"psnr_db": {arm: [20.0 + k, 21.0 + k] for k, arm in enumerate(arms)}},
    )
    (tmp_path / "page.html").write_text(render_side_by_side([clip], (9, 16)))
    return tmp_path / "page.html"


def test_one_button_hides_and_shows_all_arms(browser: Browser, page: Path) -> None:
    browser.open(page)
    shown = "document.querySelectorAll('.arm:not(.off)').length"
    curves, label = (
        "document.querySelectorAll('.charts path').length",
        "document.getElementById('all').textContent",
    )
    assert [browser.evaluate(one) for one in (shown, curves, label)] == [10, 10, "Hide all"]
    browser.evaluate("document.getElementById('all').click()")
    assert [browser.evaluate(one) for one in (shown, curves, label)] == [0, 0, "Show all"]
    browser.evaluate("document.querySelectorAll('.toggle')[3].click()")
    assert [browser.evaluate(one) for one in (shown, curves, label)] == [1, 1, "Show all"]
    browser.evaluate("document.getElementById('all').click()")
    assert [browser.evaluate(one) for one in (shown, curves, label)] == [10, 10, "Hide all"]


def test_the_curves_of_an_arm_that_is_pointed_at_stand_out_and_lines_have_names(
    browser: Browser, page: Path
) -> None:
    browser.open(page)
    names = browser.evaluate(
        "[...document.querySelectorAll('.charts path title')].map(t => t.textContent)"
    )
    assert names == [f"arm-{k}" for k in range(10)]
    looks = "[...document.querySelectorAll('.charts path')].map(p => p.getAttribute('stroke') + p.getAttribute('stroke-dasharray'))"
    assert len(set(browser.evaluate(looks))) == 10
    out = "[...document.querySelectorAll('.charts .pointed path.of title')].map(t => t.textContent)"
    browser.evaluate(
        "document.querySelectorAll('.arm')[9].dispatchEvent(new Event('pointerenter'))"
    )
    assert browser.evaluate(out) == ["arm-9"]
    browser.evaluate(
        "document.querySelectorAll('.arm')[9].dispatchEvent(new Event('pointerleave'))"
    )
    assert browser.evaluate(out) == []
