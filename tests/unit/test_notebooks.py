"""How results look as the last line of a notebook's cell."""

import inspect
import pkgutil
from importlib import import_module
from typing import Any

import pytest

import sbi_rope
from sbi_rope.sets import Guarantee

# Parts of other results and of errors, and what users never hold.
INSIDE_OTHERS = {
    "Failure",
    "Failures",
    "Finding",
    "Interval",
    "Labels",
    "Summary",
    "_Trial",
}


def classes_with_a_text() -> list[type[Any]]:
    """All classes of the package that say how they are printed."""
    found = []
    for module in pkgutil.walk_packages(sbi_rope.__path__, "sbi_rope."):
        for one in vars(import_module(module.name)).values():
            if inspect.isclass(one) and one.__module__ == module.name:
                found += [one] if "__str__" in vars(one) else []
    return found


def test_results_with_a_text_are_shown_as_it() -> None:
    named = {one.__name__: one for one in classes_with_a_text()}
    assert len(named) > 10
    for name, one in named.items():
        assert hasattr(one, "_repr_pretty_") or name in INSIDE_OTHERS, name


def test_a_notebook_shows_the_text_and_a_list_keeps_the_fields() -> None:
    pretty = pytest.importorskip("IPython.lib.pretty").pretty
    guarantee = Guarantee(level=0.9, num_pairs=50, num_folds=5)
    assert pretty(guarantee) == str(guarantee)
    assert repr(guarantee).startswith("Guarantee(level=0.9")
