"""A model of how reality differs from a simulator, and an NPE trained with it."""

from sbi_rope.discrepancy.model import DiscrepancyModel
from sbi_rope.discrepancy.npe import DiscrepancyNPE
from sbi_rope.discrepancy.parameters import ParameterDistribution, learn_parameters
from sbi_rope.discrepancy.posterior import Discrepancy, DiscrepancyDraws
from sbi_rope.discrepancy.report import DiscrepancyReport, Interval, SummaryDiscrepancy

__all__ = [
    "Discrepancy",
    "DiscrepancyDraws",
    "DiscrepancyModel",
    "DiscrepancyNPE",
    "DiscrepancyReport",
    "Interval",
    "ParameterDistribution",
    "SummaryDiscrepancy",
    "learn_parameters",
]
