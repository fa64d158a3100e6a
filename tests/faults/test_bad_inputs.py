"""No bad argument of any public callable gives a wrong number or a raw error.

``python -m tests.faults`` counts the outcomes; ``tests/faults/calls.py`` is the table.
"""

import importlib
import inspect
import pkgutil
from typing import Any

import pytest

import sbi_rope
from tests.faults.calls import CALLS, NOT_CALLED
from tests.faults.outcomes import Call, no_trace
from tests.faults.problem import QUIET
from tests.faults.trials import trials


@pytest.mark.parametrize("call", CALLS, ids=str)
def test_bad_arguments_are_refused_by_name_and_odd_ones_give_the_same(
    call: Call,
) -> None:
    outcomes = [trial() for trial in trials([call])]
    wrong = [str(o) for o in outcomes if o.verdict in ("raw", "silent")]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("call", CALLS, ids=str)
def test_good_arguments_leave_no_trace(call: Call) -> None:
    call()
    with no_trace(call):
        assert all(not tensor.isnan().any() for tensor in call())


def test_every_public_callable_is_in_the_table() -> None:
    public = public_callables()
    known = {public[name] for name in map(_bare, CALLS) if name in public}
    left = {
        name: qualname
        for name, qualname in public.items()
        if qualname not in known and not {name, name.split(".")[0]} & NOT_CALLED.keys()
    }
    assert not left, "Add these to tests/faults/calls.py: " + ", ".join(sorted(left))


def _bare(call: Call) -> str:
    return call.name.split("(")[0]


def public_callables() -> dict[str, str]:
    """Return the public functions, classes and methods, and where each is defined.

    Without abstract classes, and without methods that take no argument.
    """
    found = {}
    for module in pkgutil.iter_modules(sbi_rope.__path__, "sbi_rope."):
        if module.name.split(".")[1].startswith("_"):
            continue
        package = importlib.import_module(module.name)
        for name in getattr(package, "__all__", []):
            value = getattr(package, name)
            if inspect.isfunction(value) and _takes_arguments(value):
                found[name] = value.__qualname__
            if not inspect.isclass(value) or issubclass(value, Exception):
                continue
            if inspect.isabstract(value) or getattr(value, "_is_protocol", False):
                continue
            found[name] = name
            for method in dir(value):
                function = getattr(value, method)
                if method.startswith("_") or not inspect.isfunction(function):
                    continue
                ours = function.__module__.startswith("sbi_rope")
                if ours and _takes_arguments(function):
                    found[f"{name}.{method}"] = function.__qualname__
    return found


def _takes_arguments(function: Any) -> bool:
    return bool(set(inspect.signature(function).parameters) - {"self", *QUIET})
