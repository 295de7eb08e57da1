"""Whether the command line understands the commands of the pages, and which need a checkout."""

import re

from alpasim_plugin.cli.main import load_verb, with_verb
from tests.docs.commands import NO_COMMAND, OTHER, SIMRUN, lines_of


def parse(words):
    """Parse a command line as `simrun` does, without running it."""
    args = with_verb(words)
    command = load_verb(args[0])
    name, *rest = args
    while hasattr(command, "commands"):
        name, *rest = rest
        command = command.commands[name]
    command.make_context(name, rest)


def not_understood(some):
    """Return a line for every command that the command line refuses to parse."""
    refused = []
    for one in some:
        if any(re.search(pattern, " ".join(one.words)) for pattern in NO_COMMAND):
            continue
        try:
            parse(list(one.words))
        except Exception as error:  # click's own errors have a class per cause
            refused.append(f"{one}: {error}")
    return refused


def needing_the_checkout(some):
    """Return a line for every command of some pages that works in a checkout only."""
    needs = []
    for page in some:
        if page.parent.name == "experiments":
            continue
        for line in lines_of(page):
            is_setup = (page.name == "README.md" and "pip install -q -e" in line) or (
                "suites/first" in line and ".venv/bin" in line
            )
            is_command = SIMRUN.match(line) or OTHER.match(line)
            is_bound = re.search(
                r"\.venv/bin/simrun|configs/|pip install[^|&;]* alpasim-onefixer", line
            )
            if is_command and is_bound and not is_setup:
                needs.append(f"{page.name}: {line}")
    return needs
