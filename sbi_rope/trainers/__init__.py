"""Methods that are used like sbi's trainers: append data, train, build a posterior."""

from sbi_rope.fit import Training
from sbi_rope.trainers.base import Method
from sbi_rope.trainers.finetuned_npe import FinetunedNPE

__all__ = ["FinetunedNPE", "Method", "Training"]
