"""Errors that the page of troubleshooting quotes are those that the code prints."""

import re

ROOMS = ("alpasim_plugin", "evaluators", "policies", "scenarios")
HEADING = re.compile(r"^### `(.+)`$", re.M)


def test_every_quoted_error_is_a_text_of_the_code(repo):
    quoted = HEADING.findall((repo / "docs" / "troubleshooting.md").read_text())
    assert len(quoted) >= 10
    # A text may go on in the next literal of the source.
    sources = [
        re.sub(r'"\s*\n\s*f?"', "", path.read_text(encoding="utf-8"))
        for room in ROOMS
        for path in (repo / room).rglob("*.py")
    ]
    missing = [
        text
        for text in quoted
        if not any(re.search(as_pattern(text), source) for source in sources)
    ]
    assert missing == []


def as_pattern(text):
    """Return the pattern of a message in the source, where `...` is what is put in."""
    parts = (re.escape(part) for part in text.split("..."))
    return r"(?:\{[^{}]*(?:\{[^{}]*\}[^{}]*)*\})?".join(parts)


def test_a_text_that_the_code_does_not_have_is_told():
    source = 'raise InputError(f"{word}: no such thing as {other!r} here", "hint")'
    assert re.search(as_pattern("...: no such thing as ... here"), source)
    assert not re.search(as_pattern("...: no such thing at ... here"), source)
