"""The examples in the docstrings of every metric run and print what they say."""

import doctest
import importlib
import pkgutil

import pytest

from rewild4d import metrics

NO_EXAMPLES = {"weights", "weight_files"}
"""Modules that only find and check files of weights."""
NAMES = [module.name for module in pkgutil.iter_modules(metrics.__path__) if not module.ispkg]


@pytest.mark.parametrize("name", [name for name in NAMES if name not in NO_EXAMPLES])
def test_examples_print_what_they_say(name: str) -> None:
    found = doctest.testmod(importlib.import_module(f"rewild4d.metrics.{name}"))
    assert found.attempted > 0, f"rewild4d.metrics.{name} has no example"
    assert found.failed == 0
