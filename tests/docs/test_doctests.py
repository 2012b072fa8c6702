"""The examples in docstrings give what they say."""

import doctest
import importlib
from pathlib import Path

import pytest
import torch

import torchfra

ROOT = Path(torchfra.__file__).parent
MODULES = [path for path in sorted(ROOT.rglob("*.py")) if ">>> " in path.read_text(encoding="utf-8")]


@pytest.mark.parametrize("path", MODULES, ids=[str(path.relative_to(ROOT)) for path in MODULES])
def test_examples_give_what_they_say(path):
    module = importlib.import_module(".".join(["torchfra", *path.relative_to(ROOT).with_suffix("").parts]))
    names = vars(module) | {"torch": torch, "torchfra": torchfra}
    tests = [test for test in doctest.DocTestFinder().find(module, globs=names) if test.examples]
    results = [doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(test) for test in tests]
    assert results
    assert not sum(result.failed for result in results)


def test_the_filter_to_reach_for_first_has_an_example():
    assert ">>> " in (torchfra.presets.gpb.__doc__ or "")
