"""The examples in docstrings run and print the output that they show."""

import doctest
from importlib import import_module
from pathlib import Path

import pytest

import stereogenbench_data

PACKAGE = Path(stereogenbench_data.__file__).parent
MODULES = [
    ".".join(("stereogenbench_data", *path.relative_to(PACKAGE).with_suffix("").parts))
    for path in sorted(PACKAGE.rglob("*.py"))
    if ">>> " in path.read_text()
]


@pytest.mark.parametrize("name", MODULES)
def test_the_examples_of_a_module_run(request, name):
    fixtures = {"getfixture": request.getfixturevalue}

    found = doctest.testmod(import_module(name), extraglobs=fixtures)

    assert found.attempted > 0
    assert found.failed == 0
