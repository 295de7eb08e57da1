import os
import re
from html.parser import HTMLParser
from urllib.parse import unquote

import pytest

from alpasim_plugin.core.errors import InfrastructureError
from evaluators.pages.html import write_report
from tests.pages.make_run import Plan, make_run

VOID = {"meta", "link", "img", "input", "br", "wbr"}
LOCAL = re.compile(r"^(#|data:|rollouts/|scenes/)")


class Page(HTMLParser):
    """Checks nesting and collects tags, addresses, ids and handlers."""

    def __init__(self, text):
        super().__init__()
        self.open = []
        self.tags = []
        self.addresses = []
        self.ids = []
        self.handlers = []
        self.text = ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        for name, value in attrs:
            if name in ("href", "src", "xlink:href", "poster", "action", "data"):
                self.addresses.append(value or "")
            if name == "id":
                self.ids.append(value or "")
            if name.startswith("on"):
                self.handlers.append(name)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag, f"</{tag}> at {self.getpos()}"

    def handle_data(self, data):
        if self.open and self.open[-1] not in ("style", "script"):
            self.text += data


def page_of(folder):
    page = Page(write_report(folder).read_text(encoding="utf-8"))
    assert page.open == []
    return page


@pytest.fixture(scope="module")
def usual_page(usual_run):
    """Give the page of the usual run; it stays beside its tables as ``report.html``."""
    return page_of(usual_run)


def test_report_is_one_well_formed_file_without_outside_addresses(usual_run, usual_page):
    page = usual_page
    assert all(LOCAL.match(address) for address in page.addresses)
    assert len(page.ids) == len(set(page.ids))
    assert not page.handlers
    text = (usual_run / "report.html").read_text()
    assert not re.search(r"(src|href)=[\"']?(https?:)?//", text)
    assert "url(http" not in text
    assert "@import" not in text


def test_every_link_leads_to_a_file_or_a_place_in_the_page(usual_run, usual_page):
    page = usual_page
    for address in page.addresses:
        if address.startswith("#"):
            assert address[1:] in page.ids
        elif not address.startswith("data:"):
            assert (usual_run / unquote(address)).exists(), address


def test_verdict_comes_first(usual_run, usual_page):
    page = usual_page
    heads = ["Changed outcomes", "From above"]
    heads += [
        "Every rollout",
        "Speed",
        "Failures",
        "What the numbers leave out",
    ]
    heads += ["Provenance"]
    assert re.findall(r"<h2>([^<]*)</h2>", (usual_run / "report.html").read_text()) == heads
    assert page.tags.index("svg") < page.tags.index("details")  # the differences, before any fold
    assert page.tags.index("h1") < page.tags.index("table")


def test_hostile_names_stay_text(hostile_run):
    page = page_of(hostile_run)
    assert not page.handlers
    assert page.tags.count("script") == 1
    assert all(LOCAL.match(address) for address in page.addresses)
    assert "{{7*7}}" in page.text
    assert "49" not in re.findall(r"onerror=alert\(1\)>\"'&\|(\S+)", page.text)
    for address in page.addresses:
        if not address.startswith(("#", "data:")):
            assert (hostile_run / unquote(address)).resolve().is_relative_to(hostile_run.resolve())


def test_numbers_that_are_missing_are_dashes_with_a_reason(usual_run, usual_page):
    text = (usual_run / "report.html").read_text()
    reasons = re.findall(r'<span class="missing" title="([^"]*)"[^>]*>([^<]*)</span>', text)
    assert reasons
    assert all(reason and dash == "\u2014" for reason, dash in reasons)
    assert ("the policy gives no plan of 1.0 s", "\u2014") in reasons


def test_run_without_rollouts_has_a_report(tmp_path):
    page = page_of(make_run(tmp_path, Plan(renderers=(), scenes=())))
    assert "Nothing was run" in page.text
    assert "There is no metric" in page.text


def test_run_whose_every_rollout_failed_has_a_report(tmp_path):
    page = page_of(
        make_run(
            tmp_path,
            Plan(renderers=("3dgs",), scenes=("a",), seeds=(0,), steps=3, fail=[("3dgs", "a", 0)]),
        )
    )
    assert "1 not run" in page.text
    assert "1204 NaN pixels <b>&" in page.text


def test_same_folder_gives_the_same_bytes(usual_run, usual_page):
    first = (usual_run / "report.html").read_bytes()
    assert write_report(usual_run).read_bytes() == first


def test_disk_that_refuses_is_a_four_part_error_and_keeps_the_old_file(tmp_path, monkeypatch):
    folder = make_run(tmp_path, Plan(renderers=("clean",), scenes=("a",), seeds=(0,), steps=3))
    before = write_report(folder).read_bytes()

    def refuse(fd):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(InfrastructureError) as caught:
        write_report(folder)
    assert "No space left on device" in caught.value.message
    assert (folder / "report.html").read_bytes() == before
    assert not list(folder.glob(".*.tmp"))
