"""Every estimator of sbi that RoPE works with can be split, tuned and mixed."""

import copy
import pickle
from typing import Any

import pytest
import torch
from sbi.inference import (
    MNPE,
    NPE,
    DirectPosterior,
    EnsemblePosterior,
    MCMCPosterior,
)
from sbi.inference.posteriors import NPE_A_Posterior
from sbi.inference.posteriors.filtered_direct_posterior import FilteredDirectPosterior
from sbi.neural_nets import factory, posterior_nn
from sbi.utils import within_support
from torch import Tensor, nn

from sbi_rope import CalibrationFinetuner, RoPE
from sbi_rope.npe.sbi import (
    VectorFieldDensity,
    embed,
    embedding_of,
    estimator_of,
    headless,
    posterior_from,
)
from sbi_rope.utils.errors import (
    InvalidInputError,
    LogProbUnavailableError,
    UnsupportedPosteriorError,
)
from tests import problems

QUIET = {"show_progress_bars": False}

# Families of which sbi assembles the parts in a function each; those of zuko share one.
ASSEMBLED = ("mdn", "made", "maf", "maf_rqs", "nsf", "zuko_nsf")

# Family, embedding net, z_score_x, number of continuous parameters. All families have
# x with and without a network, and one parameter, where some are built differently.
# How x gets to the flow without standardisation, or as an image, is up to the assembly.
CASES = [
    *((family, "linear", "independent", 2) for family in problems.FAMILIES),
    *((family, "none", "independent", 1) for family in problems.FAMILIES),
    *((family, "none", "none", 2) for family in ASSEMBLED),
    *((family, "linear", "none", 2) for family in ("mdn", "maf", "zuko_nsf")),
    *((family, "cnn", "independent", 2) for family in ASSEMBLED),
    ("mnpe", "none", "independent", 1),
    ("mnpe", "linear", "independent", 1),
    ("mnpe", "none", "none", 1),
    ("mnpe", "linear", "none", 1),
    ("mnpe", "cnn", "independent", 1),
    ("mnle", "linear", "independent", 1),
]


def test_every_name_of_sbi_is_among_the_cases_or_refused() -> None:
    refused = {"tabpfn"}  # its posterior is filtered, see below
    tested = {family for family, *_ in CASES}
    assert set(factory.model_builders) == tested | refused


@pytest.mark.medium
@pytest.mark.parametrize("case", CASES, ids=lambda case: "-".join(map(str, case)))
def test_on_embeddings_densities_and_samples_are_those_of_the_estimator(
    case: tuple[Any, ...],
) -> None:
    npe = problems.npe_posterior(*case)
    estimator, theta = estimator_of(npe), npe.prior.sample((24,)).reshape(4, 6, -1)
    x = torch.randn(6, *estimator.condition_shape)
    q, embeddings = headless(estimator), embed(embedding_of(estimator), x)
    assert embeddings.shape == (6, *q.condition_shape)
    assert embeddings.std(dim=0).min() > 0, "the embedding ignores x"
    with torch.no_grad():
        difference = q.log_prob(theta, embeddings) - estimator.log_prob(theta, x)
        torch.manual_seed(3)
        expected = estimator.sample((5,), x)
        torch.manual_seed(3)
        samples = q.sample((5,), embeddings)
    assert difference.abs().max() == 0
    assert samples.shape == (5, 6, *estimator.input_shape)
    assert (samples - expected).abs().max() == 0


def test_embed_does_not_depend_on_the_batch() -> None:
    net = nn.Sequential(nn.Linear(3, 4), nn.BatchNorm1d(4), nn.Dropout(0.5)).train()
    x = torch.randn(10, 3)
    whole = embed(net, x)
    assert torch.allclose(embed(net, x, batch_size=3), whole, atol=1e-6)
    assert torch.allclose(embed(net, x[4:5]), whole[4:5], atol=1e-6)
    assert not whole.requires_grad


@pytest.mark.medium
@pytest.mark.parametrize(
    ("family", "embedding", "dim"),
    [
        *[(family, "linear", 2) for family in problems.FAMILIES],
        *[(family, "linear", 1) for family in problems.MIXED_FAMILIES],
        ("maf", "cnn", 2),
        ("zuko_nsf", "cnn", 2),
        ("mnpe", "cnn", 1),
        ("mnpe", "none", 1),
    ],
)
def test_rope_makes_of_posteriors_of_the_family_others_that_can_be_pickled(
    family: str, embedding: str, dim: int
) -> None:
    npe = problems.npe_posterior(family, embedding, "independent", dim)
    before = copy.deepcopy(npe.posterior_estimator.state_dict())
    simulate = problems.simulate_image if embedding == "cnn" else problems.simulate
    theta = npe.prior.sample((30,))
    x, x_o = (simulate(theta) + 1.0).split([10, 20])
    finetuner = CalibrationFinetuner(max_num_epochs=3)
    rope = RoPE(npe, simulator=simulate, finetuner=finetuner)
    rope.append_calibration(theta[:10], x).train(seed=0, **QUIET)
    posterior = rope.build_posterior(x_o, num_simulations=8, seed=0)
    unnormalised = {"norm_posterior": False}
    samples = posterior.sample_batched((3,), x_o, **QUIET)
    assert samples.shape == (3, 20, *posterior.posterior_estimator.input_shape)
    assert within_support(npe.prior, samples).all()

    log_prob = posterior.log_prob_batched(samples, x_o, **unnormalised)
    assert log_prob.shape == (3, 20)
    assert torch.isfinite(log_prob).all()
    # Parameters of other observations, far in the tails of most components.
    other = npe.prior.sample((20,))
    log_prob_of_other = posterior.log_prob_batched(other, x_o, **unnormalised)
    assert not log_prob_of_other.isnan().any()
    copied = pickle.loads(pickle.dumps(posterior))
    found = copied.log_prob_batched(other, x_o, **unnormalised)
    assert torch.equal(found, log_prob_of_other)
    # The tuned posterior is the flow on the tuned embedding.
    tuned, g, h = rope.tuned_posterior(), rope.tuned_embedding_net, rope.npe.h
    assert type(tuned) is DirectPosterior
    assert not torch.equal(embed(g, x_o), embed(h, x_o))
    expected = headless(npe.posterior_estimator).log_prob(other[None], embed(g, x_o))[0]
    found = tuned.log_prob_batched(other, x_o, **unnormalised)[0]
    usable = torch.isfinite(expected)
    assert torch.allclose(found[usable], expected[usable], atol=1e-4)

    # The posterior that was repaired is left as it was, and shares nothing.
    after = npe.posterior_estimator
    assert after.state_dict().keys() == before.keys()
    assert all(torch.equal(v, before[k]) for k, v in after.state_dict().items())
    assert all(p.requires_grad for p in after.parameters())
    ours = {id(p) for p in posterior.posterior_estimator.parameters()}
    assert not ours & {id(p) for p in after.parameters()}


@pytest.mark.parametrize(
    "method", ["fmpe", pytest.param("npse", marks=pytest.mark.slow)]
)
def test_vector_fields_can_be_sampled_but_have_no_density(method: str) -> None:
    vector_field = problems.vector_field_posterior(method)
    theta = vector_field.prior.sample((20,))
    x = problems.simulate(theta)
    rope = RoPE(vector_field, simulator=problems.simulate)
    posterior = rope.build_posterior(x, num_simulations=25, seed=0)

    samples = posterior.sample_batched((2,), x, **QUIET)
    assert samples.shape == (2, 20, 2)
    assert (samples.abs() <= 1).all()
    with pytest.raises(LogProbUnavailableError, match="FMPE and NPSE"):
        posterior.log_prob_batched(theta, x)
    # Those of its components are those of sbi.
    estimator, how = estimator_of(vector_field), vector_field.sample_with
    components = VectorFieldDensity(headless(estimator), vector_field.prior, how)
    torch.manual_seed(3)
    samples = components.sample(torch.Size((2,)), embed(embedding_of(estimator), x))
    torch.manual_seed(3)
    expected = posterior_from(vector_field, estimator).sample_batched(
        (2,), x, **QUIET, reject_outside_prior=False
    )
    assert torch.allclose(samples, expected, atol=1e-4)


def test_what_has_no_amortised_estimator_is_refused_by_name() -> None:
    for posterior in (
        # Without state, which is enough for a check that looks at the type.
        MCMCPosterior.__new__(MCMCPosterior),
        NPE_A_Posterior.__new__(NPE_A_Posterior),
        FilteredDirectPosterior.__new__(FilteredDirectPosterior),
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
    npe = NPE(density_estimator="mdn", **QUIET)
    npe.append_simulations(theta, problems.simulate(theta)).train(max_num_epochs=1)
    with pytest.raises(UnsupportedPosteriorError, match=r"build_posterior\(prior="):
        RoPE(npe.build_posterior(), simulator=problems.simulate)
    RoPE(npe.build_posterior(prior=problems.box(2)), simulator=problems.simulate)


def with_categories(theta: Tensor, first: float, second: float) -> Tensor:
    """Append two discrete parameters to continuous ones."""
    return torch.cat([theta, torch.tensor([[first, second]]).expand(len(theta), 2)], 1)


@pytest.mark.medium
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("missing", [0.0, 1.0, 2.0])
def test_what_was_never_trained_on_has_no_mass(missing: float) -> None:
    prior = problems.mixed_prior(1)
    theta = prior.sample((200,))
    theta = theta[theta[:, 1] != missing]
    x = problems.simulate(theta)
    mnpe = MNPE(prior, posterior_nn("mnpe", hidden_features=16), **QUIET)
    mnpe.append_simulations(theta, x).train(max_num_epochs=1)
    rope = RoPE(mnpe.build_posterior(), simulator=problems.simulate)
    posterior = rope.build_posterior(x[:20], num_simulations=20, seed=0)
    posterior.posterior_estimator.tail_mass = 0.0
    for value in (-1.0, 0.0, 0.5, 1.0, 2.0, 3.0):
        log_prob = posterior.log_prob_batched(
            with_categories(torch.zeros(20, 1), value, 0.0), posterior.x_o
        )
        has_none = value == missing or value not in (0.0, 1.0, 2.0)
        assert ((log_prob == -torch.inf) == has_none).all()


def test_calibration_parameters_between_categories_are_refused() -> None:
    rope = RoPE(problems.npe_posterior("mnpe", dim=1), simulator=problems.simulate)
    theta = with_categories(torch.zeros(10, 1), 1.0, 0.0)
    x = problems.simulate(theta)
    theta[3, 2] = 0.5
    with pytest.raises(InvalidInputError, match=r"1 of 10 rows .*\[3\]"):
        rope.append_calibration(theta, x)
