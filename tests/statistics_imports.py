"""What a module imports of statistics: results are made once, and whoever prints them only reads."""

import ast

# What reads and words results: what opens a run, what holds a result, what names variants, and what
# formats numbers and sentences. It makes nothing.
READERS = {
    "evaluators.statistics.numbers": {"*"},
    "evaluators.statistics.sentences": {"*"},
    "evaluators.statistics.boundary_words": {"*"},
    "evaluators.statistics.opening": {"Run", "read_run"},
    "evaluators.statistics.cause": {"Cause", "Parting"},
    "evaluators.statistics.decision": {
        "CAUSES",
        "Decision",
        "State",
        "read_decision",
        "stopping_note",
    },
    "evaluators.statistics.gate": {"GateVerdict"},
    "evaluators.statistics.paired": {"BLOCKS"},
    "evaluators.statistics.variants": {"Base", "Variant", "axis_bases"},
}
# Names of statistics that `evaluators` gives too.
OF_THE_FACE = {"aggregate", "censoring", "paired", "reduce_rollout", "rollout_values"}


def computing_imports(nodes):
    """Return the names that a module imports of statistics beside `READERS`, in the order of its
    lines.

    Args:
        nodes: The module's syntax nodes.
    """
    refused = []
    for node in nodes:
        if isinstance(node, ast.Import):
            refused += [alias.name for alias in node.names if "statistics" in alias.name]
        elif isinstance(node, ast.ImportFrom) and "evaluators.statistics" in (node.module or ""):
            allowed = READERS.get(str(node.module), set())
            names = [alias.name for alias in node.names]
            refused += [name for name in names if "*" not in allowed and name not in allowed]
        elif isinstance(node, ast.ImportFrom) and node.module == "evaluators":
            refused += [alias.name for alias in node.names if alias.name in OF_THE_FACE]
    return refused
