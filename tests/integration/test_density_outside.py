"""An NPE whose density is NaN or zero outside the prior's support and on its bounds."""

import functools
import warnings
from dataclasses import replace
from typing import Any

import pytest
import torch
from sbi.inference import NPE
from sbi.neural_nets import posterior_nn
from torch import Tensor, nn
from torch.distributions import Gamma, Independent

from sbi_rope import RoPE
from sbi_rope.methods import FinetunedNPE
from sbi_rope.rope.finetuning import FINETUNING
from sbi_rope.stacking import default_candidates, stack
from sbi_rope.utils.errors import RoPEWarning

PRIOR = Independent(Gamma(1.5 * torch.ones(2), torch.ones(2)), 1)


def simulator(theta: Tensor) -> Tensor:
    return (theta + 0.05).log() + 0.1 * torch.randn_like(theta)


@functools.cache
def npe_posterior() -> Any:
    torch.manual_seed(0)
    theta = PRIOR.sample((600,))
    build = posterior_nn(
        "zuko_maf",
        hidden_features=10,
        num_transforms=2,
        embedding_net=nn.Linear(2, 3),
        z_score_theta="transform_to_unconstrained",
        x_dist=PRIOR,
    )
    trainer = NPE(PRIOR, density_estimator=build, show_progress_bars=False)
    trainer.append_simulations(theta, simulator(theta)).train(max_num_epochs=15)
    posterior = trainer.build_posterior()
    density = posterior.posterior_estimator
    x = torch.zeros(1, 2)
    assert density.log_prob(torch.tensor([[[-1.0, 1.0]]]), x).isnan().all()
    assert not density.log_prob(torch.tensor([[[0.0, 1.0]]]), x).isfinite().any()
    return posterior


@functools.cache
def pairs() -> tuple[Tensor, Tensor]:
    torch.manual_seed(1)
    theta = PRIOR.sample((24,))
    return theta, simulator(theta) + 0.4


@pytest.mark.medium
def test_the_density_outside_the_support_is_zero_without_a_warning() -> None:
    rope = RoPE(npe_posterior(), simulator=simulator).append_calibration(*pairs())
    kept = [c for c in default_candidates() if c.name in ("prior", "NPE")]
    posterior = stack(rope, candidates=kept, num_folds=2, seed=0)
    x, theta = torch.zeros(1, 2), torch.tensor([[-1.0, 1.0], [1.0, 1.0]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = posterior.log_prob(theta, x=x)
        assert torch.equal(posterior.log_prob_batched(theta[:, None], x)[:, 0], found)
    assert torch.isneginf(found[0])
    assert torch.isfinite(found[1])


def test_a_label_on_a_bound_does_not_stop_fine_tuning() -> None:
    (theta, x), start = pairs(), npe_posterior().posterior_estimator
    on_bound = theta.clone()
    on_bound[0, 0] = 0.0
    training = replace(FINETUNING, max_num_epochs=60)
    method = FinetunedNPE.from_posterior(npe_posterior(), training=training)
    method.append_calibration(on_bound, x)
    with pytest.warns(RoPEWarning, match=r"1 calibration pair.* on a bound"):
        method.train(seed=1, show_progress_bars=False)
    tuned = method.build_posterior().posterior_estimator
    assert (start.loss(theta, x) - tuned.loss(theta, x)).mean() > 0.1
