"""How much of a mixture is held, and evaluated, at a time."""

import torch

from sbi_rope._slices import slices

__all__ = ["blocks", "flow_batch", "keep_freed_memory", "num_fitting"]

# Most weights, terms of the density, or proposals held at a time: a block of
# observations times all simulations, or times some of its samples. With all that is
# computed from it an entry takes about 64 bytes.
MAX_ENTRIES = 2**19
# Pairs of parameter and component in one call of the flow: on a CPU the intermediate
# results of a larger one no longer fit into the caches, on a GPU those of a smaller one
# do not occupy it.
CPU_BATCH, GPU_BATCH = 2**14, 2**17


def flow_batch(device: torch.device) -> int:
    """Return how many pairs of parameter and component the flow sees in one call."""
    return CPU_BATCH if device.type == "cpu" else GPU_BATCH


def num_fitting(num_columns: int) -> int:
    """Return how many rows of so many columns are held at a time, at least one."""
    return max(1, MAX_ENTRIES // max(1, num_columns))


def blocks(num_rows: int, num_columns: int) -> list[slice]:
    """Cut rows of so many columns into blocks that are held at a time."""
    return slices(num_rows, num_fitting(num_columns))


def keep_freed_memory(device: torch.device) -> None:
    """Let the C library reuse the memory of one flow call in the next.

    glibc returns freed memory to the system beyond twice the size of the largest block
    freed so far, up to 64 MiB. In a process that never freed a large block the flow
    then fetches its intermediate results page by page in every call, which takes up to
    a third of the time. Freeing one block of almost 32 MiB, of which nothing was used,
    ends that.
    """
    if device.type == "cpu":
        torch.empty(2**25 - 2**16, dtype=torch.uint8)
