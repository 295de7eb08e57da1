"""Hooks of the site that mkdocs makes of these pages: its home page is the README, and it loads
nothing from elsewhere, so that it opens and searches from disk.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

REPO = Path(__file__).resolve().parents[2]
ELSEWHERE = re.compile(r'<script src="?https://unpkg\.com/iframe-worker/shim"?></script>')
# A browser starts no worker for a page from disk: the search runs in a hidden frame instead.
FRAME = """<script>
if (location.protocol === "file:") window.Worker = class extends EventTarget {
  constructor(url) {
    super();
    const frame = Object.assign(document.createElement("iframe"), { hidden: true, srcdoc: "<body>" });
    this.ready = new Promise((resolve) => frame.addEventListener("load", () => {
      const inner = frame.contentWindow;
      inner.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
      const script = inner.document.createElement("script");
      script.addEventListener("load", () => resolve(inner));
      script.src = new URL(url, location.href).href;
      inner.document.body.append(script);
    }, { once: true }));
    (document.body ?? document.documentElement).append(frame);
  }
  async postMessage(data) {
    const inner = await this.ready;
    inner.dispatchEvent(new inner.MessageEvent("message", { data }));
  }
};
</script>"""


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Return the text of a page: of the home page that of the README, its links from ``docs/``,
    followed by the list of all pages.
    """
    if page.file.src_uri != "index.md":
        return markdown.replace("](../README.md", "](index.md")
    readme = (REPO / "README.md").read_text(encoding="utf-8")
    home = readme.replace("](docs/index.md", "](#pages").replace("](docs/", "](")
    pages = markdown.replace("# Pages\n", "## Pages\n", 1).replace("](../README.md", "](index.md")
    return f"{home}\n{pages}"


def on_post_page(output: str, **_: Any) -> str:
    """Return a page in which the script that the theme fetches for search from disk is our own."""
    return ELSEWHERE.sub(lambda _: FRAME, output)


on_post_template = on_post_page
