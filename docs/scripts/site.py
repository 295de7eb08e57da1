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


# Pages that lie in the root of the repository -> their place on the site.
ROOT_PAGES = {"CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md"}


def on_files(files: Any, config: Any, **_: Any) -> Any:
    """Add the pages of the repository's root to those of the site."""
    from mkdocs.structure.files import File

    for name, page in ROOT_PAGES.items():
        content = (REPO / name).read_text(encoding="utf-8").replace("](docs/", "](")
        files.append(
            File.generated(config, page, content=content.replace("](LICENSE)", "](#licence)"))
        )
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Return the text of a page: of the home page that of the README, its links from ``docs/``,
    followed by the list of all pages.
    """
    for name, root_page in ROOT_PAGES.items():
        markdown = markdown.replace(f"](../{name}", f"]({root_page}")
    if page.file.src_uri != "index.md":
        return markdown.replace("](../README.md", "](index.md")
    readme = (REPO / "README.md").read_text(encoding="utf-8")
    home = readme.replace("](docs/index.md", "](#pages").replace("](docs/", "](")
    home = home.replace("](CONTRIBUTING.md", "](contributing.md").replace(
        "](CHANGELOG.md", "](changelog.md"
    )
    pages = markdown.replace("# Pages\n", "## Pages\n", 1).replace("](../README.md", "](index.md")
    return f"{home}\n{pages}"


def on_post_page(output: str, **_: Any) -> str:
    """Return a page in which the script that the theme fetches for search from disk is our own."""
    return ELSEWHERE.sub(lambda _: FRAME, output)


on_post_template = on_post_page
