"""The site that mkdocs makes of the pages: its home page is the README, dead links fail, and nothing
is loaded from elsewhere.
"""

import re
import shutil
import subprocess
import sys
from types import SimpleNamespace

import pytest

from docs.scripts.site import on_page_markdown
from tests.docs.test_pages import LINK, without_code


def test_the_home_page_is_the_readme_and_its_links_lead_to_pages(repo):
    text = on_page_markdown("", SimpleNamespace(file=SimpleNamespace(src_uri="index.md")))
    assert text.startswith("# simrun")
    links = [link for link in LINK.findall(without_code(text)) if not re.match(r"[a-z]+:", link)]
    assert links
    assert [link for link in links if not (repo / "docs" / link.split("#")[0]).is_file()] == []


@pytest.mark.slow
@pytest.mark.parametrize("link", ["report.md", "no-such-page.md", "report.md#no-such-heading"])
def test_a_dead_link_fails_the_strict_build(repo, tmp_path, link):
    pytest.importorskip("material", reason="needs mkdocs-material")
    for name in ("docs", "README.md", "mkdocs.yml"):
        copy = shutil.copytree if (repo / name).is_dir() else shutil.copy
        copy(repo / name, tmp_path / name)
    with (tmp_path / "docs" / "why.md").open("a") as page:
        page.write(f"\n[a link]({link})\n")
    build = [sys.executable, "-m", "mkdocs", "build", "--strict"]
    done = subprocess.run(build, cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode == 0) == (link == "report.md"), done.stderr
    for path in (tmp_path / "build" / "site").rglob("*.html"):
        assert not re.search(r'src="?https?://', path.read_text())
