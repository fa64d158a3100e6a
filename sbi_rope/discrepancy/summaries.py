"""Summaries of images, series or sets of trials, by a function of the user."""

from collections.abc import Callable
from typing import Any

from torch import Tensor, nn

from sbi_rope.errors import InvalidInputError
from sbi_rope.tensors import as_batch, as_numbers

__all__ = ["Summaries"]


class Summaries(nn.Module):
    """Calls a user's function where an embedding net is called.

    Args:
        function: Maps observations ``(n, *event)`` to summaries ``(n, k)``, tensors or
            NumPy arrays. A row of the summaries may depend on the same row of x only.

    Raises:
        InvalidInputError: If it is no function.
    """

    def __init__(self, function: Callable[[Tensor], Any]) -> None:
        super().__init__()
        if not callable(function):
            raise InvalidInputError(
                "Expected `summaries` to be callable, from x (n, *event) to (n, k); "
                f"got {type(function).__name__}."
            )
        self._function = function

    def forward(self, x: Tensor) -> Tensor:
        """Return the summaries, which may not be finite.

        Raises:
            InvalidInputError: If the function does not return numbers.
            InvalidInputError: If what it returns has another shape.
        """
        found = as_numbers("summaries(x)", self._function(x))
        if found.ndim != 2 or len(found) != len(x):
            raise InvalidInputError(
                f"Expected `summaries(x)` of shape ({len(x)}, k) for x of shape "
                f"{tuple(x.shape)}; got {tuple(found.shape)}."
            )
        return as_batch("summaries(x)", found, found.shape[1:], finite=False).to(
            x.device
        )
