"""The table of every rollout in a real browser. Slow: needs an
installed Chromium.
"""

import time

import pytest

from evaluators.pages.html import write_report

pytestmark = pytest.mark.slow

ROWS = "[...document.querySelectorAll('#table-rollouts tr[data-row]')]"


def opened(browser, page, width=1400):
    """Open a report, wait until its table is ready, and return the seconds that this took."""
    browser.complaints.clear()
    began = time.monotonic()
    browser.open(page, width=width)
    until(
        lambda: browser.evaluate("document.getElementById('rollouts-box').dataset.ready === 'yes'")
    )
    return time.monotonic() - began


def until(done):
    deadline = time.monotonic() + 60.0
    while not done():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def column(browser, head):
    index = f"[...document.querySelectorAll('#table-rollouts th[scope=col]')].findIndex(h => h.textContent === '{head}')"
    return list(browser.evaluate(f"{ROWS}.map(r => r.children[{index}].textContent)"))


def sort(browser, head):
    browser.evaluate(
        f"[...document.querySelectorAll('#table-rollouts thead .sort')].find(b => b.textContent === '{head}').click()"
    )


def choose(browser, element, value, event):
    browser.evaluate(
        f"(e => {{ e.value = '{value}'; e.dispatchEvent(new Event('{event}')); }})(document.getElementById('{element}'))"
    )


def count(browser):
    return str(browser.evaluate("document.getElementById('rollouts-count').textContent"))


def test_rows_sort_filter_and_open(browser, usual_run):
    opened(browser, write_report(usual_run))
    assert count(browser) == "72 rollouts"
    sort(browser, "lateral_distance_m")
    rising = [
        float(text.split()[0]) for text in column(browser, "lateral_distance_m") if text != "\u2014"
    ]
    assert rising == sorted(rising)
    sort(browser, "lateral_distance_m")
    falling = [
        float(text.split()[0]) for text in column(browser, "lateral_distance_m") if text != "\u2014"
    ]
    assert falling == sorted(falling, reverse=True)
    assert falling[0] == rising[-1] or len(falling) < 72  # only the rows near the top are drawn
    choose(browser, "rollouts-words", "3DGS urban", "input")
    assert set(column(browser, "scene")) == {"urban/left-turn"}
    assert set(column(browser, "renderer")) == {"3dgs"}
    choose(browser, "rollouts-state", "ended not run", "change")
    assert count(browser) == "2 of 72 rollouts"
    assert set(column(browser, "outcome")) == {"not run"}
    choose(browser, "rollouts-more", "plan_deviation", "change")
    assert column(browser, "plan_deviation") == ["\u2014", "\u2014"]
    browser.evaluate(f"{ROWS}[0].querySelector('button.open').click()")
    text = browser.evaluate("document.getElementById('rollouts-picked').textContent")
    assert "not run" in text
    assert "NaN pixels <b>" in text  # of the failure, as text
    link = browser.evaluate("document.querySelector('#rollouts-picked a')?.getAttribute('href')")
    assert link is None or (usual_run / link).is_dir()
    choose(browser, "rollouts-words", "", "input")
    choose(browser, "rollouts-state", "", "change")
    browser.evaluate(f"{ROWS}.at(-1).click()")
    assert (
        usual_run
        / browser.evaluate("document.querySelector('#rollouts-picked a').getAttribute('href')")
    ).is_dir()
    assert browser.complaints == []


def test_each_choice_of_the_filter_keeps_as_many_as_it_says(browser, usual_run):
    opened(browser, write_report(usual_run))
    options = browser.evaluate(
        "[...document.querySelectorAll('#rollouts-state option')].map(o => [o.value, o.textContent])"
    )
    ended = 0
    for value, text in options:
        choose(browser, "rollouts-state", value, "change")
        n = int(text.split("(")[-1].rstrip(")"))
        assert count(browser) in (f"{n} of 72 rollouts", "72 rollouts")
        ended += n if value.startswith("ended ") else 0
    assert ended == 72
    assert browser.complaints == []


def test_a_segment_of_the_first_screen_shows_its_rollouts(browser, usual_run):
    opened(browser, write_report(usual_run))
    n_links = browser.evaluate("document.querySelectorAll('.ended a').length")
    total = 0
    for number in range(n_links):
        link = f"document.querySelectorAll('.ended a')[{number}]"
        n = int(str(browser.evaluate(f"{link}.title")).split()[0])
        browser.evaluate(f"{link}.click()")
        assert count(browser) == f"{n} of 72 rollouts"
        assert set(column(browser, "renderer")) == {browser.evaluate(f"{link}.dataset.renderer")}
        assert set(column(browser, "policy")) == {browser.evaluate(f"{link}.dataset.policy")}
        total += n
    assert total == 72
    browser.evaluate("document.getElementById('rollouts-only').click()")
    choose(browser, "rollouts-state", "", "change")
    assert count(browser) == "72 rollouts"
    assert browser.complaints == []


def test_names_that_are_markup_stay_text(browser, hostile_run):
    opened(browser, write_report(hostile_run))
    browser.evaluate(f"{ROWS}[0].click()")
    assert "<img src=x" in "".join(column(browser, "scene"))
    assert browser.evaluate("document.querySelectorAll('#rollouts img').length") == 0
    assert browser.complaints == []
