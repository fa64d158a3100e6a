"""Summaries of images, series or sets of trials, by a function of the user."""

from collections.abc import Callable
from typing import Any

import numpy as np
from torch import Tensor, nn

from sbi_rope.settings import check
from sbi_rope.tensors import as_batch

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
        check("summaries", function, Callable)
        self._function = function

    def forward(self, x: Tensor) -> Tensor:
        """Return the summaries, which may not be finite.

        Raises:
            InvalidInputError: If the function does not return numbers, ``(n, k)``.
        """
        found = self._function(x)
        width = np.shape(found)[-1:]
        found = as_batch("summaries(x)", found, width, rows=len(x), finite=False)
        return found.to(x.device)
