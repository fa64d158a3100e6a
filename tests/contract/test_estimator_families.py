"""Every estimator of sbi that RoPE works with can be split, tuned and mixed."""

import copy
import warnings
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from sbi_rope import CalibrationFinetuner, RoPE
from sbi_rope._sbi import (
    VectorFieldDensity,
    embed,
    embedding_of,
    estimator_of,
    headless,
    posterior_from,
    with_embedding,
)
from sbi_rope.errors import LogProbUnavailableError
from sbi_rope.finetuning import trainable_copy
from tests import problems

IDENTITY = "identity"

# Family, embedding net, z_score_x, dimension of theta.
CASES = [
    *[
        pytest.param(family, embedding, "independent", 2, id=f"{family}-{embedding}")
        for family in problems.FAMILIES
        for embedding in ("none", "linear")
    ],
    *[
        pytest.param(family, "none", "none", 2, id=f"{family}-{IDENTITY}")
        for family in problems.FAMILIES
    ],
    *[
        pytest.param(family, "linear", "none", 2, id=f"{family}-no z-score")
        for family in ("mdn", "maf", "zuko_nsf")
    ],
    *[
        pytest.param(family, "linear", "independent", 1, id=f"{family}-1d theta")
        for family in problems.FAMILIES
    ],
    *[
        pytest.param(family, "cnn", "independent", 2, id=f"{family}-image")
        for family in problems.FAMILIES
    ],
]


@pytest.fixture
def estimator(request: pytest.FixtureRequest) -> Any:
    """The trained estimator itself, shared by the session: it must not change."""
    return estimator_of(problems.npe_posterior(*request.param))


def batch_for(estimator: Any, size: int = 6) -> tuple[Tensor, Tensor]:
    theta = 2 * torch.rand(4, size, *estimator.input_shape) - 1
    return theta, torch.randn(size, *estimator.condition_shape)


def with_cases(*, embedding: str | None = None) -> Any:
    cases = [
        pytest.param(case.values, id=case.id)
        for case in CASES
        if embedding is None or case.values[1] == embedding
    ]
    return pytest.mark.parametrize("estimator", cases, indirect=True)


@with_cases()
def test_the_density_on_embeddings_is_that_of_the_estimator(estimator: Any) -> None:
    theta, x = batch_for(estimator)
    q, contexts = headless(estimator), embed(embedding_of(estimator), x)
    assert contexts.shape == (6, *q.condition_shape)
    assert contexts.std(dim=0).min() > 0, "the embedding ignores x"
    with torch.no_grad():
        difference = q.log_prob(theta, contexts) - estimator.log_prob(theta, x)
    assert difference.abs().max() == 0


@with_cases()
def test_the_samples_on_embeddings_are_those_of_the_estimator(estimator: Any) -> None:
    _, x = batch_for(estimator)
    q, contexts = headless(estimator), embed(embedding_of(estimator), x)
    with torch.no_grad():
        torch.manual_seed(3)
        expected = estimator.sample((5,), x)
        torch.manual_seed(3)
        samples = q.sample((5,), contexts)
    assert samples.shape == (5, 6, *estimator.input_shape)
    assert (samples - expected).abs().max() == 0


@with_cases()
def test_splitting_leaves_the_estimator_as_it_was(estimator: Any) -> None:
    state = copy.deepcopy(estimator.state_dict())
    modules = dict(estimator.named_modules(remove_duplicate=False))
    shape, embedding = estimator.condition_shape, embedding_of(estimator)

    q = headless(estimator)
    swapped = with_embedding(estimator, nn.Identity())

    assert embedding_of(estimator) is embedding
    assert estimator.condition_shape == shape
    after = dict(estimator.named_modules(remove_duplicate=False))
    assert after.keys() == modules.keys()
    assert all(after[name] is module for name, module in modules.items())
    assert estimator.state_dict().keys() == state.keys()
    assert all(torch.equal(estimator.state_dict()[k], v) for k, v in state.items())
    assert isinstance(embedding_of(q), nn.Identity)
    assert isinstance(embedding_of(swapped), nn.Identity)


@with_cases()
def test_a_tuned_embedding_in_its_place_changes_the_density_accordingly(
    estimator: Any,
) -> None:
    theta, x = batch_for(estimator)
    h, q = embedding_of(estimator), headless(estimator)
    g = trainable_copy(h, embed(h, x))
    with torch.no_grad():
        for parameter in g.parameters():
            parameter += 0.1
        swapped = with_embedding(estimator, g).log_prob(theta, x)
        assert torch.allclose(swapped, q.log_prob(theta, embed(g, x)), atol=1e-5)
        assert (swapped - estimator.log_prob(theta, x)).abs().max() > 1e-3


@with_cases(embedding="none")
def test_without_an_embedding_net_the_standardised_x_is_the_embedding(
    estimator: Any,
) -> None:
    h, (_, x) = embedding_of(estimator), batch_for(estimator)
    assert list(h.parameters()) == []
    # An affine map of each entry, the identity with z_score_x="none".
    shift = embed(h, torch.zeros(1, 3))
    scale = embed(h, torch.ones(1, 3)) - shift
    assert torch.allclose(embed(h, x), shift + scale * x, atol=1e-5)


@with_cases()
def test_tuning_starts_at_the_embedding_and_follows_shifted_targets(
    estimator: Any,
) -> None:
    h, (_, x) = embedding_of(estimator), batch_for(estimator, size=30)
    before = embed(h, x)
    start = trainable_copy(h, before)
    assert all(p.requires_grad for p in start.parameters())
    assert torch.equal(embed(start, x), before)

    targets = before + 0.5
    result = CalibrationFinetuner(num_steps=40, learning_rate=0.02).finetune(
        h, x, lambda count: targets, seed=0, show_progress_bars=False
    )
    history = result.history
    assert history.best_step > 0
    assert history.training_loss[0] == pytest.approx(0.5 * before.shape[1] ** 0.5)
    assert history.training_loss[history.best_step] < 0.8 * history.training_loss[0]
    assert torch.equal(embed(h, x), before), "tuning changed the embedding net itself"


@pytest.mark.parametrize(
    ("family", "embedding", "dim"),
    [
        *[(family, "linear", 2) for family in problems.FAMILIES],
        ("maf", "cnn", 2),
        ("zuko_nsf", "cnn", 2),
        ("maf", "none", 1),
        ("zuko_maf", "linear", 1),
    ],
)
def test_rope_repairs_posteriors_of_the_family(
    family: str, embedding: str, dim: int
) -> None:
    npe = problems.npe_posterior(family, embedding, "independent", dim)
    simulate = problems.simulate_image if embedding == "cnn" else problems.simulate
    theta = npe.prior.sample((30,))
    x = simulate(theta) + 0.2
    state = copy.deepcopy(npe.posterior_estimator.state_dict())

    rope = RoPE(npe, simulator=simulate, finetuner=CalibrationFinetuner(num_steps=3))
    rope.append_calibration(theta[:10], x[:10]).train(seed=0, show_progress_bars=False)
    posterior = rope.build_posterior(x[10:], num_simulations=25, seed=0)

    samples = posterior.sample_batched((3,), x[10:], show_progress_bars=False)
    assert samples.shape == (3, 20, dim)
    # The mass inside the prior takes draws, which this family makes one by one.
    norm = family != "zuko_unaf"
    log_prob = posterior.log_prob_batched(samples, x[10:], norm_posterior=norm)
    assert log_prob.shape == (3, 20)
    assert torch.isfinite(log_prob).all()
    one = posterior.log_prob(samples[:, 4], x=x[14], norm_posterior=norm)
    assert torch.allclose(one, log_prob[:, 4], atol=1e-4)
    after = npe.posterior_estimator.state_dict()
    assert all(torch.equal(after[key], value) for key, value in state.items())


@pytest.mark.parametrize("method", ["fmpe", "npse"])
def test_vector_fields_can_be_sampled_but_have_no_density(method: str) -> None:
    vector_field = problems.vector_field_posterior(method)
    theta = vector_field.prior.sample((20,))
    x = problems.simulate(theta)
    rope = RoPE(vector_field, simulator=problems.simulate)
    posterior = rope.build_posterior(x, num_simulations=25, seed=0)

    samples = posterior.sample_batched((2,), x, show_progress_bars=False)
    assert samples.shape == (2, 20, 2)
    assert (samples.abs() <= 1).all()
    assert posterior.sample((2, 3), x=x[0], show_progress_bars=False).shape == (2, 3, 2)
    for call in (
        lambda: posterior.log_prob(theta[:1], x=x[0]),
        lambda: posterior.log_prob_batched(theta, x),
        lambda: posterior.potential(theta[:1], x=x[0]),
    ):
        with pytest.raises(LogProbUnavailableError, match="FMPE and NPSE"):
            call()


@pytest.mark.parametrize("method", ["fmpe", "npse"])
def test_the_samples_of_a_vector_field_are_those_of_sbi(method: str) -> None:
    original = problems.vector_field_posterior(method)
    estimator, x = estimator_of(original), torch.randn(4, 3)
    components = VectorFieldDensity(
        headless(estimator), original.prior, original.sample_with
    )
    torch.manual_seed(3)
    samples = components.sample(torch.Size((2,)), embed(embedding_of(estimator), x))
    torch.manual_seed(3)
    # Made anew, because making one uses random numbers.
    expected = posterior_from(original, estimator).sample_batched(
        (2,), x, show_progress_bars=False, reject_outside_prior=False
    )
    assert torch.allclose(samples, expected, atol=1e-4)


def test_sampling_a_vector_field_does_not_warn_of_draws_it_will_reject() -> None:
    posterior = RoPE(
        problems.vector_field_posterior("npse"), simulator=problems.simulate
    ).build_posterior(torch.randn(20, 3), num_simulations=25, seed=0)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*outside the prior support")
        posterior.sample((50,), x=posterior.x_o[0], show_progress_bars=False)
