"""The methods RoPE is compared with, each used like an sbi trainer or posterior."""

from sbi_rope.baselines.prior import PriorPosterior

__all__ = ["PriorPosterior"]
