"""The average of posteriors is the mixture of their densities."""

import copy

import pytest
import torch
from sbi.inference import EnsemblePosterior
from sbi.utils import BoxUniform
from torch import Tensor
from torch.distributions import Distribution

from sbi_rope import MixturePosterior, RoPE
from sbi_rope.density import Flow, average
from sbi_rope.npe.sbi import estimator_of
from sbi_rope.utils.errors import (
    InvalidInputError,
    UnsupportedPosteriorError,
)
from tests import problems
from tests.stacks import QUIET, unnormalised

WEIGHTS = torch.tensor([0.7, 0.3])


def ensemble() -> EnsemblePosterior:
    members = [problems.npe_posterior(family) for family in ("mdn", "maf")]
    return EnsemblePosterior(copy.deepcopy(members), WEIGHTS.tolist())


def pairs(n: int) -> tuple[Tensor, Tensor]:
    theta = problems.box(2).sample((n,))
    return theta, problems.simulate(theta)


def mixed(log_probs: list[Tensor]) -> Tensor:
    return torch.stack(log_probs).add(WEIGHTS.log()[:, None, None]).logsumexp(dim=0)


def test_an_average_of_npes_is_the_ensemble_of_sbi() -> None:
    npes = ensemble()
    posterior = average(npes.posteriors, weights=npes.weights)
    theta, x = pairs(6)
    expected = mixed([unnormalised(npe, theta, x) for npe in npes.posteriors])
    assert torch.allclose(unnormalised(posterior, theta, x), expected, atol=1e-5)
    assert posterior.is_amortised
    assert posterior.sample((5,), x=x[0], **QUIET).shape == (5, 2)


def test_the_members_of_an_ensemble_are_repaired_one_by_one() -> None:
    x_o = pairs(25)[1] + 0.3
    theta = pairs(25)[0]

    def repaired(member: object) -> MixturePosterior:
        rope = RoPE(member, simulator=problems.simulate)
        return rope.build_posterior(x_o, num_simulations=50, seed=0, **QUIET)

    npes = ensemble()
    members = [repaired(member) for member in npes.posteriors]
    posterior = average(members, weights=npes.weights)
    expected = mixed([unnormalised(member, theta, x_o) for member in members])
    # Each leaves out the smallest weights, up to 0.001 of all.
    assert torch.allclose(unnormalised(posterior, theta, x_o), expected, atol=0.05)
    assert torch.equal(posterior.x_o, x_o)
    samples = posterior[2].sample((2000,), **QUIET)
    share = (samples[:, 0] < 0).float().mean()
    alone = torch.stack(
        [(m[2].sample((2000,), **QUIET)[:, 0] < 0).float().mean() for m in members]
    )
    assert float(share) == pytest.approx(float(alone @ WEIGHTS), abs=0.05)


def test_what_cannot_be_averaged_is_refused() -> None:
    member = problems.gaussian_posterior()
    field = problems.vector_field_posterior("fmpe")
    with pytest.raises(UnsupportedPosteriorError, match="density"):
        average([field])
    for members, weights, match in (
        ([], None, "at least one"),
        ([member], [0.5, 0.5], "`weights`"),
        ([member, problems.gaussian_posterior()], None, "same `x_o`"),
        ([member, problems.gaussian_posterior(dim=3)], None, "same shapes"),
    ):
        with pytest.raises(InvalidInputError, match=match):
            average(members, weights=weights)


def single(prior: Distribution) -> MixturePosterior:
    """Return one density, with any prior."""
    flow = Flow.of([estimator_of(problems.npe_posterior("mdn"))])
    return MixturePosterior(flow, prior)


def test_posteriors_with_other_priors_are_not_averaged() -> None:
    narrow, wide = (
        single(BoxUniform(-side * torch.ones(2), side * torch.ones(2)))
        for side in (1.0, 5.0)
    )
    same = copy.deepcopy(narrow)
    assert average([narrow, same]).prior is not narrow.prior
    for members in ([narrow, wide], [wide, narrow]):
        with pytest.raises(InvalidInputError, match=r"posteriors\[1\]"):
            average(members)
