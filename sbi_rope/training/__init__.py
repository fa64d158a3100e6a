"""Networks that are trained at once, and the loop that trains them."""

from sbi_rope.training.fit import History, Training

__all__ = [
    "History",
    "Training",
]
