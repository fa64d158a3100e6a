"""Every estimator of sbi that RoPE works with can be split, tuned and mixed."""

import copy
import functools
import pickle
import warnings
from collections.abc import Iterable
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
from torch.distributions import Distribution

from sbi_rope import CalibrationFinetuner, MixturePosterior, RoPE, SinkhornCoupler
from sbi_rope.density import Coupled
from sbi_rope.npe.sbi import (
    VectorFieldDensity,
    embed,
    embedding_of,
    estimator_of,
    headless,
    posterior_from,
    with_embedding,
)
from sbi_rope.rope.finetuning import trainable_copy
from sbi_rope.utils.errors import (
    InvalidInputError,
    LogProbUnavailableError,
    UnsupportedPosteriorError,
)
from tests import problems

QUIET = {"show_progress_bars": False}

# Families of which sbi assembles the parts in a function each; those of zuko share one.
ASSEMBLED = ("mdn", "made", "maf", "maf_rqs", "nsf", "zuko_nsf")
# Of these flows thousands of draws take seconds.
SLOW = ("zuko_unaf", "zuko_naf", "zuko_bpf", "zuko_sospf")
ALL_FAMILIES = (*problems.FAMILIES, *problems.MIXED_FAMILIES)

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


@pytest.fixture
def npe(request: pytest.FixtureRequest) -> Any:
    """The posterior of an NPE, shared by the session: it must not change."""
    return problems.npe_posterior(*request.param)


@pytest.fixture
def estimator(npe: Any) -> Any:
    """The trained estimator itself."""
    return estimator_of(npe)


def batch_for(npe: Any, size: int = 6) -> tuple[Tensor, Tensor]:
    theta = npe.prior.sample((4 * size,)).reshape(4, size, -1)
    return theta, torch.randn(size, *estimator_of(npe).condition_shape)


def with_cases(
    *, embedding: str | None = None, families: Iterable[str] = ALL_FAMILIES
) -> Any:
    cases = [
        pytest.param(case, id="-".join(map(str, case)))
        for case in CASES
        if embedding in (None, case[1]) and case[0] in families
    ]
    return pytest.mark.parametrize("npe", cases, indirect=True)


def test_every_name_of_sbi_is_among_the_cases_or_refused() -> None:
    refused = {"tabpfn"}  # its posterior is filtered, see below
    tested = {family for family, *_ in CASES}
    assert set(factory.model_builders) == tested | refused


@pytest.mark.medium
@with_cases()
def test_on_embeddings_densities_and_samples_are_those_of_the_estimator(
    npe: Any, estimator: Any
) -> None:
    theta, x = batch_for(npe)
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


@with_cases(embedding="linear", families=(*ASSEMBLED, *problems.MIXED_FAMILIES))
def test_splitting_leaves_the_estimator_as_it_was(npe: Any, estimator: Any) -> None:
    state = copy.deepcopy(estimator.state_dict())
    modules = dict(estimator.named_modules(remove_duplicate=False))
    shape, embedding = estimator.condition_shape, embedding_of(estimator)
    for changed in (headless(estimator), with_embedding(estimator, nn.Identity())):
        assert isinstance(embedding_of(changed), nn.Identity)
    assert embedding_of(estimator) is embedding
    assert estimator.condition_shape == shape
    assert dict(estimator.named_modules(remove_duplicate=False)) == modules
    for name, value in estimator.state_dict().items():
        assert torch.equal(state[name], value)


@with_cases(embedding="linear", families=(*ASSEMBLED, *problems.MIXED_FAMILIES))
def test_a_tuned_embedding_in_its_place_changes_the_density_accordingly(
    npe: Any, estimator: Any
) -> None:
    theta, x = batch_for(npe)
    h, q = embedding_of(estimator), headless(estimator)
    g = trainable_copy(h, embed(h, x))
    with torch.no_grad():
        for parameter in g.parameters():
            parameter += 0.1
        swapped = with_embedding(estimator, g).log_prob(theta, x)
        assert torch.allclose(swapped, q.log_prob(theta, embed(g, x)), atol=1e-5)
        assert (swapped - estimator.log_prob(theta, x)).abs().max() > 1e-3


def test_with_embedding_shares_all_other_parameters() -> None:
    estimator = problems.npe_posterior("maf").posterior_estimator
    old = {id(p) for p in embedding_of(estimator).parameters()}
    density = {id(p) for p in estimator.parameters()} - old
    swapped = with_embedding(estimator, nn.Identity())
    assert {id(p) for p in swapped.parameters()} == density


@pytest.mark.parametrize("family", ["mdn", "made", "maf", "zuko_nsf", "mnpe"])
def test_what_was_made_headless_can_be_given_an_embedding(family: str) -> None:
    estimator = problems.npe_posterior(family).posterior_estimator
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


# --- repaired posteriors ---


@functools.cache
def repaired(family: str, embedding: str, dim: int) -> tuple[RoPE, MixturePosterior]:
    """Repair a posterior of the family once a session; for reading only."""
    npe = problems.npe_posterior(family, embedding, "independent", dim)
    simulate = problems.simulate_image if embedding == "cnn" else problems.simulate
    with torch.random.fork_rng():
        torch.manual_seed(2)
        theta = npe.prior.sample((30,))
        x = simulate(theta) + 0.2
        finetuner = CalibrationFinetuner(max_num_epochs=3)
        rope = RoPE(npe, simulator=simulate, finetuner=finetuner)
        rope.append_calibration(theta[:10], x[:10]).train(seed=0, **QUIET)
        return rope, rope.build_posterior(x[10:], num_simulations=8, seed=0)


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
    rope, posterior = repaired(family, embedding, dim)
    x_o, unnormalised = posterior.x_o, {"norm_posterior": False}
    samples = posterior.sample_batched((3,), x_o, **QUIET)
    assert samples.shape == (3, 20, *posterior.posterior_estimator.input_shape)
    assert within_support(npe.prior, samples).all()

    log_prob = posterior.log_prob_batched(samples, x_o, **unnormalised)
    assert log_prob.shape == (3, 20)
    assert torch.isfinite(log_prob).all()
    one = posterior.log_prob(samples[:, 4], x=x_o[4], **unnormalised)
    assert torch.allclose(one, log_prob[:, 4], atol=1e-4)
    # Parameters of other observations, far in the tails of most components.
    other = npe.prior.sample((20,))
    log_prob_of_other = posterior.log_prob_batched(other, x_o, **unnormalised)
    assert not log_prob_of_other.isnan().any()
    copied = pickle.loads(pickle.dumps(posterior))
    found = copied.log_prob_batched(other, x_o, **unnormalised)
    assert torch.equal(found, log_prob_of_other)
    # Of other families, thousands of draws for the mass inside the prior take seconds.
    if family not in SLOW:
        normalised = posterior.log_prob_batched(samples, x_o)
        assert (normalised >= log_prob - 1e-5).all()

    # The tuned posterior is the flow on the tuned embedding.
    tuned, g, h = rope.tuned_posterior(), rope.tuned_embedding_net, rope.npe.h
    assert type(tuned) is DirectPosterior
    assert not torch.equal(embed(g, x_o), embed(h, x_o))
    q = headless(npe.posterior_estimator)
    expected = q.log_prob(other[None], embed(g, x_o))[0]
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


@pytest.mark.medium
@pytest.mark.parametrize(
    "family",
    [
        pytest.param(family, marks=[pytest.mark.slow] if family in SLOW else [])
        for family in problems.FAMILIES
    ],
)
def test_densities_of_the_family_integrate_to_one_inside_the_prior(
    family: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The mass inside the prior is estimated from draws. Usually there are 1024, which
    # is an error of up to 0.03 here.
    monkeypatch.setattr("sbi_rope.density.base.NUM_DRAWS", 8192)
    posterior = repaired(family, "linear", 1)[1][0]
    edges = torch.linspace(-1, 1, 101)
    theta = (edges[1:] + edges[:-1])[:, None] / 2
    density = posterior.log_prob(theta).exp()
    assert float(density.sum() * 0.02) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize(
    "method", ["fmpe", pytest.param("npse", marks=pytest.mark.slow)]
)
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


@pytest.mark.parametrize(
    "method", ["fmpe", pytest.param("npse", marks=pytest.mark.slow)]
)
def test_the_samples_of_a_vector_field_are_those_of_sbi(method: str) -> None:
    original = problems.vector_field_posterior(method)
    estimator, x = estimator_of(original), torch.randn(4, 3)
    components = VectorFieldDensity(
        headless(estimator), original.prior, original.sample_with
    )
    torch.manual_seed(3)
    samples = components.sample(torch.Size((2,)), embed(embedding_of(estimator), x))
    torch.manual_seed(3)
    expected = posterior_from(original, estimator).sample_batched(
        (2,), x, show_progress_bars=False, reject_outside_prior=False
    )
    assert torch.allclose(samples, expected, atol=1e-4)


# --- refusals ---


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
    npe = NPE(density_estimator="mdn", show_progress_bars=False)
    npe.append_simulations(theta, problems.simulate(theta)).train(max_num_epochs=1)
    with pytest.raises(UnsupportedPosteriorError, match=r"build_posterior\(prior="):
        RoPE(npe.build_posterior(), simulator=problems.simulate)
    RoPE(npe.build_posterior(prior=problems.box(2)), simulator=problems.simulate)


# --- discrete parameters ---


def train_mnpe(prior: Distribution, theta: Tensor, **options: Any) -> MNPE:
    builder = posterior_nn("mnpe", hidden_features=16, **options)
    mnpe = MNPE(prior, density_estimator=builder, **QUIET)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mnpe.append_simulations(theta, problems.simulate(theta))
        mnpe.train(max_num_epochs=1)
    return mnpe


def mixed_mixture(npe: Any, *, n_o: int = 20) -> tuple[MixturePosterior, Tensor]:
    """A mixture of mixed densities, and the simulations behind it."""
    h = embedding_of(npe.posterior_estimator)
    x_s, x_o = (problems.simulate(npe.prior.sample((n,))) for n in (10, n_o))
    embeddings = embed(h, x_s)
    coupling = SinkhornCoupler(gamma=0.1, tau=0.9).couple(embed(h, x_o), embeddings)
    density = headless(copy.deepcopy(npe.posterior_estimator))
    coupled = Coupled(density, embeddings, x_o, h, coupling)
    coupled.tail_mass = 0.0
    return MixturePosterior(coupled, copy.deepcopy(npe.prior)), x_s


def with_categories(theta: Tensor, first: float, second: float) -> Tensor:
    """Append two discrete parameters to continuous ones."""
    return torch.cat([theta, torch.tensor([[first, second]]).expand(len(theta), 2)], 1)


@pytest.mark.medium
@pytest.mark.parametrize("dim", [1, 2])
def test_the_mixed_density_is_the_sum_over_all_simulations(dim: int) -> None:
    npe = problems.npe_posterior("mnpe", dim=dim)
    posterior, x_s = mixed_mixture(npe)
    theta = npe.prior.sample((100,)).reshape(5, 20, -1)
    with torch.no_grad():
        log_q = torch.stack(
            [npe.posterior_estimator.log_prob(theta, x[None]) for x in x_s], dim=-1
        )
    expected = torch.logsumexp(log_q + posterior.weights.log(), dim=-1).float()
    log_prob = posterior.log_prob_batched(theta, posterior.x_o, norm_posterior=False)
    assert torch.allclose(log_prob, expected, atol=1e-4)


@pytest.mark.medium
@pytest.mark.parametrize("missing", [0.0, 1.0, 2.0])
def test_what_was_never_trained_on_has_no_mass(missing: float) -> None:
    prior = problems.mixed_prior(1)
    theta = prior.sample((200,))
    theta = theta[theta[:, 1] != missing]
    posterior, _ = mixed_mixture(train_mnpe(prior, theta).build_posterior())
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
