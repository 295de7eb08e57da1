"""Rule 6: what scenes, logs and parts are called cannot act where it is shown."""

import xml.etree.ElementTree as ET

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.escape import MAX_PART, markdown, terminal, xml
from evaluators.pages.ci import write_junit, write_summary_md
from evaluators.statistics.opening import read_run
from tests.pages.make_run import Plan, make_run

HOSTILE = "a|b`c <img src=x>&amp; [l](javascript:1) \x1b[31m\x07 \u202e\u0000 *b* _i_\n# head"


def test_a_terminal_sees_no_control_character():
    shown = terminal(HOSTILE)
    assert shown.isprintable()
    assert "\\x1b[31m" in shown
    assert "\\u202e" in shown
    assert terminal("Grüße, 東京 ± 1.5 m") == "Grüße, 東京 ± 1.5 m"


def test_markdown_shows_text_as_it_is():
    shown = markdown(HOSTILE)
    assert "\n" not in shown
    assert not set("<>") & set(shown)
    for mark in "|`[]*#":
        assert shown.count(mark) == shown.count(f"\\{mark}"), mark
    assert "&amp;amp;" in shown
    assert markdown("collision_at_fault") == "collision_at_fault"


def test_xml_holds_any_text():
    element = ET.Element("a", {"b": xml("".join(map(chr, range(0x300))) + "\ud800\uffff")})
    assert ET.fromstring(ET.tostring(element)).get("b") is not None


def test_parts_of_errors_are_short_and_cannot_act():
    error = InputError(f"{'a' * 10000}: {f'found {HOSTILE}' + 'b' * 7500000}", "do")
    assert all(len(part) <= MAX_PART and part.isprintable() for part in (error.message, error.hint))
    assert "10000" not in error.message
    assert "aaa" in error.message
    assert "more" in error.message
    assert str(error).count("\n") == 1


def test_a_run_of_hostile_names_is_reported_in_whole_tables(tmp_path):
    run = make_run(
        tmp_path / "run",
        Plan(
            renderers=("clean", HOSTILE),
            scenes=(HOSTILE, "plain"),
            seeds=(0, 1),
            steps=20,
            clips=False,
            fail=[("clean", "plain", 0)],
            failure=HOSTILE,
        ),
    )
    text = write_summary_md(read_run(run)).read_text()
    assert "\x1b" not in text
    assert not any("<img" in part for part in text.split("```")[::2])  # blocks of code are text
    for line in text.splitlines():
        if line.startswith("|"):
            cells = line.replace("\\|", "").count("|")
            assert cells >= 3, line
    ET.parse(write_junit(read_run(run)))
