"""Run axe-core, the accessibility checker, in the page of a browser. It is not part of this
project: npm install axe-core.
"""

import os
from pathlib import Path

PLACES = ("node_modules/axe-core/axe.min.js", "../node_modules/axe-core/axe.min.js")
MISSING = "no axe-core: npm install axe-core, or name its axe.min.js in SIMRUN_AXE"
SERIOUS = ("serious", "critical")


def find_axe():
    """Return the script, or None."""
    places = [os.environ["SIMRUN_AXE"]] if "SIMRUN_AXE" in os.environ else PLACES
    return next((path for path in map(Path, places) if path.is_file()), None)


def findings(browser, script):
    """Check the page as it stands and return what axe-core objects to: rule, impact, and the
    elements.
    """
    browser.evaluate(script.read_text() + "; 0")
    short = "({ rule: v.id, impact: v.impact, nodes: v.nodes.map(n => n.html.slice(0, 160)) })"
    found = browser.evaluate(f"axe.run(document).then(r => r.violations.map(v => {short}))")
    return found
