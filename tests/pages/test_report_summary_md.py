from hypothesis import given
from hypothesis import strategies as st

from evaluators.pages.ci import CUT_NOTE, cut, write_summary_md
from evaluators.pages.overview import overview_of
from evaluators.statistics.opening import read_run


def test_summary_has_the_first_screen_all_metrics_and_the_command(usual_run):
    text = write_summary_md(read_run(usual_run)).read_text(encoding="utf-8")
    shown = overview_of(read_run(usual_run))
    assert all(row.name in text and row.where.split()[0] in text for row in shown.failing)
    assert text.count("<details>") == text.count("</details>") == 2
    assert "simrun run --renderer" in text
    assert "\u2014 (the policy gives no plan of 1.0 s)" in text


def test_every_table_row_has_as_many_cells_as_its_head(hostile_run):
    lines = write_summary_md(read_run(hostile_run)).read_text(encoding="utf-8").splitlines()
    widths = []
    for before, line in zip(["", *lines], lines, strict=False):
        if line.startswith("|"):
            cells = line.replace("\\|", "").count("|")
            if not before.startswith("|"):
                widths.append(cells)
            assert cells == widths[-1], line
    assert len(widths) >= 3
    outside = "\n".join(lines).split("```")[::2]  # names inside a block are text
    assert not any("<img" in text or "<script" in text for text in outside)


@given(st.text(st.characters(codec="utf-8"), min_size=200, max_size=2000), st.integers(150, 1000))
def test_cut_keeps_within_the_limit_and_stays_text(text, limit):
    done = cut(text, limit)
    assert len(done.encode()) <= max(limit, len(CUT_NOTE.encode()))
    if len(text.encode()) <= limit:
        assert done == text
    else:
        assert done.endswith(CUT_NOTE)
        assert text.startswith(done.removesuffix(CUT_NOTE))


def test_cut_leaves_room_for_its_note_and_takes_no_more_than_that():
    text = "".join(f"row {i:04d} of a table \u2014 its name\n" for i in range(400))
    row = len(text.splitlines(keepends=True)[0].encode())
    for limit in (1000, 1001, 1017, 5000):
        done = cut(text, limit)
        assert limit - row < len(done.encode()) <= limit
        assert text.startswith(done.removesuffix(CUT_NOTE))
