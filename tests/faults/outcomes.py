"""Call a function with a bad argument and judge what it does."""

import random
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from sbi_rope.errors import RoPEError

Verdict = Literal["right", "clear", "raw", "silent"]


@dataclass(frozen=True, kw_only=True)
class Call:
    """A public callable with good arguments.

    Attributes:
        name: The function or method as users write it. A variant follows in
            parentheses.
        run: A function that makes the call with the arguments by name. What it returns
            is compared.
        tensors: The good tensors by name.
        options: The kind of each option, which is a key of ``BAD_OPTIONS``.
        pair_weights: Names of the tensors that are weights of pairs.
        accepts: The bad inputs that mean something here, as "argument: input".
        is_random: Whether the call draws from the global random numbers, as users
            expect of a sampler without a seed.
    """

    name: str
    run: Callable[..., Any]
    tensors: dict[str, Tensor] = field(default_factory=dict)
    options: dict[str, str] = field(default_factory=dict)
    pair_weights: tuple[str, ...] = ()
    accepts: tuple[str, ...] = ()
    is_random: bool = False

    @property
    def callable(self) -> str:
        """The function or method, without the variant."""
        return self.name.split("(")[0]

    @property
    def owner(self) -> str:
        """The function, or the class of the method."""
        return self.callable.split(".")[0]

    def __str__(self) -> str:
        return self.name

    def __call__(self, **changed: Any) -> list[Tensor]:
        """Return the tensors of a call with some arguments changed."""
        torch.default_generator.manual_seed(0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return list(tensors_of(self.run(**(self.tensors | changed))))


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What a call did with an argument.

    The verdict is "right" if the result is, "clear" if a named error was raised, "raw"
    if any other error was raised, and "silent" if the call accepted the argument
    although it should not, or left a trace.
    """

    call: str
    argument: str
    value: str
    verdict: Verdict
    detail: str

    def __str__(self) -> str:
        return (
            f"{self.call}({self.argument}: {self.value}) {self.verdict}: {self.detail}"
        )


def refuse(call: Call, argument: str, label: str, value: Any) -> Outcome:
    """Call with an argument that must be refused with a named error."""
    accepted = f"{argument}: {label}" in call.accepts
    return _judge(call, argument, label, value, expected="numbers" if accepted else "")


def survive(call: Call, argument: str, label: str, value: Any) -> Outcome:
    """Call with an argument that must be refused, or else must not give NaN."""
    accepted = f"{argument}: {label}" in call.accepts
    expected = "anything" if accepted else "numbers"
    return _judge(call, argument, label, value, expected=expected)


def agree(call: Call, argument: str, label: str, value: Any) -> Outcome:
    """Call with an argument that must be refused or treated as a plain tensor."""
    accepted = f"{argument}: {label}" in call.accepts
    expected = "numbers" if accepted else "the same"
    return _judge(call, argument, label, value, expected=expected)


def _judge(
    call: Call, argument: str, label: str, value: Any, *, expected: str
) -> Outcome:
    def outcome(verdict: Verdict, detail: str) -> Outcome:
        return Outcome(
            call=call.name,
            argument=argument,
            value=label,
            verdict=verdict,
            detail=detail,
        )

    try:
        with no_trace(call, value):
            found = call(**{argument: value})
    except RoPEError as error:
        return outcome("clear", str(error))
    except TraceError as error:
        return outcome("silent", str(error))
    except Exception as error:
        return outcome("raw", f"{type(error).__name__}: {error}")
    if not expected:
        return outcome("silent", "was accepted")
    numbers = [tensor for tensor in found if tensor.is_floating_point()]
    if expected != "anything" and any(tensor.isnan().any() for tensor in numbers):
        return outcome("silent", "NaN")
    if expected == "the same" and found:  # otherwise there is nothing to compare
        plain = torch.as_tensor(value).detach().float()
        if not call.tensors[argument].is_floating_point():
            plain = plain.long()
        same = _result_with(call, argument, plain.clone().contiguous())
        if len(same) != len(found) or not all(map(_is_close, same, found)):
            return outcome("silent", "differs from a plain tensor of float32")
    return outcome("right", expected)


# Most odd forms of a tensor are the same plain tensor.
_RESULTS: dict[tuple[str, str, bytes, torch.Size], list[Tensor]] = {}


def _result_with(call: Call, argument: str, plain: Tensor) -> list[Tensor]:
    key = call.name, argument, plain.numpy().tobytes(), plain.shape
    if key not in _RESULTS:
        _RESULTS[key] = call(**{argument: plain})
    return _RESULTS[key]


def _is_close(a: Tensor, b: Tensor) -> bool:
    if a.shape != b.shape:
        return False
    return torch.allclose(a.double(), b.double(), rtol=1e-3, atol=1e-4)


class TraceError(Exception):
    """A call has changed something that it should not change."""


@contextmanager
def no_trace(call: Call, value: Any = None) -> Iterator[None]:
    """Raise if a call changes its arguments, or any state of the process."""
    arguments = {name: tensor.clone() for name, tensor in call.tensors.items()}
    copied = value.clone() if _is_plain(value) else None
    torch.default_generator.manual_seed(0)
    before = state_of_process(random_numbers=not call.is_random)
    try:
        yield
    finally:
        after = state_of_process(random_numbers=not call.is_random)
        changed = [name for name in before if before[name] != after[name]]
        changed += [
            name
            for name, tensor in arguments.items()
            if not torch.equal(tensor, call.tensors[name])
        ]
        if copied is not None and not copied.equal(value):
            changed.append("its argument")
        if changed:
            raise TraceError(f"changed {', '.join(changed)}")


def _is_plain(value: Any) -> bool:
    return (
        isinstance(value, Tensor)
        and not value.is_meta
        and not value.is_sparse
        and not bool(value.isnan().any())
    )


def state_of_process(*, random_numbers: bool) -> dict[str, Any]:
    """Return the state of the process that a library must not change."""
    state: dict[str, Any] = {
        "the default dtype": torch.get_default_dtype(),
        "gradient mode": torch.is_grad_enabled(),
        "the number of threads": torch.get_num_threads(),
        "deterministic mode": torch.are_deterministic_algorithms_enabled(),
        "NumPy's error state": tuple(np.geterr().items()),
        "filters of warnings": tuple(warnings.filters),
        "print options": dict(vars(torch._tensor_str.PRINT_OPTS)),
    }
    if random_numbers:
        state["torch's random numbers"] = torch.get_rng_state().numpy().tobytes()
        _, numbers, *rest = np.random.get_state()  # noqa: NPY002
        state["NumPy's random numbers"] = (np.asarray(numbers).tobytes(), *rest)
        state["Python's random numbers"] = random.getstate()
    return state


def tensors_of(result: Any) -> Iterator[Tensor]:
    """Find the tensors and numbers in what a call returns."""
    if isinstance(result, Tensor):
        yield result.detach().cpu()
    elif isinstance(result, bool | str) or result is None:
        return
    elif isinstance(result, int | float | np.number):
        yield torch.tensor(float(result), dtype=torch.double)
    elif isinstance(result, dict):
        yield from tensors_of(list(result.values()))
    elif isinstance(result, list | tuple):
        for part in result:
            yield from tensors_of(part)
    elif is_dataclass(result):
        for part in fields(result):
            yield from tensors_of(getattr(result, part.name))
