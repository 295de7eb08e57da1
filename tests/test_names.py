"""Names say what a value is: nouns of the field, as docs/glossary.md has them."""

import ast

from tests.source_modules import modules

PRONOUNS = frozenset(
    [
        "one",
        "found",
        "shown",
        "known",
        "asked",
        "given",
        "own",
        "said",
        "seen",
        "drawn",
        "there",
        "here",
        "at",
        "of",
        "what",
        "where",
        "both",
        "mine",
        "rest",
        "some",
        "every",
        "aside",
    ]
)
# Share of all bindings that may still be pronouns: options of the contract (`--at`), and places that
# nobody has read again yet.
MOST = 0.005
# Rooms without any.
CLEAN = (
    "alpasim_plugin.alpasim",
    "alpasim_plugin.block_fixers",
    "alpasim_plugin.cameras",
    "alpasim_plugin.control",
    "alpasim_plugin.core",
    "alpasim_plugin.drives",
    "alpasim_plugin.gym",
    "alpasim_plugin.renderers",
    "alpasim_plugin.runs",
    "alpasim_plugin.streets",
    "alpasim_plugin.world",
    "policies",
    "scenarios",
)


def of_short_comprehensions(tree_nodes):
    """Return the ids of the targets of comprehensions that fit one line."""
    kinds = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
    targets = (
        generator.target
        for node in tree_nodes
        if isinstance(node, kinds) and node.lineno == node.end_lineno
        for generator in node.generators
    )
    return {id(name) for target in targets for name in ast.walk(target)}


def bindings(module):
    """Yield each name that a module binds, with its line."""
    excepted = of_short_comprehensions(module.nodes)
    for node in module.nodes:
        if id(node) in excepted:
            continue
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id, node.lineno
        elif isinstance(node, ast.arg):
            yield node.arg, node.lineno


def pronouns(module):
    return [f"{module.name}:{line} {name}" for name, line in bindings(module) if name in PRONOUNS]


def test_few_names_are_pronouns_or_participles():
    count = sum(len(list(bindings(module))) for module in modules())
    wrong = [line for module in modules() for line in pronouns(module)]
    assert len(wrong) <= MOST * count, f"{len(wrong)} of {count}, {wrong[:20]}"


def test_rooms_that_are_free_of_pronouns_stay_so():
    rooms = [module for module in modules() if module.name.startswith(CLEAN)]
    assert [line for module in rooms for line in pronouns(module)] == []
