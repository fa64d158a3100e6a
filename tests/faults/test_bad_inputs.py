"""No bad argument of a public callable gives a wrong number or an error of torch.

``tests/faults/calls`` is the table of the callables, ``tests/faults/inputs.py`` lists
the bad arguments, and ``python -m tests.faults`` counts how they are taken.
"""

import importlib
import inspect
import pkgutil
from typing import Any

import pytest

import sbi_rope
from sbi_rope import plots
from tests.faults.calls import CALLS, NOT_CALLED
from tests.faults.outcomes import Call, TraceError, no_trace, refuse
from tests.faults.problem import QUIET
from tests.faults.trials import trials

# The calls of one function, or of one class and its methods, are tried in one test.
CALLS_OF: dict[str, list[Call]] = {}
for _call in CALLS:
    CALLS_OF.setdefault(_call.owner, []).append(_call)


# What must be refused is tried with each change of the code. Inputs that may be
# accepted take longer, because the call is then made: a fifth of them is tried, and
# others for each tensor. All take minutes, as the hundreds of pictures alone do.
NAMES = [
    *(pytest.param(name, 1, marks=pytest.mark.slow) for name in CALLS_OF),
    *(pytest.param(name, 5) for name in CALLS_OF if name not in plots.__all__),
]


@pytest.mark.medium
@pytest.mark.parametrize(("name", "every"), NAMES)
def test_bad_arguments_are_refused_and_good_ones_change_nothing_else(
    name: str, every: int
) -> None:
    outcomes = [
        trial()
        for number, trial in enumerate(trials(CALLS_OF[name]))
        if trial.func is refuse or number % every == 0
    ]
    wrong = [str(o) for o in outcomes if o.verdict in ("raw", "silent")]
    for call in CALLS_OF[name]:
        try:
            with no_trace(call):
                found = call()
        except TraceError as error:
            wrong.append(f"{call} with good arguments {error}")
        else:
            if any(tensor.isnan().any() for tensor in found):
                wrong.append(f"{call} with good arguments gives NaN")
    assert not wrong, "\n".join(wrong)


def test_every_public_callable_is_in_the_table() -> None:
    public = public_callables()
    known = {public[call.callable] for call in CALLS if call.callable in public}
    left = {
        name: qualname
        for name, qualname in public.items()
        if qualname not in known and not {name, name.split(".")[0]} & NOT_CALLED.keys()
    }
    assert not left, "Add these to tests/faults/calls: " + ", ".join(sorted(left))


def public_callables() -> dict[str, str]:
    """Return the public functions, classes and methods, and where each is defined.

    Abstract classes are left out, and so are methods that take no argument.
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
