"""Flow matching corrected posterior estimation (FMCPE)."""

from sbi_rope.baselines.fmcpe.method import FMCPE

__all__ = ["FMCPE"]
