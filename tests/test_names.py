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
# Module -> names of the contract that are pronouns: options of the command line, keys of files that
# are written, and settings of a training's configuration.
CONTRACT = {
    "alpasim_plugin.cli.fork": {"at", "own"},
    "alpasim_plugin.log.run_folder.records": {"what", "of", "asked"},
    "alpasim_plugin.lab.training.distillation": {"every"},
    "alpasim_plugin.lab.training.model_card": {"what"},
    "alpasim_plugin.lab.training.photograph_pairs": {"every"},
}


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
    allowed = CONTRACT.get(module.name, set())
    return [
        f"{module.name}:{line} {name}"
        for name, line in bindings(module)
        if name in PRONOUNS - allowed
    ]


def test_names_are_no_pronouns_or_participles():
    assert [line for module in modules() for line in pronouns(module)] == []


def test_every_name_that_is_excepted_is_bound():
    bound = {module.name: {name for name, _ in bindings(module)} for module in modules()}
    # the laboratory is a distribution of its own
    missing = {name: names - bound[name] for name, names in CONTRACT.items() if name in bound}
    assert {name: names for name, names in missing.items() if names} == {}
