"""A model of how reality differs from a simulator, and corrections with it."""

from sbi_rope.data.parameters import ParameterDistribution, learn_parameters
from sbi_rope.discrepancy.model import DiscrepancyModel
from sbi_rope.discrepancy.posterior import Discrepancy, DiscrepancyDraws
from sbi_rope.discrepancy.report import DiscrepancyReport, Interval, SummaryDiscrepancy

__all__ = [
    "Discrepancy",
    "DiscrepancyDraws",
    "DiscrepancyModel",
    "DiscrepancyReport",
    "Interval",
    "ParameterDistribution",
    "SummaryDiscrepancy",
    "learn_parameters",
]
