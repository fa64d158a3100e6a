"""Scores of a posterior: the density of true parameters, and calibration.

:func:`evaluate` draws samples once and returns an :class:`Evaluation` with all scores
of any posterior that has ``sample_batched`` and ``log_prob_batched``. The test set
consists of ``theta``, shape ``(n, d)``, and ``x``, shape ``(n, *event_shape)``.
"""

from sbi_rope.metrics.calls import draw_samples
from sbi_rope.metrics.evaluation import Evaluation, evaluate
from sbi_rope.metrics.statistics import Estimate

__all__ = ["Estimate", "Evaluation", "draw_samples", "evaluate"]
