"""The examples in the docstrings of `evaluators.statistics` say what the functions give."""

import doctest
import importlib
import pkgutil

import evaluators.statistics


def test_every_example_gives_what_it_says():
    failed = {}
    tried = 0
    for module in pkgutil.iter_modules(evaluators.statistics.__path__):
        found = doctest.testmod(importlib.import_module(f"evaluators.statistics.{module.name}"))
        tried += found.attempted
        if found.failed:
            failed[module.name] = found.failed
    assert failed == {}
    assert tried > 40
