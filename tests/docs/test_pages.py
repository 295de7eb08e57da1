"""The pages of docs/: links resolve, pages are short, and every page is reachable from the index."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

MAX_LINES = 200
PACKAGES = ("alpasim_plugin", "evaluators", "policies", "scenarios")
RECORDS = "experiments"  # records of experiments may be longer
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
MENTION = re.compile(r"\bdocs/[\w./-]+\.(?:md|png|jpg|py)\b")
HEADING = re.compile(r"^#{1,6} +(.+?) *$", re.M)


def without_code(text: str) -> str:
    """Drop fenced blocks: what stands there is no link and no heading."""
    return re.sub(r"^```.*?^```", "", text, flags=re.S | re.M)


@cache
def anchors(page: Path) -> frozenset[str]:
    """Return the anchors of a page's headings, as GitHub makes them."""
    headings = HEADING.findall(without_code(page.read_text(encoding="utf-8")))
    return frozenset(re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings)


def local_links(page: Path) -> list[tuple[Path, str]]:
    """Return file and anchor of every link of a page that leads to a file."""
    out = []
    for target in LINK.findall(without_code(page.read_text(encoding="utf-8"))):
        if not re.match(r"[a-z]+:", target):
            file, _, anchor = target.partition("#")
            out.append(((page.parent / file).resolve() if file else page.resolve(), anchor))
    return out


@pytest.fixture
def pages(repo: Path) -> list[Path]:
    """Return README, CHANGELOG and every page of docs/."""
    return [repo / "README.md", repo / "CHANGELOG.md", *sorted((repo / "docs").rglob("*.md"))]


def test_links_resolve(repo: Path, pages: list[Path]) -> None:
    broken = []
    for page in pages:
        for file, anchor in local_links(page):
            if not file.exists() or (anchor and anchor not in anchors(file)):
                broken.append(f"{page.relative_to(repo)}: {file.name}{'#' if anchor else ''}{anchor}")
    assert broken == []


def test_pages_of_the_docs_that_code_and_pages_name_exist(repo: Path, pages: list[Path]) -> None:
    folders = ("alpasim_plugin", "evaluators", "policies", "scenarios", "configs", "tests", "docs")
    code = [path for folder in folders for suffix in ("py", "yaml") for path in (repo / folder).rglob(f"*.{suffix}")]
    missing = []
    for file in [*code, *pages]:
        mentions = MENTION.findall(file.read_text(encoding="utf-8"))
        missing += [f"{file.relative_to(repo)}: {mention}" for mention in mentions if not (repo / mention).is_file()]
    assert missing == []


def test_pages_are_short(repo: Path, pages: list[Path]) -> None:
    lengths = {str(page.relative_to(repo)): len(page.read_text(encoding="utf-8").splitlines()) for page in pages}
    too_long = {page: length for page, length in lengths.items() if length > MAX_LINES and not page.startswith(f"docs/{RECORDS}/")}
    assert too_long == {}


def test_every_page_is_reachable_from_the_index(repo: Path) -> None:
    docs = repo / "docs"
    seen, queue = {docs / "index.md"}, [docs / "index.md"]
    while queue:
        for file, _ in local_links(queue.pop()):
            if file.suffix == ".md" and docs in file.parents and file not in seen:
                seen.add(file)
                queue.append(file)
    assert {str(page.relative_to(docs)) for page in docs.rglob("*.md")} == {str(page.relative_to(docs)) for page in seen}


def test_every_picture_is_shown(repo: Path, pages: list[Path]) -> None:
    shown = {file for page in pages for file, _ in local_links(page)}
    pictures = [path for path in (repo / "docs").rglob("*") if path.suffix in (".png", ".jpg")]
    assert [path.name for path in pictures if path.resolve() not in shown] == []


def test_files_that_pages_name_exist(repo: Path, pages: list[Path]) -> None:
    roots = (repo, repo / "alpasim_plugin", repo / "alpasim_plugin" / "gaussians", repo / "docs")
    named = re.compile(r"\b([a-z][\w]*(?:/\w+)+\.(?:py|proto))\b")
    missing = []
    for page in pages:
        code = re.findall(r"`([^`\n]+)`", without_code(page.read_text(encoding="utf-8")))
        files = {file for text in code for file in named.findall(text)}
        missing += [f"{page.relative_to(repo)}: {file}" for file in sorted(files) if not any((root / file).is_file() for root in roots)]
    assert missing == []


def test_python_examples_parse_and_import_what_exists(repo: Path, pages: list[Path]) -> None:
    missing = []
    for page in pages:
        for block in re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.S | re.M):
            for node in ast.walk(ast.parse(block)):
                if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in PACKAGES:
                    base = repo.joinpath(*node.module.split("."))
                    file = base / "__init__.py" if base.is_dir() else base.with_suffix(".py")
                    text = file.read_text(encoding="utf-8") if file.is_file() else ""
                    missing += [f"{page.name}: {node.module}.{a.name}" for a in node.names if not re.search(rf"\b{a.name}\b", text)]
    assert missing == []
