"""The page of a failure in a browser: with images and without, on a desk and on a phone."""

import dataclasses

import pytest

from alpasim_plugin.log.run_folder.manifests import read_manifest, write_manifest
from alpasim_plugin.log.run_folder.records import DriveEvent
from alpasim_plugin.runs.reports import failure_cause
from evaluators.pages.cause import log_so_far, write_cause
from evaluators.statistics.cause import worst_failure
from evaluators.statistics.opening import read_run
from tests.pages.browser import LIMITS_ON_PLOTS, Browser, find_chromium
from tests.pages.make_run import Plan
from tests.pages.make_watched import make_watched

pytestmark = pytest.mark.slow


@pytest.fixture
def chromium():
    executable = find_chromium()
    if executable is None:
        pytest.skip("no Chromium is installed")
    with Browser(executable) as browser:
        yield browser


def page_of(folder, cameras):
    """Make a run and return the page of its worst failure that has a log."""
    plan = Plan(renderers=("clean", "3dgs"), scenes=("smoke-straight",), seeds=(0, 1), steps=24)
    plan = dataclasses.replace(plan, harm={"clean": 6.0, "3dgs": 6.0})
    run = read_run(make_watched(folder, plan, cameras=cameras))
    worst = worst_failure(run)
    log = log_so_far(run, worst)
    place = run.folder / worst.path
    event = DriveEvent("offroad", int(log.ego.t_us[-4]), 2.0, *log.ego.xyz[-4, :2].tolist())
    write_manifest(place, dataclasses.replace(read_manifest(place), events=(event,)))
    return write_cause(run, failure_cause(run, worst))


@pytest.mark.parametrize("width", [1280, 390])
@pytest.mark.parametrize("cameras", [("front",), ()])
def test_the_motion_is_drawn_with_images_and_without_and_nothing_complains(
    chromium, tmp_path, cameras, width
):
    chromium.open(page_of(tmp_path / "run", cameras), width=width)
    chromium.evaluate("new Promise(requestAnimationFrame)")
    painted = chromium.evaluate(
        "(() => { const c = document.getElementById('above'); return c.width * c.height; })()"
    )
    assert painted > 10_000
    titles = chromium.evaluate(
        "[...document.querySelectorAll('#curves b')].map(b => b.textContent)"
    )
    assert titles[0] == "Speed"
    assert titles[-1] == "Lateral offset"
    assert chromium.evaluate("document.querySelectorAll('#curves .failed').length") == len(titles)
    assert chromium.evaluate(LIMITS_ON_PLOTS) == [len(titles), []]
    assert chromium.evaluate("document.getElementById('when').textContent")
    assert (chromium.evaluate("document.querySelectorAll('#layers').length") > 0) == bool(cameras)
    assert chromium.evaluate("document.documentElement.scrollWidth") <= width
    assert not chromium.complaints
    assert all(address.startswith(("file:", "data:", "blob:")) for address in chromium.requests)
