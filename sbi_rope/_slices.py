"""Rows that are worked on some at a time, to bound the memory."""

__all__ = ["slices"]


def slices(num_rows: int, size: int) -> list[slice]:
    """Cut rows into slices of one size; the last one may be shorter."""
    starts = range(0, num_rows, size)
    return [slice(start, min(start + size, num_rows)) for start in starts]
