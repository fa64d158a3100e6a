r"""Calibration and test sets that never share an observation.

Synthetic tasks give each part random streams of its own (:func:`draw_rows`),
recorded data are split once and for all (:func:`select_rows`).
"""

import hashlib
from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from sbi_rope.errors import InvalidInputError

__all__ = ["MAX_SEED", "Part", "draw_rows", "select_rows"]

Part = Literal["calibration", "test"]

# torch's CPU generator keeps the lower 32 bits of a seed, and each seed of a task
# needs two of those streams.
MAX_SEED = 2**31
BLOCK_SIZE = 100


def draw_rows(
    draw: Callable[[int], tuple[Tensor, Tensor]], n: int, *, seed: int, part: Part
) -> tuple[Tensor, Tensor]:
    r"""Draw labelled observations from the random stream of one seed and part.

    Stream :math:`2s` belongs to the calibration set of seed :math:`s` and stream
    :math:`2s + 1` to its test set, so no two sets share one. An odd multiplier
    modulo :math:`2^{32}` (a bijection) then moves the streams away from the small
    seeds with which callers draw their simulations.

    The rows are drawn on the CPU in blocks of fixed size, of which the first ``n``
    rows are kept: a smaller set is the beginning of a larger one. The caller's
    generators, those of all devices included, are left as they were.

    Args:
        draw: Draws a given number of pairs ``(theta, x_o)`` from torch's global
            generator.
        n: Number of rows to return.
        seed: Integer from 0 to ``MAX_SEED - 1``.
        part: The part of the task's data that is drawn.

    Returns:
        Parameters and observations, ``n`` rows each.

    Example:
        >>> def draw(n):
        ...     theta = torch.rand(n, 1)
        ...     return theta, theta + torch.randn(n, 3)
        >>> few, _ = draw_rows(draw, 2, seed=0, part="test")
        >>> many, _ = draw_rows(draw, 5, seed=0, part="test")
        >>> torch.equal(few, many[:2])
        True
    """
    stream = (2 * seed + (part == "test")) * 0x9E3779B1 + 0x85EBCA6B
    with torch.random.fork_rng(devices=[]), torch.device("cpu"):
        # `torch.manual_seed` would reseed the accelerators as well.
        torch.default_generator.manual_seed(stream % 2**32)
        blocks = [draw(BLOCK_SIZE) for _ in range(-(-n // BLOCK_SIZE))]
    theta, x = (torch.cat(rows)[:n] for rows in zip(*blocks, strict=True))
    return theta, x


def select_rows(num_rows: int, n: int, *, seed: int, part: Part) -> list[int]:
    """Choose rows of a recorded data set.

    The rows are put in a fixed random order that does not depend on ``seed``. Its
    first third belongs to the calibration part and the rest to the test part; the
    seed picks the rows within the part. Orders come from a hash of the row number,
    so that they are the same with every version of every library.

    Args:
        num_rows: Number of rows of the data set.
        n: Number of rows to choose.
        seed: Which rows to choose; a smaller choice is the beginning of a larger one.
        part: The part to choose from.

    Returns:
        Row numbers, ``n`` of them, all different.

    Raises:
        InvalidInputError: If the part has fewer than ``n`` rows.

    Example:
        >>> select_rows(6, 2, seed=0, part="calibration")
        [3, 2]
        >>> sorted(select_rows(6, 4, seed=0, part="test"))
        [0, 1, 4, 5]
    """
    order = _shuffled(range(num_rows), key="split")
    third = num_rows // 3
    rows = order[:third] if part == "calibration" else order[third:]
    if n > len(rows):
        raise InvalidInputError(
            f"Expected `n` to be at most {len(rows)}, the number of recorded "
            f"observations in the {part} part; got {n}."
        )
    return _shuffled(rows, key=f"seed {seed}")[:n]


def _shuffled(rows: list[int] | range, *, key: str) -> list[int]:
    def digest(row: int) -> bytes:
        return hashlib.sha256(f"{key}: {row}".encode()).digest()

    return sorted(rows, key=digest)
