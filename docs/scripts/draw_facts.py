"""Draw facts of the pages at random, to be checked with the code: sentences of running text and lines
of tables that hold a number or a name of code. Blocks that a script writes are left out, since they
are the code's already, and so are commands and the pages of experiments and the laboratory.

Usage: python docs/scripts/draw_facts.py SEED [COUNT]
"""

from __future__ import annotations

import random
import re
import sys

from pages import DOCS

FACT = re.compile(r"\d|`[a-z_]+`")
COMMANDS = re.compile(r"^```.*?^```", re.S | re.M)
WRITTEN_BY_SCRIPTS = re.compile(r"<!-- begin .*?<!-- end [^\n]*-->", re.S)
FEWEST_WORDS = 5  # fewer are the number of an item, or the end of a sentence
TREE_PAGES = ("README.md", "SECURITY.md", "CONTRIBUTING.md", "CHANGELOG.md")


def facts() -> list[str]:
    """Return every line of the pages that states something of this kind, with its page."""
    lines = []
    pages = sorted(DOCS.glob("*.md")) + [DOCS.parent / name for name in TREE_PAGES]
    for page in pages:
        text = WRITTEN_BY_SCRIPTS.sub("", page.read_text(encoding="utf-8"))
        text = COMMANDS.sub("", text)
        sentences = re.split(r"\n|(?<=[.;])\s+", text)
        lines += [
            f"{page.name}: {sentence.strip()}"
            for sentence in sentences
            if FACT.search(sentence)
            and len(sentence.split()) >= FEWEST_WORDS
            and not sentence.startswith(("#", "|---", "<!--"))
        ]
    return lines


def main() -> None:
    """Print the drawn facts."""
    seed = sys.argv[1]
    count = int(sys.argv[2]) if len(sys.argv) > 2 else 60
    print("\n".join(random.Random(seed).sample(facts(), count)))


if __name__ == "__main__":
    main()
