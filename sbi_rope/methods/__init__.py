"""Methods that are used like sbi's trainers: append data, train, build a posterior."""

from sbi_rope.methods.base import Method
from sbi_rope.methods.discrepancy_npe import DiscrepancyNPE
from sbi_rope.methods.finetuned_npe import FinetunedNPE
from sbi_rope.training.fit import Training

__all__ = ["DiscrepancyNPE", "FinetunedNPE", "Method", "Training"]
