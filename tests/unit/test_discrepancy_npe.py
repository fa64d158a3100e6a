"""NPE on corrected simulations as a method: what it takes, returns and refuses."""

from typing import Any
from unittest.mock import patch

import pytest
import torch
from sbi.inference import DirectPosterior, VectorFieldPosterior
from sbi.neural_nets import posterior_nn
from torch import Tensor, nn

from sbi_rope.data.pairs import Pairs
from sbi_rope.data.simulate import Moments
from sbi_rope.density import Flow
from sbi_rope.discrepancy import DiscrepancyModel
from sbi_rope.discrepancy.correction import correct_flow, fit_discrepancy
from sbi_rope.methods import DiscrepancyNPE, Training
from sbi_rope.npe.sbi import embedding_of, estimator_of
from sbi_rope.npe.standardisation import Standardisation
from sbi_rope.utils.errors import InvalidInputError, NotReadyError
from tests import problems

pytestmark = [
    pytest.mark.filterwarnings("ignore:Maximum number of epochs"),
    pytest.mark.filterwarnings("ignore:.*lie outside the prior support"),
    pytest.mark.filterwarnings("ignore:.*mixed neural density estimator"),
    pytest.mark.filterwarnings("ignore:Inferring num_categories"),
    pytest.mark.filterwarnings("ignore:Capping max_sampling_batch_size"),
]

SPACES = ["embedding", "input"]
SHORT = Training(training_batch_size=50, max_num_epochs=2)
SMALL: dict[str, Any] = {"num_simulations": 300, "num_steps": 4}
QUIET: dict[str, Any] = {"seed": 0, "show_progress_bars": False}


def labelled(n: int = 12) -> tuple[Tensor, Tensor]:
    theta = problems.box(2).sample((n,))
    return theta, 0.7 * problems.simulate(theta) + 0.4


def method(posterior: Any = None, **options: Any) -> DiscrepancyNPE:
    """One that starts from a trained NPE and has a simulator unless given others."""
    posterior = problems.npe_posterior() if posterior is None else posterior
    options = {"simulator": problems.simulate, **SMALL, **options}
    return DiscrepancyNPE.from_posterior(posterior, **options)


def trained(posterior: Any = None, **options: Any) -> DiscrepancyNPE:
    chosen = method(posterior, **options)
    return chosen.append_calibration(*labelled()).train(**QUIET)


def log_probs(posterior: Any, x: Tensor, theta: Tensor | None = None) -> Tensor:
    theta = torch.zeros(len(x), 2) if theta is None else theta
    return posterior.log_prob_batched(theta[None], x, norm_posterior=False)[0]


@pytest.mark.medium
@pytest.mark.filterwarnings("error::sbi_rope.utils.errors.RoPEWarning")
@pytest.mark.parametrize("space", SPACES)
def test_any_source_of_simulations_corrects_a_posterior_of_sbi(space: Any) -> None:
    x, stored = labelled(4)[1], problems.box(2).sample((300,))
    for made in (
        method(space=space),
        method(space=space, simulator=None).append_simulations(
            stored, problems.simulate(stored)
        ),
    ):
        made.append_calibration(*labelled()).train(**QUIET)
        posterior = made.build_posterior()
        assert isinstance(posterior, DirectPosterior)
        samples = posterior.sample_batched((7,), x, show_progress_bars=False)
        assert problems.box(2).support.check(samples).all()
        found = log_probs(posterior, x)
        assert not torch.equal(found, log_probs(problems.npe_posterior(), x))
        with pytest.raises(NotReadyError, match=r"Call `train\(\)` first"):
            _ = made.append_calibration(*labelled()).discrepancy


@pytest.mark.slow
def test_vector_fields_are_corrected_and_can_be_sampled() -> None:
    x = labelled(1)[1]
    for kind, space in (("fmpe", "embedding"), ("npse", "input")):
        posterior = problems.vector_field_posterior(kind)
        made = trained(posterior, space=space).build_posterior()
        assert isinstance(made, VectorFieldPosterior)
        samples = []
        for one in (made, posterior):
            torch.manual_seed(0)
            samples.append(one.sample((5,), x=x, show_progress_bars=False))
        assert not torch.equal(*samples)


@pytest.mark.medium
def test_mixed_parameters_keep_their_categories() -> None:
    posterior = problems.npe_posterior("mnpe")
    theta = posterior.prior.sample((12,))
    x = problems.simulate(theta)
    for space in SPACES:
        made = method(posterior, space=space)
        made.append_calibration(theta, 0.7 * x).train(**QUIET)
        samples = made.build_posterior().sample((50,), x=x[0], show_progress_bars=False)
        assert samples.shape == (50, 4), space
        assert set(samples[:, 2].tolist()) <= {0.0, 1.0, 2.0}, space
        assert set(samples[:, 3].tolist()) <= {0.0, 1.0}, space


def test_correcting_an_embedding_leaves_its_net_and_correcting_x_does_not() -> None:
    x = labelled(5)[1]
    before = estimator_of(problems.npe_posterior())
    for space, same in [("embedding", True), ("input", False)]:
        after = estimator_of(trained(space=space, num_steps=20).build_posterior())
        embedded = [embedding_of(e).eval()(x) for e in (before, after)]
        assert torch.equal(*embedded) is same, space


@pytest.mark.parametrize("space", SPACES)
def test_entries_that_are_constant_in_simulations_do_not_change_the_posterior(
    space: Any,
) -> None:
    """One reading is always 2 in simulations, and varies a lot in reality."""

    def constant(theta: Tensor) -> Tensor:
        x = problems.simulate(theta)
        return torch.cat([x, torch.full_like(x[:, :1], 2)], dim=1)

    builder = posterior_nn(
        "maf",
        z_score_x="none",
        hidden_features=10,
        num_transforms=1,
        embedding_net=nn.Linear(4, 3) if space == "input" else nn.Identity(),
    )
    options = {"npe_training": SHORT, "space": space, **SMALL}
    made = DiscrepancyNPE(problems.box(2), builder, **options)
    theta, x = labelled()
    x = torch.cat([x, 100 * torch.randn(12, 1)], dim=1)
    stored = problems.box(2).sample((300,))
    made.append_simulations(stored, constant(stored)).append_calibration(theta, x)
    posterior, other = made.train(**QUIET).build_posterior(), x.clone()
    other[:, 3] = -1e4
    expected = log_probs(posterior, x, theta)
    assert torch.equal(log_probs(posterior, other, theta), expected)


def test_only_simulations_with_a_probability_are_drawn() -> None:
    seen, losses = [], Flow.losses

    def recorded(self: Flow, theta: Tensor, x: Tensor) -> Tensor:
        seen.append((theta.flatten(0, 1), x.flatten(0, 1)))
        return losses(self, theta, x)

    theta = problems.box(2).sample((300,))
    x = problems.simulate(theta)
    probabilities = torch.zeros(300).index_fill(0, torch.tensor([7, 9]), 0.5)
    noise = torch.eye(3).double().expand(300, 3, 3)
    moments = Moments(means=x.double()[:, None], covariance=noise)
    right = DiscrepancyModel(probability_of_none=1.0)
    pairs, unit = Pairs.exact(theta, x), Standardisation(x.double())
    none = fit_discrepancy(pairs, x, moments, unit, right)
    estimator = estimator_of(problems.npe_posterior())
    with patch.object(Flow, "losses", recorded):
        correct_flow(
            estimator, (theta, x), [(none, probabilities)], space="input", num_steps=2
        )
    drawn, conditions = (torch.cat(parts) for parts in zip(*seen, strict=True))
    first = (drawn == theta[7]).all(dim=1)
    assert (first | (drawn == theta[9]).all(dim=1)).all()
    # Without a correction they are themselves, in the units of x.
    expected = x[7].expand(int(first.sum()), 3)
    assert torch.allclose(conditions[first], expected, atol=1e-5)


def test_pairs_that_cannot_be_corrected_are_refused() -> None:
    theta, x = labelled()
    flat = method(simulator=lambda theta: torch.ones(len(theta), 3), space="input")
    with pytest.raises(InvalidInputError, match="simulations that differ"):
        flat.append_calibration(theta, x).train(**QUIET)
    net = problems.npe_posterior(embedding="cnn")
    images = method(net, simulator=problems.simulate_image, space="input")
    images.append_calibration(theta, problems.simulate_image(theta))
    with pytest.raises(InvalidInputError, match="Use space='embedding'"):
        images.train(**QUIET)
