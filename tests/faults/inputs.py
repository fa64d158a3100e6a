"""Arguments that are wrong, extreme or unusual."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

# These must be refused. Each entry makes a bad argument from a good tensor (n, ...).
BAD_TENSORS: dict[str, Callable[[Tensor], Any]] = {
    "None": lambda good: None,
    "a number": lambda good: 1.0,
    "text": lambda good: "x",
    "no dimension": lambda good: good.new_ones(()),
    "one dimension more": lambda good: good[..., None],
    "one dimension less": lambda good: good.reshape(-1)[:3],
    "one column more": lambda good: torch.cat([good, good[..., :1]], dim=-1),
    "no rows": lambda good: good[:0],
    "one row less": lambda good: good[:-1],
    "NaN": lambda good: spoilt(good, math.nan),
    "Inf": lambda good: spoilt(good, math.inf),
    "complex": lambda good: good.to(torch.complex64),
    "bool": lambda good: good > 0,
    "sparse": lambda good: good.to_sparse(),
    "without values": lambda good: good.to("meta"),
    "an array of objects": lambda good: np.array([object()] * len(good)),
}
# These must be refused or give numbers, although the numbers may be of little use.
EXTREME_TENSORS: dict[str, Callable[[Tensor], Any]] = {
    "one entry of 1e30": lambda good: spoilt(good, 1e30),
    # This is too large for float32.
    "one entry of 1e39": lambda good: spoilt(good.double(), 1e39),
    "one entry of -1e15": lambda good: spoilt(good, -1e15),
    "all entries of 1e-30": lambda good: torch.full_like(good, 1e-30),
    "one value only": lambda good: torch.full_like(good, 0.5),
    "a constant column": lambda good: torch.cat(
        [torch.full_like(good[..., :1], 0.25), good[..., 1:]], dim=-1
    ),
    "one row": lambda good: good[:1],
    "twice the same rows": lambda good: good[:1].expand_as(good),
}
# These must be refused, or give what a plain float32 tensor of the same numbers gives.
ODD_TENSORS: dict[str, Callable[[Tensor], Any]] = {
    "a list": lambda good: good.tolist(),
    "a NumPy array": lambda good: good.numpy(),
    "a NumPy array of float64": lambda good: good.double().numpy(),
    "float64": Tensor.double,
    "half": lambda good: good.half().float().half(),
    "bfloat16": lambda good: good.bfloat16(),
    "integers": lambda good: good.round().long(),
    "small integers": lambda good: good.round().to(torch.int8),
    "with gradients": lambda good: good.clone().requires_grad_(),
    "a parameter": torch.nn.Parameter,
    "not contiguous": lambda good: good.repeat_interleave(2, dim=0)[::2],
    "of inference mode": lambda good: _of_inference_mode(good),
}

# Weights of pairs must not have these values either.
BAD_WEIGHTS: dict[str, Callable[[Tensor], Any]] = {
    "a negative entry": lambda good: spoilt(good, -1.0),
    "an entry of zero": lambda good: spoilt(good, 0.0),
}

# For whole numbers, such as indices of rows, these inputs are good.
FINE_ROWS = ("one dimension less", "one column more", "one row less")
# The unusual tensors of whole numbers.
ODD_ROWS = {
    label: ODD_TENSORS[label]
    for label in ("small integers", "not contiguous", "of inference mode")
}

# These must be refused, for each kind of an option.
BAD_OPTIONS: dict[str, list[Any]] = {
    "positive": [0, -1.0, math.nan, math.inf, "x", True, [1.0], torch.ones(2)],
    # With a learning rate of 1e38 the steps of Adam are no longer numbers.
    "rate": [0, -1.0, math.nan, math.inf, 1e38, "x", True, torch.ones(2)],
    "not negative": [-1.0, math.nan, math.inf, "x", True, [1.0], None],
    "share": [-0.1, 1.1, math.nan, "x", True, [0.5]],
    "count": [0, -1, 1.5, math.nan, 10**30, "x", True, [3], torch.ones(2)],
    "choice": ["x", 3, np.array([1, 2]), [], {"a": 1}, torch.ones(2)],
    "seed": [-1, 1.5, "x", True, [0], torch.ones(2)],
    "numbers": [0.5, "x", [], [math.nan], [-1.0], [None], ["x"], None],
    "instance": [3, "x", object(), int],
    "device": ["banana", 3.5, "cuda:99", object()],
    "path": [3, 1.5, object(), ["x"]],
    "row": [-1, 10**6, 1.5, "x", None],
    "text": ["", 3, None, ["x"]],
    "function": [3, "x", [len]],
    "shape": [3.5, "x", (-1,), (1.5,), None],
    "names": ["x", 3, ["a"], ["a", "a"], [1, 2, 3]],
}


def spoilt(good: Tensor, value: float) -> Tensor:
    """Return a copy in which an entry in the middle is replaced."""
    bad = good.clone().contiguous()
    if bad.is_floating_point():
        bad.view(-1)[bad.numel() // 2] = value
        return bad
    # Whole numbers, such as those of rows, cannot be NaN.
    return bad.double().fill_(value)


def _of_inference_mode(good: Tensor) -> Tensor:
    with torch.inference_mode():
        return good + 0
