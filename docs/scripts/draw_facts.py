"""Draw facts of the pages at random, to be checked with the code: lines of running text and of tables
that hold a number or a name of code, none of the pages of experiments and the laboratory.

Usage: python docs/scripts/draw_facts.py SEED [COUNT]
"""

from __future__ import annotations

import random
import re
import sys

from pages import DOCS

FACT = re.compile(r"\d|`[a-z_]+`")


def facts() -> list[str]:
    """Return every line of the pages that states something of this kind, with its page."""
    lines = []
    for page in sorted(DOCS.glob("*.md")):
        text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.S | re.M)
        sentences = re.split(r"\n|(?<=[.;])\s+", text)
        lines += [
            f"{page.name}: {sentence.strip()}"
            for sentence in sentences
            if FACT.search(sentence) and not sentence.startswith(("#", "|---", "<!--"))
        ]
    return lines


def main() -> None:
    """Print the drawn facts."""
    seed = sys.argv[1]
    count = int(sys.argv[2]) if len(sys.argv) > 2 else 60
    print("\n".join(random.Random(seed).sample(facts(), count)))


if __name__ == "__main__":
    main()
