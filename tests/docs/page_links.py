"""Links, pictures, files and modules that pages name."""

import ast
import re
from functools import cache

from tests.docs import commands

PACKAGES = ("alpasim_plugin", "evaluators", "policies", "scenarios")
STARTED = (*PACKAGES, "tests", "configs")  # by ``python -m``
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
OF_COMMIT = re.compile(r"`python (docs/scripts/\w+\.py)[^`\n]*`\s+at\s+commit\s+(\w{8})")
MENTION = re.compile(r"\bdocs/[\w./-]+\.(?:md|png|jpg|py)\b")
PROGRAM = re.compile(r"\bpython3? ([\w./-]+\.py)\b")
MODULE = re.compile(r"\bpython3? -m ([\w.]+)")
OF_OTHERS = "e2e_challenge/"  # in a clone of AlpaSim, as the page of its challenge says
AT_COMMIT = re.compile(r"\bat\s+commit\s+([0-9a-f]{8})\b")
HEADING = re.compile(r"^#{1,6} +(.+?) *$", re.M)


def without_code(text):
    """Drop fenced blocks: what stands there is no link and no heading."""
    return re.sub(r"^```.*?^```", "", text, flags=re.S | re.M)


@cache
def anchors(page):
    """Return the anchors of a page's headings, as GitHub makes them."""
    headings = HEADING.findall(without_code(page.read_text(encoding="utf-8")))
    return frozenset(
        re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings
    )


def local_links(page):
    """Return file and anchor of every link of a page that leads to a file."""
    out = []
    for target in LINK.findall(without_code(page.read_text(encoding="utf-8"))):
        if not re.match(r"[a-z]+:", target):
            file, _, anchor = target.partition("#")
            out.append(((page.parent / file).resolve() if file else page.resolve(), anchor))
    return out


def broken_links(repo, pages, to_lab):
    """Return the links that lead nowhere, of those that lead to the laboratory's pages or of the
    others.
    """
    broken = []
    for page in pages:
        for file, anchor in local_links(page):
            if commands.is_of_lab(repo, file) != to_lab:
                continue
            if not file.exists() or (anchor and anchor not in anchors(file)):
                broken.append(
                    f"{page.relative_to(repo)}: {file.name}{'#' if anchor else ''}{anchor}"
                )
    return broken


def reachable(docs):
    """Return the pages that the index leads to."""
    seen = {docs / "index.md"}
    queue = [docs / "index.md"]
    while queue:
        for file, _ in local_links(queue.pop()):
            if (
                file.suffix == ".md"
                and file.is_file()
                and docs in file.parents
                and file not in seen
            ):
                seen.add(file)
                queue.append(file)
    return seen


def unshown(folder, pages):
    """Return the pictures of a folder that no page shows."""
    shown = {file for page in pages for file, _ in local_links(page)}
    return [
        path.name
        for path in folder.rglob("*")
        if path.suffix in (".png", ".jpg") and path.resolve() not in shown
    ]


def files_not_there(repo, pages):
    """Return the source files that pages name and that do not exist."""
    roots = (
        repo,
        repo / "alpasim_plugin",
        repo / "alpasim_plugin" / "gaussians",
        repo / "alpasim_plugin" / "lab",
        repo / "docs",
    )
    named = re.compile(r"\b([a-z][\w]*(?:/\w+)+\.(?:py|proto))\b")
    missing = []
    for page in pages:
        text = OF_COMMIT.sub("", without_code(page.read_text(encoding="utf-8")))
        code = re.findall(r"`([^`\n]+)`", text)
        files = {file for text in code for file in named.findall(text)}
        missing += [
            f"{page.relative_to(repo)}: {file}"
            for file in sorted(files)
            if not any((root / file).is_file() for root in roots)
        ]
    return missing


def programs_of(text):
    """Return the files of ours that the commands of a text start, as paths below the repository:
    ``python FILE`` and ``python -m MODULE``; a package stands for its ``__main__``.
    """
    paths = [
        path for path in PROGRAM.findall(text) if "/" in path and not path.startswith(OF_OTHERS)
    ]
    modules = [name for name in MODULE.findall(text) if name.split(".")[0] in STARTED]
    return paths + [f"{name.replace('.', '/')}.py" for name in modules]


def programs_by_commit(page):
    """Yield the programs that a page's commands start, each with the commits that its paragraph
    names: "at commit" and eight letters.
    """
    for paragraph in re.split(r"\n\s*\n", page.read_text(encoding="utf-8")):
        commits = AT_COMMIT.findall(paragraph)
        for path in programs_of(paragraph):
            yield path, commits


def programs_not_there(repo, pages):
    """Return the programs that pages start, that do not exist, and whose paragraph names no commit."""
    return [
        f"{page.name}: {path}"
        for page in pages
        for path, commits in programs_by_commit(page)
        if not commits and not is_program(repo, path)
    ]


def is_program(repo, path):
    """Tell whether a file exists, or the ``__main__`` of the package of that name."""
    file = repo / path
    return file.is_file() or (file.with_suffix("") / "__main__.py").is_file()


def imports_of_nothing(repo, pages):
    """Return the names that examples in Python import and that do not exist; an example that does
    not parse raises.
    """
    missing = []
    for page in pages:
        for block in re.findall(
            r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.S | re.M
        ):
            for node in ast.walk(ast.parse(block)):
                if (
                    isinstance(node, ast.ImportFrom)
                    and node.module
                    and node.module.split(".")[0] in PACKAGES
                ):
                    base = repo.joinpath(*node.module.split("."))
                    file = base / "__init__.py" if base.is_dir() else base.with_suffix(".py")
                    text = file.read_text(encoding="utf-8") if file.is_file() else ""
                    missing += [
                        f"{page.name}: {node.module}.{a.name}"
                        for a in node.names
                        if not re.search(rf"\b{a.name}\b", text)
                    ]
    return missing
