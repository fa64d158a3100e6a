"""What the package takes from sbi's estimators, and what it refuses."""

import copy
from typing import Any

import pytest
import torch
from sbi.inference import NPE, EnsemblePosterior, MCMCPosterior
from sbi.inference.posteriors import NPE_A_Posterior
from sbi.inference.posteriors.filtered_direct_posterior import FilteredDirectPosterior
from torch import nn

from sbi_rope import RoPE
from sbi_rope.npe.sbi import embed, embedding_of, headless, with_embedding
from sbi_rope.utils.errors import UnsupportedPosteriorError
from tests import problems


def fresh_estimator(family: str = "maf") -> Any:
    """A copy that a test may change."""
    return copy.deepcopy(problems.npe_posterior(family).posterior_estimator)


def bare(kind: type) -> Any:
    """An instance without state: enough for a check that looks at the type."""
    return kind.__new__(kind)


def test_what_has_no_amortised_estimator_is_refused_by_name() -> None:
    for posterior in (
        bare(MCMCPosterior),
        bare(NPE_A_Posterior),
        bare(FilteredDirectPosterior),
        EnsemblePosterior([problems.npe_posterior()] * 2),
        problems.gaussian_posterior(),
        NPE(problems.box(2), show_progress_bars=False),
        problems.npe_posterior().posterior_estimator,
    ):
        match = rf"NPE\(\.\.\.\)\.build_.*got {type(posterior).__name__}"
        with pytest.raises(UnsupportedPosteriorError, match=match):
            RoPE(posterior, simulator=problems.simulate)


def test_npe_without_a_prior_is_asked_for_it() -> None:
    theta = problems.box(2).sample((50,))
    npe = NPE(density_estimator="mdn", show_progress_bars=False)
    npe.append_simulations(theta, problems.simulate(theta)).train(max_num_epochs=1)
    with pytest.raises(UnsupportedPosteriorError, match=r"build_posterior\(prior="):
        RoPE(npe.build_posterior(), simulator=problems.simulate)
    RoPE(npe.build_posterior(prior=problems.box(2)), simulator=problems.simulate)


def test_with_embedding_shares_all_other_parameters() -> None:
    estimator = fresh_estimator()
    old = {id(p) for p in embedding_of(estimator).parameters()}
    density = {id(p) for p in estimator.parameters()} - old
    swapped = with_embedding(estimator, nn.Identity())
    assert {id(p) for p in swapped.parameters()} == density


@pytest.mark.parametrize("family", ["mdn", "made", "maf", "zuko_nsf", "mnpe"])
def test_what_was_made_headless_can_be_given_an_embedding(family: str) -> None:
    estimator = fresh_estimator(family)
    theta = problems.npe_posterior(family).prior.sample((5,))[None]
    x = torch.randn(5, 3)
    whole = with_embedding(
        headless(estimator), embedding_of(estimator), condition_shape=(3,)
    )
    assert whole.condition_shape == (3,)
    assert torch.equal(whole.log_prob(theta, x), estimator.log_prob(theta, x))
    assert headless(whole).condition_shape == (4,)


def test_embed_does_not_depend_on_the_batch() -> None:
    net = nn.Sequential(nn.Linear(3, 4), nn.BatchNorm1d(4), nn.Dropout(0.5)).train()
    x = torch.randn(10, 3)
    whole = embed(net, x)
    assert torch.allclose(embed(net, x, batch_size=3), whole, atol=1e-6)
    assert torch.allclose(embed(net, x[4:5]), whole[4:5], atol=1e-6)
    assert not whole.requires_grad
