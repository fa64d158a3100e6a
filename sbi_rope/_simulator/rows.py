"""Find out whether the rows of a batch of simulations depend on each other."""

import time
from collections.abc import Callable
from typing import Any

import torch
from scipy.stats import ks_2samp
from torch import Tensor

__all__ = ["Attempt", "rows_depend_on_each_other"]

# To find out whether rows depend on each other, a theta is simulated this often beside
# other rows. Below this p-value the simulations are of different distributions.
NUM_COMPARED, DIFFERENT = 50, 1e-6
# The comparison may take this many seconds. Slower simulators are not compared.
LONGEST = 5.0

# It maps theta ``(n, d)`` to x ``(n, *event)``, or ``(d,)`` to ``(*event)``, or to None
# if the simulator fails.
Attempt = Callable[[Tensor], Tensor | None]


def rows_depend_on_each_other(
    attempt: Attempt,
    attempt_again: Attempt,
    x: Tensor | None,
    theta: Tensor,
    others: Tensor,
) -> bool:
    """Tell whether the rows of simulations of a batch depend on each other.

    An example is ``lambda theta: theta * theta.norm()``, which is meant for one theta,
    but also accepts a batch.

    Args:
        attempt: Simulates with new random numbers.
        attempt_again: Simulates with always the same random numbers.
        x: What ``attempt_again`` returns for theta.
        theta: Parameters, shape ``(n, d)``.
        others: Other parameters, shape ``(n, d)``.
    """
    # The first row and the last row, each among other rows than before.
    batches = [theta, torch.cat([theta[:1], others[1:]])]
    batches.append(torch.cat([others[:-1], theta[-1:]]))
    rows = ((0, 1), (-1, 2))
    start = time.perf_counter()
    xs = _all_of([x, *(attempt_again(batch) for batch in batches[1:])])
    seconds = (time.perf_counter() - start) / len(batches[1:])
    # A simulator that fails here raises a clear error when it is used.
    if xs is None or all(_is_close(xs[0][row], xs[k][row]) for row, k in rows):
        return False
    # Either the rows depend on each other, or they only get other random numbers, for
    # example because draws are rejected, or because the simulator has a generator of
    # its own. In the second case their distribution is the same.
    if 4 * NUM_COMPARED * seconds > LONGEST:
        return False
    many = [_all_of([attempt(b) for _ in range(NUM_COMPARED)]) for b in batches]
    if any(xs is None for xs in many):
        return False
    alone = _all_of([attempt(theta[0]) for _ in range(NUM_COMPARED)])
    usual, *changed = (torch.stack(xs) for xs in many if xs is not None)
    pairs = [(usual[:, row], changed[k - 1][:, row]) for row, k in rows]
    if alone is not None:
        pairs.append((usual[:, 0], torch.stack(alone)))
    return any(_is_different(*pair) for pair in pairs)


def _all_of(xs: list[Tensor | None]) -> list[Tensor] | None:
    """Return simulations, or None if one of them failed."""
    made = [x for x in xs if x is not None]
    return made if len(made) == len(xs) else None


def _is_close(a: Tensor, b: Tensor) -> bool:
    """Tell whether two simulations are about the same.

    They need not be equal, because rounding, and the steps of an adaptive solver, may
    depend on the other rows.
    """
    a, b = a.double(), b.double()
    scale = float(a.nan_to_num(0.0, 0.0, 0.0).abs().max())
    return torch.allclose(a, b, rtol=0.0, atol=0.01 * scale, equal_nan=True)


def _is_different(a: Tensor, b: Tensor) -> bool:
    """Tell whether two sets of simulations have different distributions.

    Each entry whose medians differ by more than rounding is compared by the
    Kolmogorov-Smirnov test.
    """
    a, b = a.flatten(1).double(), b.flatten(1).double()
    middle_a, middle_b = a.nanmedian(dim=0).values, b.nanmedian(dim=0).values
    scale = torch.maximum(middle_a.abs(), middle_b.abs())
    apart = (middle_a - middle_b).abs() > 1e-4 * scale
    for column in apart.nonzero().flatten().tolist():
        first, second = (
            values[~values.isnan()].cpu().numpy()
            for values in (a[:, column], b[:, column])
        )
        test: Any = ks_2samp(first, second)
        if test.pvalue < DIFFERENT / a.shape[1]:
            return True
    return False
