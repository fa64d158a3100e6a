"""Missing trials (NaN) are accepted where the embedding net leaves them out."""

from functools import partial

import pytest
import torch
from torch import Tensor

from sbi_rope import RoPE
from sbi_rope.methods import DiscrepancyNPE, FinetunedNPE
from sbi_rope.methods.training import Training
from sbi_rope.metrics import draw_samples, evaluate
from sbi_rope.stacking import default_candidates
from sbi_rope.utils.errors import InvalidInputError, UnsupportedPosteriorError
from tests import problems
from tests.stacks import QUICK, QUIET, stacked


def labelled(n: int) -> tuple[Tensor, Tensor]:
    """Return parameters and real trials, which differ from simulated ones."""
    theta = problems.box(2).sample((n,))
    return theta, problems.simulate_trials(theta) + 0.3


def rope() -> RoPE:
    npe, simulator = problems.trials_posterior(), problems.simulate_trials
    rope = RoPE(npe, simulator=simulator, finetuner=QUICK)
    return rope.append_calibration(*labelled(12))


def is_finite(posterior: object, theta: Tensor, x: Tensor) -> bool:
    scores = evaluate(posterior, theta, x, num_samples=20)
    samples = draw_samples(posterior, x, num_samples=5)
    return bool(scores.log_prob.isfinite().all() and samples.isfinite().all())


def test_rope_repairs_a_posterior_of_trials_some_of_which_are_missing() -> None:
    theta_o, x_o = labelled(25)
    assert torch.isnan(x_o).any()
    trained = rope().train(seed=0, **QUIET)
    assert torch.isfinite(torch.tensor(trained.history.training_loss)).all()
    posterior = trained.build_posterior(x_o, num_simulations=60, seed=0, **QUIET)
    assert trained.source.num_dropped == 0
    assert is_finite(posterior, theta_o, x_o)
    # The observation is known again by its values, those missing included.
    expected = posterior.log_prob_batched(theta_o[3:4], x=x_o[3:4])[0]
    assert torch.allclose(posterior[3].log_prob(theta_o[3:4]), expected)


@pytest.mark.slow
def test_a_stack_takes_trials_some_of_which_are_missing() -> None:
    theta_o, x_o = labelled(20)
    names = ("NPE", "fine-tuned NPE", "discrepancy (tuned)")
    chosen = [c for c in default_candidates() if c.name in names]
    posterior = stacked(rope(), candidates=chosen, num_folds=3)
    assert is_finite(posterior, theta_o, x_o)


def test_trainers_that_start_from_a_posterior_take_missing_trials() -> None:
    theta_o, x_o = labelled(20)
    npe = problems.trials_posterior()
    tuned = FinetunedNPE.from_posterior(npe, training=Training(max_num_epochs=2))
    corrected = DiscrepancyNPE.from_posterior(
        npe, simulator=problems.simulate_trials, num_steps=4, num_simulations=100
    )
    for method in (tuned, corrected):
        method.append_calibration(*labelled(12)).train(seed=0, **QUIET)
        assert is_finite(method.build_posterior(), theta_o, x_o)


def test_what_the_net_cannot_read_is_refused() -> None:
    for row, value in (((2,), torch.nan), ((4, 0, 0), torch.inf)):
        theta, x = labelled(10)
        x[row] = value
        match = rf"cannot read; got .*\(first: \[{row[0]}\]\)"
        with pytest.raises(InvalidInputError, match=match):
            rope().append_calibration(theta, x)
        with pytest.raises(InvalidInputError, match="`x`"):
            evaluate(problems.trials_posterior(), theta, x)


def test_a_net_that_counts_the_trials_of_another_row_is_refused() -> None:
    npe = problems.trials_posterior(problems.trials_net_of_sbi)
    rope = RoPE(npe, simulator=problems.simulate_trials)
    theta, x = labelled(10)
    # With no trial missing, its embeddings are right.
    rope.append_calibration(theta, x.nan_to_num(0.5))
    for call in (rope.append_calibration, partial(evaluate, npe)):
        match = "embedding of a row alone than in a batch"
        with pytest.raises(UnsupportedPosteriorError, match=match):
            call(theta, x)
