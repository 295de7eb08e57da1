"""The trend page in a real browser, from disk. Slow: needs an installed Chromium."""

from __future__ import annotations

from pathlib import Path

import pytest

from alpasim_plugin.cli.main import run_command
from tests.report.browser import Browser
from tests.runs.make_many import COMMITS, Many, make_one
from tests.viewer.axe import MISSING, SERIOUS, find_axe, findings

pytestmark = pytest.mark.slow
SHIFTS = (0.0, 0.0, 0.3, 0.3, 0.05)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("trend")
    for k, shift in enumerate(SHIFTS):
        day = f"2026-03-0{k + 1}T02:00:00+00:00"
        one = Many(
            f"night-{k}",
            day,
            COMMITS[k % 3],
            noise_m=0.01,
            shift_m={"onefixer": shift},
            code=f"{k // 2}" * 64,
        )
        make_one(root / "runs", one)
    make_one(root / "runs", Many("alone", "2026-03-09", preset="strict"))
    assert run_command(["runs", str(root / "runs"), "--trend", str(root / "trend.html")]) == 0
    return root / "trend.html"


@pytest.mark.parametrize(("width", "dark"), [(1400, False), (390, True), (820, False)])
def test_no_complaint_no_request_and_nothing_wider_than_the_screen(
    browser: Browser, page: Path, width: int, dark: bool
) -> None:
    browser.requests.clear()
    browser.complaints.clear()
    browser.open(page, width=width, dark=dark)
    browser.evaluate("document.querySelectorAll('details').forEach(d => { d.open = true; })")
    assert browser.complaints == []
    assert all(
        address == page.resolve().as_uri() or address.startswith("data:")
        for address in browser.requests
    )
    assert browser.evaluate("document.documentElement.scrollWidth") <= width
    assert browser.evaluate(
        "[...document.querySelectorAll('svg.chart')].every(c => c.clientHeight > 120)"
    )


def test_what_moved_leads_to_its_chart_and_sorts(browser: Browser, page: Path) -> None:
    browser.open(page)
    rows = "[...document.querySelectorAll('#table-moved tbody tr')]"
    verdicts = browser.evaluate(f"{rows}.map(r => r.cells[5].querySelector('.badge').textContent)")
    assert {"better", "worse"} <= set(verdicts)
    target = browser.evaluate(f"{rows}[0].querySelector('td a').getAttribute('href').slice(1)")
    assert (
        browser.evaluate(f"document.getElementById(decodeURIComponent('{target}')).tagName")
        == "FIGURE"
    )
    browser.evaluate("document.querySelector('#table-moved th:nth-child(4) .sort').click()")
    values = browser.evaluate(f"{rows}.map(r => Number(r.cells[3].dataset.v))")
    assert values == sorted(values)


@pytest.mark.parametrize("dark", [False, True])
def test_axe_finds_nothing_serious(browser: Browser, page: Path, dark: bool) -> None:
    script = find_axe()
    if script is None:
        pytest.skip(MISSING)
    browser.open(page, dark=dark)
    browser.evaluate("document.querySelectorAll('details').forEach(d => { d.open = true; })")
    assert [one for one in findings(browser, script) if one["impact"] in SERIOUS] == []
