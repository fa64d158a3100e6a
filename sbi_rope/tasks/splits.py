r"""Sets of labelled pairs that share no observation.

A task's pairs come from a process that can be drawn from (:class:`DrawnPairs`), each
part on random streams of its own, or from recorded data (:class:`RecordedPairs`),
split once and for all.
"""

import hashlib
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from sbi_rope.utils.errors import InvalidInputError, SimulationError, warn_user

Part = Literal["calibration", "test", "simulation"]
# The chance, in [0, 1], of parameters (n, d) to stay in a set; one number a row.
Keep = Callable[[Tensor], Tensor]

# torch's CPU generator keeps the lower 32 bits of a seed, and each seed of a task
# needs four of those streams.
MAX_SEED = 2**30
BLOCK_SIZE = 100
# Blocks without a single pair after which there is no hope for one.
MAX_EMPTY_BLOCKS = 1000


@dataclass(frozen=True, kw_only=True)
class DrawnPairs:
    r"""Labelled observations of a process that is drawn on request.

    Parameters are drawn on the CPU in blocks of fixed size, and the first rows are
    kept. A smaller set is therefore the beginning of a larger one. The caller's random
    generators, those of all devices included, are left as they were. Other threads
    must not draw from them meanwhile. Pairs whose observation is not finite are dropped
    with their parameters and drawn again. A warning tells how many they were.

    Args:
        draw_theta: Draws a number of parameters, shape ``(n, d)``, from torch's
            global generator.
        observe: Draws one observation for each of them, shape ``(n, *event)``.

    Example:
        >>> pairs = DrawnPairs(
        ...     draw_theta=lambda n: torch.rand(n, 1),
        ...     observe=lambda theta: theta + torch.randn(len(theta), 3),
        ... )
        >>> few, _ = pairs.take(2, seed=0, part="test")
        >>> many, _ = pairs.take(5, seed=0, part="test")
        >>> torch.equal(few, many[:2])
        True
    """

    draw_theta: Callable[[int], Tensor]
    observe: Callable[[Tensor], Tensor]

    def take(
        self, n: int, *, seed: int, part: Part, keep: Keep | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return the first ``n`` pairs of the stream of one seed and part.

        Raises:
            SimulationError: If the process gives no valid pair in many attempts.
        """
        thetas, xs = [], []
        found = dropped = empty = 0
        with torch.random.fork_rng(devices=[]), torch.device("cpu"):
            # `torch.manual_seed` would reseed the accelerators as well.
            torch.default_generator.manual_seed(stream_of(seed, part))
            while found < n:
                theta, x, invalid = self._block(keep)
                thetas.append(theta)
                xs.append(x)
                found, dropped = found + len(theta), dropped + invalid
                empty = 0 if len(theta) else empty + 1
                if empty == MAX_EMPTY_BLOCKS:
                    raise SimulationError(
                        f"Only {found} of {n} pairs were found before "
                        f"{empty * BLOCK_SIZE} draws in a row gave none "
                        f"({dropped} had an observation with NaN or Inf)."
                    )
        if dropped:
            warn_user(
                f"Replaced {dropped} of {found + dropped} drawn pairs because their "
                "observations contain NaN or Inf."
            )
        return torch.cat(thetas)[:n], torch.cat(xs)[:n]

    def _block(self, keep: Keep | None) -> tuple[Tensor, Tensor, int]:
        theta = self.draw_theta(BLOCK_SIZE)
        if keep is not None:
            theta = theta[torch.rand(BLOCK_SIZE, dtype=torch.float64) < keep(theta)]
        if not len(theta):
            return theta, torch.empty(0), 0
        x = self.observe(theta)
        valid = torch.isfinite(x).flatten(1).all(dim=1)
        return theta[valid], x[valid], int((~valid).sum())


@dataclass(frozen=True, kw_only=True)
class RecordedPairs:
    """Labelled observations that were recorded once.

    The rows are put in a fixed random order that does not depend on the seed. Its
    first third belongs to the calibration part and the rest to the test part; the
    seed picks the rows within the part. Orders come from a hash of the row number,
    so that they are the same with every version of every library.

    Args:
        theta: Parameters of all rows, shape ``(rows, d)``.
        read_x: Returns the observations of chosen rows, in their order.
        groups: What rows have in common that must be in the same part, one entry a row.
        share: The share of the rows for calibration, a third unless given.

    Example:
        >>> theta = torch.arange(6.0).reshape(6, 1)
        >>> pairs = RecordedPairs(theta=theta, read_x=lambda rows: 10 * theta[rows])
        >>> pairs.take(2, seed=0, part="calibration")[1].flatten()
        tensor([30., 20.])
    """

    theta: Tensor
    read_x: Callable[[list[int]], Tensor]
    groups: Sequence[Hashable] | None = None
    share: float = 1 / 3

    def take(
        self, n: int, *, seed: int, part: Part, keep: Keep | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return ``n`` pairs of one part, which begin with those of a smaller ``n``.

        Raises:
            InvalidInputError: If the part has fewer than ``n`` such rows.
        """
        rows = self.rows_kept(seed=seed, part=part, keep=keep)
        if n > len(rows):
            filtered = "" if keep is None else " that the variant keeps under this seed"
            raise InvalidInputError(
                f"Expected `n` to be at most {len(rows)}, the number of recorded "
                f"observations in the {part} part{filtered}; got {n}."
            )
        rows = rows[:n]
        return self.theta[rows], self.read_x(rows)

    def rows_kept(
        self, *, seed: int, part: Part, keep: Keep | None = None
    ) -> list[int]:
        """Return the numbers of the rows a set is taken from, in their order."""
        rows = _shuffled(self.rows_of(part), key=f"seed {seed}")
        if keep is None:
            return rows
        chances = keep(self.theta[rows]).tolist()
        return [
            row
            for row, chance in zip(rows, chances, strict=True)
            if _uniform(row, key=f"keep {seed}") < chance
        ]

    def rows_of(self, part: Part) -> list[int]:
        """Return the numbers of all rows of a part, whatever the seed."""
        order = _shuffled(range(len(self.theta)), key="split")
        groups: dict[Hashable, list[int]] = {}
        for row in order:
            group = row if self.groups is None else self.groups[row]
            groups.setdefault(group, []).append(row)
        calibration: list[int] = []
        test: list[int] = []
        wanted = int(self.share * len(order) + 1e-9)
        for rows in groups.values():
            (calibration if len(calibration) < wanted else test).extend(rows)
        return calibration if part == "calibration" else test


def stream_of(seed: int, use: Part | Literal["labels"]) -> int:
    r"""Return the 32-bit random stream that a seed has for one use.

    Streams :math:`2s` and :math:`2s + 1` belong to the calibration and the test set
    of seed :math:`s`, those of simulations and label noise lie above all of them, so
    that no two uses share one. An odd multiplier modulo :math:`2^{32}` (a bijection)
    then moves the streams away from the small seeds with which callers draw their
    own simulations.
    """
    index = {
        "calibration": 2 * seed,
        "test": 2 * seed + 1,
        "simulation": 2 * MAX_SEED + seed,
        "labels": 3 * MAX_SEED + seed,
    }[use]
    return (index * 0x9E3779B1 + 0x85EBCA6B) % 2**32


def generator_of(key: str) -> torch.Generator:
    """Return random numbers on the CPU that belong to a name, the same everywhere."""
    digest = hashlib.sha256(key.encode()).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest[:4], "big"))


def _shuffled(rows: list[int] | range, *, key: str) -> list[int]:
    return sorted(rows, key=lambda row: _digest(row, key=key))


def _uniform(row: int, *, key: str) -> float:
    return int.from_bytes(_digest(row, key=key)[:7], "big") / 2**56


def _digest(row: int, *, key: str) -> bytes:
    return hashlib.sha256(f"{key}: {row}".encode()).digest()
