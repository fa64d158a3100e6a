"""Try a simulator on a few parameters, to find out how it is called."""

import random
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NoReturn

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_rope._random import seeded
from sbi_rope._simulator.calls import Caller, Form, describe
from sbi_rope._simulator.rows import rows_depend_on_each_other
from sbi_rope._simulator.workers import copy_in_worker
from sbi_rope._validation import column_names
from sbi_rope.errors import SimulationError, shown, warn_user

__all__ = ["Probe"]

# Tensors come first, and batches before single parameters.
FORMS = [
    Form(batched=batched, arrays=arrays)
    for arrays in (False, True)
    for batched in (True, False)
]
# A simulator may fail at some parameters. It is tried at so many.
TRIES = 5

SAME_NOISE = "`simulator` adds the same noise to all simulations of a batch"
MIXED_ROWS = (
    "`simulator` returns something else for a row of a batch than for the same theta "
    "alone: its rows depend on each other"
)
OWN_NOISE = (
    "`simulator` has noise that does not follow the seeds of torch, NumPy and Python"
)
REPAIR = (
    "Make its generator inside of it, for instance with `rng = "
    "np.random.default_rng(np.random.randint(2**31))`."
)

_State = tuple[bytes, tuple[Any, ...], Any]


@dataclass(frozen=True, eq=False, kw_only=True)
class _Trial:
    """A call of the simulator in one form.

    Attributes:
        caller: The simulator in this form.
        theta: What it was called with.
        x: The simulations, or None if what it returned does not fit.
        result: What it returned or raised.
        state: The states of the random numbers after the call.
    """

    caller: Caller
    theta: Tensor
    x: Tensor | None
    result: Any
    state: _State

    def __str__(self) -> str:
        kind = "an array" if self.caller.form.arrays else "a tensor"
        return f"for {kind} {tuple(self.theta.shape)}: {describe(self.result)}"


class Probe:
    """Finds out how a simulator is called, and warns of what its noise does.

    Args:
        function: The simulator.
        prior: The prior, from which the parameters are drawn.
        event_shape: Shape of one simulation.
        like: A tensor with the dtype and device of parameters and simulations.

    Attributes:
        num_calls: How many rows were simulated so far.
        x_columns: The names of the columns of the tables that it returns, if any.
    """

    def __init__(
        self,
        function: Callable[[Any], Any],
        prior: Distribution,
        *,
        event_shape: torch.Size,
        like: Tensor,
    ) -> None:
        self.num_calls = 0
        self.x_columns: tuple[str, ...] = ()
        self._caller = Caller(
            function=function, form=FORMS[0], event_shape=event_shape, like=like
        )
        sizes = {*prior.event_shape, *event_shape}
        # A number of rows that is no number of parameters or of readings.
        self._count = next(n for n in range(3, 3 + len(sizes) + 1) if n not in sizes)
        self._draws = prior.sample(torch.Size((2 * self._count - 1,))).to(like)

    def find_caller(self, num_workers: int | None) -> Caller:
        """Return the simulator in the form in which it returns simulations.

        Args:
            num_workers: The number of workers that will call it; None if they have no
                part in it.

        Raises:
            SimulationError: If it returns simulations in no form, or mixes up rows, or
                does not work in worker processes.
        """
        trial = self._working_trial()
        caller = self._caller = trial.caller
        self.x_columns = column_names(trial.result)
        if num_workers is not None:
            self._check_workers(trial.theta, num_workers)
        else:
            self._check_own_noise(trial)
        if not caller.form.batched:
            self._check_seeds(trial)
            return caller
        return self._caller_of_batches(trial)

    def _caller_of_batches(self, trial: _Trial) -> Caller:
        """Return the simulator with batches, or without if it mixes up their rows."""
        caller = trial.caller
        if self._shares_noise(trial):
            if caller.form.arrays and self._attempt(self._draws[0]) is not None:
                return self._alone(caller, SAME_NOISE)
            warn_user(
                f"{SAME_NOISE}. Draw noise of the shape of the batch, or simulate row "
                "by row with `lambda theta: torch.stack([simulator(row) for row in "
                "theta])`."
            )
        trial = self._try(caller.form, self._draws[: self._count])
        self._check_seeds(trial)
        if not rows_depend_on_each_other(
            self._attempt,
            lambda theta: self._try(caller.form, theta).x,
            trial.x,
            trial.theta,
            self._draws[self._count - 1 :],
        ):
            return caller
        if self._attempt(self._draws[0]) is None:
            raise SimulationError(
                "Expected `simulator` to return x (n, *event) in which each row "
                "depends on the same row of theta (n, d) only; what it returns for "
                "a row changes with the other rows."
            )
        return self._alone(caller, MIXED_ROWS)

    def _working_trial(self) -> _Trial:
        """Return a trial in the form in which the simulator returns simulations.

        A simulator that makes something else than a tensor from tensors is given arrays
        if it takes them, because it was written for these.
        """
        trials: list[_Trial] = []
        for _ in range(TRIES):
            tried = []
            for form in FORMS:
                theta = self._draws[0]
                theta = theta.repeat(self._count, 1) if form.batched else theta
                trial = self._try(form, theta)
                tried.append(trial)
                fits = trial.x is not None
                if fits and (form.arrays or isinstance(trial.result, Tensor)):
                    return trial
            fitting = [trial for trial in tried if trial.x is not None]
            if fitting:
                return fitting[0]
            trials = trials or tried
            if not any(isinstance(trial.result, Exception) for trial in tried):
                break
            self._draws = self._draws.roll(-1, dims=0)
        return self._refuse(trials)

    def _refuse(self, trials: list[_Trial]) -> NoReturn:
        """Raise the error of a simulator that returned no simulations."""
        batch, single = trials[0], trials[1]
        event = tuple(batch.caller.event_shape)
        outcomes = {describe(trial.result) for trial in trials}
        got = f"it gave {outcomes.pop()}."
        if outcomes:
            got = "it gave\n  " + "\n  ".join(map(str, trials))
        errors = [t.result for t in trials if isinstance(t.result, Exception)]
        # Other errors than these tell more than that the form is not the right one.
        telling = [e for e in errors if not isinstance(e, AttributeError | TypeError)]
        raise SimulationError(
            f"Expected `simulator` to map theta {tuple(batch.theta.shape)} to x "
            f"{(self._count, *event)}, or theta {tuple(single.theta.shape)} to x "
            f"{event}, as tensors, NumPy arrays or lists of numbers. At theta "
            f"{shown(single.theta.tolist())} {got}\nLet it return one of these, with "
            "NaN where a simulation cannot be made."
        ) from next(iter(telling[::-1] or errors), None)

    def _alone(self, caller: Caller, reason: str) -> Caller:
        """Return a caller of one theta at a time, and warn why."""
        warn_user(
            f"{reason}. It is therefore called with one theta at a time. If it should "
            "take batches, let each row of x depend on the same row of theta only, and "
            "have noise of its own."
        )
        return replace(caller, form=replace(caller.form, batched=False))

    def _shares_noise(self, trial: _Trial) -> bool:
        """Tell whether all rows of a batch with the same parameters get one noise."""
        x = trial.x
        assert x is not None
        if not bool((x == x[:1]).all()):
            return False
        again = self._try(trial.caller.form, trial.theta, seed=2).x
        return again is not None and not torch.equal(again, x)

    def _check_seeds(self, trial: _Trial) -> None:
        """Warn if the simulator sets a seed, and so repeats its noise at every call."""
        again = self._try(trial.caller.form, trial.theta, seed=2)
        # A simulator that sets no seed leaves different states after different seeds.
        if any(a == b for a, b in zip(trial.state, again.state, strict=True)):
            warn_user(
                "`simulator` sets the seed of the random numbers itself, so that every "
                "call of it has the same noise. Leave the seed to the caller."
            )

    def _check_own_noise(self, trial: _Trial) -> None:
        """Warn if the simulator has random numbers that no seed repeats."""
        again = self._try(trial.caller.form, trial.theta).x
        # More than the rounding of sums whose order changes, as on GPUs.
        if again is not None and not _are_equal(trial.x, again, tolerance=1e-3):
            warn_user(f"{OWN_NOISE}, so that no `seed` repeats a result. {REPAIR}")

    def _check_workers(self, theta: Tensor, num_workers: int) -> None:
        """Raise or warn if noise in workers is not what it is in this process."""
        caller = self._caller
        copies = [caller, caller]
        if num_workers > 1:
            copies = [
                replace(caller, function=copy_in_worker(caller.function))
                for _ in range(2)
            ]
        same = [self._try(caller.form, theta).x for _ in range(2)]
        if any(x is None for x in same) or _are_equal(*same):
            return
        apart = [
            self._try(caller.form, theta, seed=seed, caller=copied).x
            for seed, copied in enumerate(copies, start=1)
        ]
        if num_workers > 1 and _are_equal(*apart):
            raise SimulationError(
                f"{OWN_NOISE}; each worker process would repeat the same noise. "
                f"{REPAIR}"
            )
        warn_user(
            f"{OWN_NOISE}, so that simulations in worker processes cannot be repeated, "
            f"and may have the same noise in several of them. {REPAIR}"
        )

    def _attempt(self, theta: Tensor) -> Tensor | None:
        """Return simulations, or None."""
        self.num_calls += 1 if theta.ndim == 1 else len(theta)
        return self._caller.attempt(theta)[0]

    def _try(
        self, form: Form, theta: Tensor, *, seed: int = 1, caller: Caller | None = None
    ) -> _Trial:
        """Simulate in some form under a seed.

        Seed 0 is that of theta, whose numbers the noise must not repeat.
        """
        caller = replace(caller or self._caller, form=form)
        self.num_calls += 1 if theta.ndim == 1 else len(theta)
        with seeded(seed), warnings.catch_warnings():
            # NumPy and others warn of tensors, which may not be the right form.
            warnings.simplefilter("ignore")
            x, result = caller.attempt(theta)
            of_numpy: Any = np.random.get_state()  # noqa: NPY002
            state = (
                torch.get_rng_state().numpy().tobytes(),
                (of_numpy[1].tobytes(), *of_numpy[2:]),
                random.getstate(),
            )
        return _Trial(caller=caller, theta=theta, x=x, result=result, state=state)


def _are_equal(a: Tensor | None, b: Tensor | None, *, tolerance: float = 1e-6) -> bool:
    """Tell whether two simulations are the same, but for rounding."""
    if a is None or b is None:
        return False
    a, b = a.double(), b.double()
    return torch.allclose(a, b, rtol=tolerance, atol=0.0, equal_nan=True)
