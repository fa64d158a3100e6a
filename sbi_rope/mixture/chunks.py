"""How much of a mixture is held in memory, and evaluated, at a time."""

import torch

__all__ = ["blocks", "flow_batch", "keep_freed_memory", "num_fitting"]

# The largest number of weights, terms of the density, or proposals held at a time: a
# block of observations times all simulations, or times some of its samples. Each entry
# takes about 64 bytes, with everything that is computed from it.
MAX_ENTRIES = 2**19
# Pairs of a parameter and a component in one call of the flow. On a CPU the
# intermediate results of a larger call no longer fit into the caches, and on a GPU a
# smaller call does not occupy the whole device.
CPU_BATCH, GPU_BATCH = 2**14, 2**17


def flow_batch(device: torch.device) -> int:
    """Return how many pairs of a parameter and a component one flow call takes."""
    return CPU_BATCH if device.type == "cpu" else GPU_BATCH


def num_fitting(num_columns: int) -> int:
    """Return how many rows of ``num_columns`` entries are held at a time."""
    return max(1, MAX_ENTRIES // max(1, num_columns))


def blocks(num_rows: int, num_columns: int) -> list[slice]:
    """Cut rows of ``num_columns`` entries into blocks that are held at a time."""
    size = num_fitting(num_columns)
    starts = range(0, num_rows, size)
    return [slice(start, min(start + size, num_rows)) for start in starts]


def keep_freed_memory(device: torch.device) -> None:
    """Let the C library reuse the memory of one flow call in the next.

    glibc keeps freed memory only up to twice the size of the largest block that was
    ever freed (at most 64 MiB), and returns the rest to the system. A process that
    never freed a large block therefore gets the memory of every flow call anew, page by
    page, which takes up to a third of the time. Freeing one unused block of almost
    32 MiB raises that limit.
    """
    if device.type == "cpu":
        torch.empty(2**25 - 2**16, dtype=torch.uint8)
