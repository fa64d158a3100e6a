"""Make posteriors narrower or wider, as held-out pairs say."""

from sbi_rope.recalibration.recalibration import Recalibration

__all__ = ["Recalibration"]
