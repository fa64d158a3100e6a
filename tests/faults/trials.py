"""Pair every public callable with all bad inputs for its arguments."""

import functools
from collections.abc import Iterator

from tests.faults.calls import CALLS
from tests.faults.inputs import (
    BAD_OPTIONS,
    BAD_TENSORS,
    BAD_WEIGHTS,
    EXTREME_TENSORS,
    FINE_ROWS,
    ODD_ROWS,
    ODD_TENSORS,
)
from tests.faults.outcomes import Call, Outcome, agree, refuse, survive

Trial = functools.partial[Outcome]


def trials(calls: list[Call] = CALLS) -> Iterator[Trial]:
    """Yield all trials of some calls."""
    for call in calls:
        call()  # makes whatever it shares with other calls, outside of the trials
        for name in call.tensors:
            yield from tensor_trials(call, name)
        for name in call.options:
            yield from option_trials(call, name)


def tensor_trials(call: Call, name: str) -> Iterator[Trial]:
    """Yield the trials of a tensor."""
    good = call.tensors[name]
    odd = ODD_TENSORS if good.is_floating_point() else ODD_ROWS
    bad = BAD_TENSORS | BAD_WEIGHTS if name in call.pair_weights else BAD_TENSORS
    for judge, kinds in (
        (refuse, bad),
        (survive, EXTREME_TENSORS),
        (agree, odd),
    ):
        for label, spoil in kinds.items():
            if good.ndim == 1 and label in FINE_ROWS:
                continue
            yield functools.partial(judge, call, name, label, spoil(good))


def option_trials(call: Call, name: str) -> Iterator[Trial]:
    """Yield the trials of an option."""
    for value in BAD_OPTIONS[call.options[name]]:
        yield functools.partial(refuse, call, name, repr(value), value)
