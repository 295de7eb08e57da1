"""The report in a real browser, opened from disk. Slow: needs an installed Chromium."""

import pytest

from evaluators.pages.html import write_report

pytestmark = pytest.mark.slow


def column(browser, table, index):
    rows = f"[...document.getElementById('{table}').tBodies[0].rows]"
    return list(
        browser.evaluate(
            f"{rows}.filter(r => !r.hidden).map(r => r.children[{index}].textContent.trim())"
        )
    )


@pytest.mark.parametrize("name", ["usual_run", "hostile_run"])
@pytest.mark.parametrize(("width", "dark"), [(1400, False), (390, True)])
def test_no_complaint_and_no_outside_request(browser, request, name, width, dark):
    report = write_report(request.getfixturevalue(name))
    browser.requests.clear()
    browser.complaints.clear()
    browser.open(report, width=width, dark=dark)
    browser.evaluate("document.querySelectorAll('details').forEach(d => { d.open = true; })")
    for _ in range(2):
        browser.evaluate("document.querySelectorAll('button').forEach(b => b.click())")
    assert browser.complaints == []
    assert all(
        address == report.resolve().as_uri() or address.startswith("data:")
        for address in browser.requests
    )
    assert (
        browser.evaluate("document.documentElement.scrollWidth") <= width
    )  # tables scroll, the page does not
    shown = "[...document.querySelectorAll('#table-overview td')].every(d => d.offsetWidth > 0)"
    assert browser.evaluate(shown)


def test_changed_outcomes_lead_to_their_frames(browser, usual_run):
    browser.open(write_report(usual_run), width=390)
    opened = "[...document.querySelectorAll('.flip-card')].map(d => d.open)"
    assert browser.evaluate(opened)[0]
    assert not browser.evaluate(opened)[-1]
    browser.evaluate("[...document.querySelectorAll('#table-flips a.to-flip')].at(-1).click()")
    assert browser.evaluate(opened)[-1]
    assert browser.evaluate("location.hash") == "#" + browser.evaluate(
        "[...document.querySelectorAll('.flip-card')].at(-1).id"
    )
    shown = "[...document.querySelectorAll('.flip-card[open] img')].every(i => i.complete && i.naturalWidth > 0)"
    assert browser.evaluate(shown)
    links = browser.evaluate(
        "[...document.querySelectorAll('#table-flips td.all a:not(.to-flip)')].map(a => a.getAttribute('href'))"
    )
    assert links
    assert all((usual_run / link).exists() for link in links)


def test_on_a_phone_every_link_of_the_navigation_is_in_sight(browser, usual_run):
    browser.open(write_report(usual_run), width=390)
    sides = browser.evaluate(
        "[...document.querySelectorAll('.bar nav a')].map(a => a.getBoundingClientRect()).map(r => [r.left, r.right])"
    )
    assert len(sides) >= 5
    assert all(0 <= left < right <= 390 for left, right in sides)


def test_flips_sort_by_when_the_plans_parted_with_unknown_ones_last(browser, usual_run):
    browser.open(write_report(usual_run))
    head = "[...document.querySelectorAll('#table-flips th .sort')].find(b => b.textContent.startsWith('Plans part')).click()"
    for _ in range(2):
        browser.evaluate(head)
        times = column(browser, "table-flips", 7)
        known = [float(text.split("\u00a0")[0]) for text in times if text != "\u2014"]
        assert known in (sorted(known), sorted(known)[::-1])
        assert times[-1] == "\u2014"


def test_theme_follows_the_system_until_it_is_chosen(browser, usual_run):
    shade = "getComputedStyle(document.body).backgroundColor"
    report = write_report(usual_run)
    browser.open(report, dark=False)
    browser.evaluate("localStorage.clear()")
    browser.open(report, dark=False)
    light = browser.evaluate(shade)
    browser.open(report, dark=True)
    dark = browser.evaluate(shade)
    assert light != dark
    browser.open(report, dark=False)
    browser.evaluate("document.getElementById('theme').click()")
    assert browser.evaluate(shade) == dark
    browser.evaluate("document.getElementById('theme').click()")
    assert browser.evaluate(shade) == light
    browser.evaluate("localStorage.clear()")
