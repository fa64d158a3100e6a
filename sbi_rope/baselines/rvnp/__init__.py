"""Robust variational neural posterior estimation (RVNP)."""

from sbi_rope.baselines.rvnp.method import RVNP

__all__ = ["RVNP"]
