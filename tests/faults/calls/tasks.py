"""Tasks: how they are asked for, their sets, simulators and quantiles."""

import functools

import torch
from torch import Tensor

from sbi_rope.tasks import TASKS, Task, get_task
from tests.faults.outcomes import Call

# The result has the dtype of the argument.
OTHER_DTYPES = tuple(f"theta: {dtype}" for dtype in ("float64", "half", "bfloat16"))
NAMES = tuple(TASKS)
# All sets are made by the same code, see `tests/contract/test_task_sets.py`: one task
# that is drawn, and one that is recorded, stand for the others.
WITH_SETS = ("pendulum", "hemodynamics")


@functools.cache
def made(name: str) -> Task:
    return get_task(name)


@functools.cache
def some_theta(name: str) -> Tensor:
    """Draw from the prior, which takes less time than simulations when tests start."""
    with torch.random.fork_rng():
        torch.default_generator.manual_seed(0)
        return made(name).get_prior().sample((20,))


CALLS = [
    Call(
        name="get_task",
        run=lambda name="pendulum", **options: get_task(name, **options).theta_dim,
        options={"name": "choice", "variant": "choice"},
    ),
    *(
        Call(
            name=f"{method}({name})",
            run=lambda n=5, seed=0, name=name, method=method: getattr(
                made(name), method
            )(n, seed=seed),
            options={"n": "count", "seed": "seed"},
        )
        for name in WITH_SETS
        for method in ("get_calibration_set", "get_test_set", "get_simulations")
    ),
    *(
        Call(
            name=f"get_simulator({name})",
            run=lambda theta, name=name: made(name).get_simulator()(theta),
            tensors={"theta": some_theta(name)},
            accepts=(
                "theta: one row less",
                "theta: no rows",
                *OTHER_DTYPES,
                # Outside the prior a simulation may fail, which NaN says.
                "theta: all entries of 1e-30",
                "theta: one value only",
                "theta: a constant column",
            ),
            is_random=True,
        )
        for name in NAMES
    ),
]
