"""The replay page in a real browser, Slow: needs an installed
Chromium.
"""

import time
from urllib.parse import quote

import pytest

from evaluators.metrics import METRICS
from evaluators.pages.cells import Wanted
from evaluators.pages.html import write_report
from evaluators.pages.page import write_page
from evaluators.statistics.opening import read_run
from tests.pages.axe import MISSING, SERIOUS, find_axe, findings
from tests.pages.browser import LIMITS_ON_PLOTS
from tests.pages.make_run import Plan
from tests.pages.make_watched import BARS, make_watched

pytestmark = pytest.mark.slow
SEEN = f"""(() => {{
  const bars = (canvas) => {{
    const data = canvas.getContext('2d').getImageData(0, canvas.height >> 1, canvas.width, 1).data, wide = canvas.width / {BARS};
    let number = 0;
    for (let bar = 0; bar < {BARS}; bar += 1) number = 2 * number + (data[4 * Math.round((bar + 0.5) * wide)] > 127 ? 1 : 0);
    return number;
  }};
  return [...document.querySelectorAll('#cameras canvas')].map(bars);
}})()"""


@pytest.fixture(scope="module")
def page(watched_run, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "view.html"
    return write_page(read_run(watched_run), path, Wanted()).path


def settled(browser):
    """Wait until the cell that was chosen is shown, with its frames."""
    browser.evaluate(
        "(async () => { await Promise.resolve(); await player.drawn; await new Promise(requestAnimationFrame); })()"
    )


def seek(browser, ms):
    browser.evaluate(f"(async () => {{ player.seek({ms}); await player.drawn; }})()")


@pytest.mark.parametrize("width", [1400, 390])
def test_no_curve_crosses_the_numbers_of_its_axis(browser, page, width):
    browser.open(page, width=width)
    settled(browser)
    count, crossed = browser.evaluate(LIMITS_ON_PLOTS)
    assert count > 2
    assert crossed == []


@pytest.mark.parametrize(("width", "dark"), [(1400, False), (390, True), (820, False)])
def test_no_complaint_no_request_and_nothing_wider_than_the_screen(browser, page, width, dark):
    browser.requests.clear()
    browser.complaints.clear()
    browser.open(page, width=width, dark=dark)
    settled(browser)
    browser.evaluate("document.querySelector('aside details').open = true")
    browser.evaluate("document.querySelectorAll('#chooser input').forEach(b => b.click())")
    for cell in browser.evaluate("player.here().map(c => c.id)"):
        browser.evaluate(f"player.open('{cell}')")
        settled(browser)
    assert browser.complaints == []
    assert all(
        address == page.resolve().as_uri() or address.startswith(("data:", "blob:"))
        for address in browser.requests
    )
    assert browser.evaluate("document.documentElement.scrollWidth") <= width
    assert browser.evaluate("document.getElementById('birdseye').clientHeight") >= 150


def test_all_cameras_show_the_frame_of_the_scrubbers_time(browser, page):
    browser.open(page)
    settled(browser)
    for ms, frame in ((0, 0), (1000, 10), (1049, 10), (1090, 10), (1100, 11), (300, 3), (2200, 22)):
        browser.evaluate(f"document.getElementById('scrub').value = {ms}")
        browser.evaluate("document.getElementById('scrub').dispatchEvent(new Event('input'))")
        shown = (
            int(browser.evaluate("document.getElementById('scrub').value")) // 100
        )  # the scrubber has steps of its own
        browser.evaluate("player.drawn")
        assert browser.evaluate(SEEN) == [shown] * 3
        assert abs(shown - frame) <= 1
        assert browser.evaluate(
            "document.getElementById('scrub').getAttribute('aria-valuetext')"
        ).endswith("seconds")


def test_the_keyboard_does_everything(browser, page):
    browser.open(page)
    settled(browser)
    seek(browser, 500)
    clock = "player.t"
    browser.press("ArrowRight", 39)
    assert browser.evaluate(clock) == 600
    browser.press("ArrowLeft", 37)
    browser.press("ArrowLeft", 37)
    assert browser.evaluate(clock) == 400
    browser.press("ArrowRight", 39, shift=True)
    assert browser.evaluate(clock) == 1400
    browser.press("Home", 36)
    assert browser.evaluate(clock) == 0
    browser.press(" ", 32)
    assert browser.evaluate("player.playing")
    assert browser.evaluate("document.getElementById('play').getAttribute('aria-label')") == "Pause"
    time.sleep(0.3)
    browser.press(" ", 32)
    assert not browser.evaluate("player.playing")
    assert 0 < browser.evaluate(clock) < 5000
    browser.press(".", 190)
    assert browser.evaluate("[player.speed, document.getElementById('speed').value]") == [2, "2"]
    first = browser.evaluate("player.cell.id")
    browser.press("]", 221)
    settled(browser)
    assert browser.evaluate("player.cell.id") == browser.evaluate("player.here()[1].id") != first
    browser.press("[", 219)
    settled(browser)
    assert browser.evaluate("player.cell.id") == first
    browser.press("2", 50)
    assert (
        browser.evaluate("document.querySelectorAll('.focus')[1].getAttribute('aria-pressed')")
        == "true"
    )
    browser.press("f", 70)
    assert (
        browser.evaluate("document.getElementById('whole').getAttribute('aria-pressed')") == "true"
    )
    browser.press("?", 191, shift=True)
    assert browser.evaluate("document.getElementById('keys').open")
    browser.press("Escape", 27)
    assert not browser.evaluate("document.getElementById('keys').open")


def test_keys_jump_from_event_to_event(browser, page):
    browser.open(page)
    settled(browser)
    seek(browser, 0)
    times = browser.evaluate("player.moments.all.map(m => m.t)")
    assert len(times) >= 4  # off-road, plans that part, replaced frames
    for expected in sorted(set(times)):
        browser.press("e", 69)
        assert browser.evaluate("player.t") == expected
        assert browser.evaluate("document.querySelectorAll('#moments [aria-current]').length") == 1
    browser.press("e", 69)
    assert browser.evaluate("document.getElementById('said').textContent") == "No later event"
    browser.press("E", 69, shift=True)
    assert browser.evaluate("player.t") == sorted(set(times))[-2]
    browser.evaluate("document.querySelector('#moments button').click()")
    assert browser.evaluate("player.t") == times[0]
    assert "seconds" in browser.evaluate("document.getElementById('said').textContent")


def test_changed_outcomes_lead_to_their_rollouts(browser, page):
    browser.open(page)
    settled(browser)
    count = browser.evaluate("document.querySelectorAll('#flips button').length")
    assert count == 3
    for i in range(count):
        browser.evaluate(f"document.querySelectorAll('#flips button')[{i}].click()")
        settled(browser)
        entry = browser.evaluate("(e => [e.scene, String(e.seed)])(player.entry(player.cell.id))")
        assert (
            browser.evaluate("['scene', 'seed'].map(k => document.getElementById(k).value)")
            == entry
        )
        assert browser.evaluate("player.cell.drives[player.focus].renderer") == "3dgs"
        assert (
            browser.evaluate("document.querySelector('.camera.focused .outcome').textContent")
            != "no event"
        )


def test_an_address_opens_a_rollout_at_a_time(browser, page):
    where = f"#scene={quote('smoke-straight')}&policy=lane-camera&seed=1&renderer=onefixer&t=1.2"
    browser.visit(page.resolve().as_uri() + where)
    settled(browser)
    assert browser.evaluate(
        "[player.entry(player.cell.id).scene, player.entry(player.cell.id).seed, player.t]"
    ) == [
        "smoke-straight",
        1,
        1200,
    ]
    assert browser.evaluate("player.cell.drives[player.focus].renderer") == "onefixer"
    browser.press("ArrowRight", 39)
    assert "t=1.30" in browser.evaluate("location.hash")
    browser.visit("about:blank")
    browser.visit(page.resolve().as_uri() + "#scene=nowhere&seed=0")
    settled(browser)
    assert not browser.evaluate("document.getElementById('missing').hidden")


def test_curves_show_where_no_value_is_valid_and_what_is_not_chosen_is_gone(browser, page):
    browser.open(page)
    settled(browser)
    browser.evaluate("player.open(player.index.cells.find(c => c.scene === 'urban-left_turn').id)")
    settled(browser)
    names = browser.evaluate("[...document.querySelectorAll('#curves h3')].map(h => h.textContent)")
    label = METRICS.shown("min_distance_to_obstacle_m").label
    assert "_" not in label
    assert any(label in name for name in names)
    assert "no other road user" in browser.evaluate(
        "document.querySelector('#curves .why').textContent"
    )
    assert browser.evaluate("document.querySelectorAll('#curves .invalid').length") >= 3
    chosen = browser.evaluate("document.querySelectorAll('#curves .curve').length")
    browser.evaluate("document.querySelector('#chooser input:checked').click()")
    assert browser.evaluate("document.querySelectorAll('#curves .curve').length") == chosen - 1


def test_a_page_without_frames_says_so(browser, tmp_path):
    root = make_watched(
        tmp_path / "run",
        Plan(renderers=("clean", "3dgs"), scenes=("smoke-straight",), seeds=(0,), steps=8),
        cameras=(),
    )
    browser.open(write_page(read_run(root), tmp_path / "view.html", Wanted()).path)
    settled(browser)
    assert (
        browser.evaluate(
            "[...document.querySelectorAll('.stage .none')].filter(p => p.textContent.includes('--video all')).length"
        )
        == 2
    )


@pytest.mark.parametrize(
    ("width", "dark"), [(1400, False), (1400, True), (390, False), (390, True)]
)
def test_axe_finds_nothing_serious(browser, page, usual_report, width, dark):
    script = find_axe()
    if script is None:
        pytest.skip(MISSING)
    for path in (page, usual_report):
        browser.open(path, width=width, dark=dark)
        browser.evaluate("document.querySelectorAll('details').forEach(d => { d.open = true; })")
        serious = [one for one in findings(browser, script) if one["impact"] in SERIOUS]
        assert serious == [], path.name


@pytest.fixture(scope="module")
def usual_report(watched_run):
    return write_report(watched_run)
