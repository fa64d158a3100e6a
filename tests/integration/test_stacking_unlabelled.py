"""A discrepancy that is learned from observations without labels, in a stack too."""

import pytest
import torch
from torch import Tensor
from torch.distributions import Independent, Normal

from sbi_rope import RoPE, stack
from sbi_rope.data.simulate import Moments
from sbi_rope.discrepancy.unlabelled import Marginal, fit_unlabelled
from sbi_rope.stacking import default_candidates
from sbi_rope.stacking.candidates import UnlabelledCandidate
from sbi_rope.utils.errors import InvalidInputError
from tests import gaussian
from tests.stacks import NPE, PRIOR, observed, rope_of, stacked

pytestmark = pytest.mark.filterwarnings(
    "ignore::sbi_rope.utils.errors.RoPEWarning", "ignore:Maximum number of epochs"
)
GAIN = torch.tensor([[0.8, 0.1], [0.0, 1.1]]).double()
OFFSET, ERROR_STD, NOISE_STD = torch.tensor([0.3, -0.2]).double(), 0.2, 0.1


def world(n: int) -> tuple[Tensor, Tensor]:
    """Means of simulations that are not normal, and real observations of them."""
    mean = torch.randn(n, 2).double()
    mean = torch.stack([mean[:, 0], 0.5 * mean[:, 1] + mean[:, 0].square() - 1], dim=1)
    simulated = mean + NOISE_STD * torch.randn(n, 2)
    return mean, simulated @ GAIN.T + OFFSET + ERROR_STD * torch.randn(n, 2)


def fit(z: Tensor, mean: Tensor, z_o: Tensor, weights: Tensor | None = None) -> list:
    noise = NOISE_STD**2 * torch.eye(2).double().expand(len(z), -1, -1)
    moments = Moments(means=mean[:, None], covariance=noise)
    weights = torch.ones(1, len(z)).double() if weights is None else weights
    simulated = world(3000)[0] + NOISE_STD * torch.randn(3000, 2)
    return fit_unlabelled(z, moments, weights, z_o, Marginal.of(simulated))


@pytest.mark.medium
def test_observations_without_labels_sharpen_what_six_labels_say() -> None:
    mean, z = world(6)
    _, z_o = world(200)
    truth = torch.cat([GAIN.flatten(), OFFSET])
    stds = []
    for some in (z_o[:0], z_o):
        [found] = fit(z, mean, some)
        draws = found.sample(2000, smallest_error=0.0, seed=0)
        drawn = torch.cat([draws.gain.flatten(1), draws.offset], dim=1)
        assert ((drawn.mean(dim=0) - truth).abs() < 3.5 * drawn.std(dim=0)).all()
        stds.append(drawn.std(dim=0))
        error = (draws.error_factor @ draws.error_factor.mT).mean(dim=0)
    assert (stds[1] < stds[0]).all()
    assert stds[1].mean() < 0.75 * stds[0].mean()
    assert error.diagonal().sqrt().numpy() == pytest.approx(ERROR_STD, rel=0.3)


@pytest.mark.medium
def test_versions_see_their_own_pairs_only_and_a_weight_is_as_many_pairs() -> None:
    mean, z = world(8)
    _, z_o = world(40)
    weights = torch.ones(2, 8).double()
    weights[0, 5:], weights[1, :2] = 0.0, 2.0
    state = torch.get_rng_state()
    both = fit(z, mean, z_o, weights)
    for version, rows in enumerate((list(range(5)), [0, 0, 1, 1, *range(2, 8)])):
        torch.set_rng_state(state)
        [alone] = fit(z[rows], mean[rows], z_o)
        assert torch.allclose(alone.mode, both[version].mode, atol=1e-3)


@pytest.mark.medium
def test_thirty_observations_bring_it_into_the_default_stack() -> None:
    rope, x_o = rope_of(), observed(30)
    plain = [candidate.name for candidate in default_candidates(rope)]
    made = stacked(rope, x_o)
    assert [c.name for c in default_candidates(rope, x_o)] == [*made.candidate_weights]
    assert [*made.candidate_weights] == [*plain, UnlabelledCandidate(x_o).name]
    # It answers any x.
    assert made.log_prob(torch.zeros(1, 2), x=observed(5)[4] + 0.1).isfinite()
    assert [c.name for c in default_candidates(rope, x_o[:29])] == plain
    with pytest.raises(InvalidInputError, match=r"\(120, 7\)"):
        stacked(rope, candidates=[UnlabelledCandidate(torch.zeros(120, 7))])
    with pytest.raises(InvalidInputError, match="NaN"):
        default_candidates(rope_of(), torch.full((120, 3), float("nan")))


@pytest.mark.slow
def test_with_the_prior_of_the_observations_it_is_almost_the_exact_posterior() -> None:
    torch.manual_seed(0)
    theta = gaussian.prior().sample((1020,))
    x = gaussian.simulator(theta) + 0.7 * torch.randn(1020, 2)
    rope = RoPE(gaussian.posterior(), simulator=gaussian.simulator)
    rope.append_calibration(theta[:20], x[:20])
    candidate = UnlabelledCandidate(x[20:])
    posterior = stack(
        rope, candidates=[PRIOR, NPE, candidate], seed=0, show_progress_bars=False
    )
    assert posterior.candidate_weights[candidate.name] > 0.6
    variance = gaussian.NOISE_STD**2 + 0.7**2
    std = torch.tensor((variance / (1 + variance)) ** 0.5)
    exact = Independent(Normal(x / (1 + variance), std), 1).log_prob(theta)
    found = posterior.candidate_log_probs(theta, x)[:, 2]
    assert float(found.mean()) > float(exact.mean()) - 0.1
