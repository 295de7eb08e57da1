"""The site that mkdocs makes of the pages: its home page is the README."""

import re
from types import SimpleNamespace

from docs.scripts.site import ROOT_PAGES, on_page_markdown
from tests.docs.page_links import LINK, without_code


def test_the_home_page_is_the_readme_and_its_links_lead_to_pages(repo):
    pages = (repo / "docs" / "index.md").read_text()
    text = on_page_markdown(pages, SimpleNamespace(file=SimpleNamespace(src_uri="index.md")))
    assert text.startswith("# simrun")
    links = [link for link in LINK.findall(without_code(text)) if not re.match(r"[a-z]+:", link)]
    assert links
    assert "#pages" in links
    assert text.count("\n## Pages\n") == 1
    links = [link for link in links if link not in ("#pages", *ROOT_PAGES.values())]
    assert [link for link in links if not (repo / "docs" / link.split("#")[0]).is_file()] == []
