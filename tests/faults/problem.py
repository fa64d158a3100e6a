"""The small linear Gaussian problem with a bounded prior that all calls share."""

import functools
from typing import Any

import torch
from sbi.inference import DirectPosterior
from sbi.utils import BoxUniform
from torch import Tensor

from sbi_rope import CalibrationFinetuner, RoPE, diagnose, stack
from sbi_rope.discrepancy import DiscrepancyModel, DiscrepancyNPE
from sbi_rope.stacking import default_candidates
from tests import gaussian

QUIET: dict[str, Any] = {"show_progress_bars": False}


def draw(seed: int, *shape: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


THETA, THETA_S = draw(0, 20, 2), draw(1, 60, 2)
X = 1.4 * (THETA + 0.5 * draw(2, 20, 2)) + 0.7
X_S = THETA_S + 0.5 * draw(3, 60, 2)
X_O = 1.4 * draw(4, 24, 2) + 0.7
THETA_O = draw(5, 24, 2)
LOG_SCORES = -THETA.square()
FINETUNER = CalibrationFinetuner(max_num_epochs=2)


NOISE = torch.eye(2) / 4

PRIOR = BoxUniform(-4 * torch.ones(2), 4 * torch.ones(2))


@functools.cache
def npe() -> Any:
    return DirectPosterior(gaussian.GaussianEstimator(), PRIOR)


def untrained(**options: Any) -> RoPE:
    options.setdefault("finetuner", FINETUNER)
    if "simulations" not in options:
        options.setdefault("simulator", gaussian.simulator)
    return RoPE(npe(), **options)


@functools.cache
def trained() -> RoPE:
    return untrained().append_calibration(THETA, X).train(seed=0, **QUIET)


@functools.cache
def posterior() -> Any:
    return trained().build_posterior(X_O, num_simulations=30, seed=0, **QUIET)


CANDIDATES = default_candidates()[:2]


@functools.cache
def stacked() -> Any:
    return stack(trained(), candidates=CANDIDATES, num_folds=2, seed=0, **QUIET)


@functools.cache
def fitted_discrepancy() -> Any:
    return DiscrepancyModel().fit(X, THETA, NOISE)


@functools.cache
def diagnosed() -> Any:
    options: dict[str, Any] = {"num_simulations": 100, "num_folds": None, "seed": 0}
    return diagnose(trained(), X_O, **options, **QUIET)


@functools.cache
def discrepancy_report() -> Any:
    method = DiscrepancyNPE.from_posterior(npe(), simulations=(THETA_S, X_S))
    return method.append_calibration(THETA, X).report(**QUIET)


FROM_LISTS = ("theta: a list", "theta: a NumPy array")

COUPLED = {"real": X_O, "simulated": X_S}
PAIRS = {"theta": THETA, "x": X}
SIMULATIONS = {"theta": THETA_S, "x": X_S}
# Nothing is paired with these observations, so one row less is good input.
FEWER_X_O = ("x_o: one row less",)
