"""NPE on corrected simulations as a method: what it takes, returns and refuses."""

import copy
import functools
import random
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from sbi.inference import DirectPosterior, VectorFieldPosterior
from sbi.neural_nets import posterior_nn
from torch import Tensor, nn

from sbi_rope import CalibrationFinetuner
from sbi_rope._sbi import embedding_of, estimator_of, with_embedding
from sbi_rope._simulations import StoredSimulations
from sbi_rope._simulator import Simulator
from sbi_rope._standardisation import Standardisation
from sbi_rope.baselines import Training
from sbi_rope.discrepancy import DiscrepancyModel, DiscrepancyNPE
from sbi_rope.discrepancy.posterior import DiscrepancyDraws
from sbi_rope.discrepancy.training import train_on_corrected
from sbi_rope.errors import (
    InvalidInputError,
    InvalidTypeError,
    NotReadyError,
    RoPEWarning,
    SimulationError,
    UnsupportedPosteriorError,
)
from sbi_rope.mixture import MixturePosterior
from tests import problems

pytestmark = [
    pytest.mark.filterwarnings("ignore:Maximum number of epochs"),
    pytest.mark.filterwarnings("ignore:.*lie outside the prior support"),
    pytest.mark.filterwarnings("ignore:.*mixed neural density estimator"),
    pytest.mark.filterwarnings("ignore:Inferring num_categories"),
    pytest.mark.filterwarnings("ignore:Capping max_sampling_batch_size"),
]

SPACES = ["embedding", "input", "tuned"]
SHORT = Training(training_batch_size=50, max_num_epochs=2)
SMALL: dict[str, Any] = {
    "num_simulations": 300,
    "num_steps": 4,
    "num_folds": 2,
    "finetuner": CalibrationFinetuner(max_num_epochs=3, rehearsal=1.0),
}
QUIET: dict[str, Any] = {"seed": 0, "show_progress_bars": False}


def simulations(n: int = 300) -> tuple[Tensor, Tensor]:
    theta = problems.box(2).sample((n,))
    return theta, problems.simulate(theta)


def labelled(n: int = 12) -> tuple[Tensor, Tensor]:
    theta = problems.box(2).sample((n,))
    return theta, 0.7 * problems.simulate(theta) + 0.4


def method(posterior: Any = None, **options: Any) -> DiscrepancyNPE:
    """One that starts from a trained NPE and has a simulator unless given others."""
    posterior = problems.npe_posterior() if posterior is None else posterior
    if "simulations" not in options:
        options = {"simulator": problems.simulate, **options}
    return DiscrepancyNPE.from_posterior(posterior, **SMALL | options)


def trained(posterior: Any = None, **options: Any) -> DiscrepancyNPE:
    chosen = method(posterior, **options)
    return chosen.append_calibration(*labelled()).train(**QUIET)


def log_probs(posterior: Any, n: int = 5) -> Tensor:
    with torch.random.fork_rng():
        torch.manual_seed(3)
        theta, x = simulations(n)
    return posterior.log_prob_batched(theta[None], x, norm_posterior=False)[0]


@functools.cache
def sources() -> dict[str, Callable[..., DiscrepancyNPE]]:
    """The ways to get simulations and an NPE."""

    def scratch(space: str) -> DiscrepancyNPE:
        builder = posterior_nn("maf", hidden_features=10, num_transforms=1)
        options = {"npe_training": SHORT, "space": space, **SMALL}
        made = DiscrepancyNPE(problems.box(2), builder, **options)
        return made.append_simulations(*simulations())

    return {
        "simulator": lambda space: method(space=space),
        "simulations": lambda space: method(space=space, simulations=simulations()),
        "both": lambda space: method(
            space=space, simulations=simulations(), simulator=problems.simulate
        ),
        "scratch": scratch,
    }


@pytest.mark.filterwarnings("error::sbi_rope.errors.RoPEWarning")
@pytest.mark.parametrize("source", ["simulator", "simulations", "both", "scratch"])
@pytest.mark.parametrize("space", SPACES)
def test_every_space_and_source_gives_a_posterior_of_sbi(
    space: str, source: str
) -> None:
    made = sources()[source](space)
    made.append_calibration(*labelled()).train(**QUIET)
    posterior = made.build_posterior()
    expected = MixturePosterior if space == "tuned" else DirectPosterior
    assert isinstance(posterior, expected)
    x = labelled(4)[1]
    samples = posterior.sample_batched((7,), x, show_progress_bars=False)
    assert samples.shape == (7, 4, 2)
    assert problems.box(2).support.check(samples).all()
    assert log_probs(posterior).isfinite().all()
    assert len(made.history.training_loss) == 1
    assert made.discrepancy.num_pairs == 12
    assert not torch.equal(log_probs(posterior), log_probs(problems.npe_posterior()))


@pytest.mark.parametrize("space", ["embedding", "input"])
@pytest.mark.parametrize("kind", ["fmpe", "npse"])
def test_vector_fields_are_corrected_and_can_be_sampled(kind: str, space: str) -> None:
    posterior = problems.vector_field_posterior(kind)
    made = trained(posterior, space=space).build_posterior()
    assert isinstance(made, VectorFieldPosterior)
    x = labelled(1)[1]
    samples = []
    for one in (made, posterior):
        torch.manual_seed(0)
        samples.append(one.sample((5,), x=x, show_progress_bars=False))
    assert samples[0].shape == (5, 2)
    assert not torch.equal(*samples)
    with pytest.raises(UnsupportedPosteriorError, match="space='embedding'"):
        trained(posterior, space="tuned")


@pytest.mark.parametrize("space", SPACES)
def test_mixed_parameters_keep_their_categories(space: str) -> None:
    posterior = problems.npe_posterior("mnpe")
    theta = posterior.prior.sample((12,))
    made = method(posterior, space=space)
    made.append_calibration(theta, 0.7 * problems.simulate(theta)).train(**QUIET)
    x = problems.simulate(theta)[0]
    samples = made.build_posterior().sample((50,), x=x, show_progress_bars=False)
    assert samples.shape == (50, 4)
    assert set(samples[:, 2].tolist()) <= {0.0, 1.0, 2.0}
    assert set(samples[:, 3].tolist()) <= {0.0, 1.0}


@pytest.mark.parametrize("space", ["embedding", "tuned"])
def test_images_are_corrected_behind_their_embedding(space: str) -> None:
    theta = problems.box(2).sample((12,))
    made = method(
        problems.npe_posterior(embedding="cnn"),
        simulator=problems.simulate_image,
        space=space,
    )
    made.append_calibration(theta, problems.simulate_image(theta)).train(**QUIET)
    x = problems.simulate_image(theta[:3])
    samples = made.build_posterior().sample_batched((4,), x, show_progress_bars=False)
    assert samples.shape == (4, 3, 2)


def states() -> tuple[Any, ...]:
    return torch.get_rng_state().tolist(), np.random.get_state()[1].tolist(), random.getstate()  # noqa: E501, NPY002  # fmt: skip


@pytest.mark.parametrize("space", SPACES)
def test_the_same_seed_gives_the_same_posterior_and_leaves_no_trace(
    space: str,
) -> None:
    pairs = labelled()
    densities = []
    for seed in (0, 0, 1):
        made = method(space=space, learn_prior=True).append_calibration(*pairs)
        before = states()
        made.train(seed=seed, show_progress_bars=False)
        assert states() == before
        densities.append(log_probs(made.build_posterior()))
        torch.rand(1)
    assert torch.equal(densities[0], densities[1])
    assert not torch.equal(densities[0], densities[2])


@pytest.mark.parametrize("space", SPACES)
def test_nothing_that_is_passed_in_is_changed(space: str) -> None:
    posterior = problems.npe_posterior()
    pairs, bank = labelled(), simulations()
    state = copy.deepcopy(posterior.posterior_estimator.state_dict())
    modes = [m.training for m in posterior.posterior_estimator.modules()]
    flags = [p.requires_grad for p in posterior.posterior_estimator.parameters()]
    copies = [tensor.clone() for tensor in (*pairs, *bank)]
    method(simulations=bank, space=space).append_calibration(*pairs).train(**QUIET)
    after = posterior.posterior_estimator
    assert all(torch.equal(a, b) for a, b in zip((*pairs, *bank), copies, strict=True))
    assert all(torch.equal(v, state[k]) for k, v in after.state_dict().items())
    assert [m.training for m in after.modules()] == modes
    assert [p.requires_grad for p in after.parameters()] == flags


@pytest.mark.parametrize("space", SPACES)
def test_training_again_starts_anew(space: str) -> None:
    made = trained(space=space)
    first = log_probs(made.build_posterior())
    assert torch.equal(log_probs(made.train(**QUIET).build_posterior()), first)


def test_only_the_density_is_trained_behind_an_embedding_and_all_of_npe_before_it() -> (
    None
):
    x = labelled(5)[1]
    before = estimator_of(problems.npe_posterior())
    for space, same in [("embedding", True), ("input", False)]:
        after = estimator_of(trained(space=space, num_steps=20).build_posterior())
        embedded = [embedding_of(e).eval()(x) for e in (before, after)]
        assert torch.equal(*embedded) is same, space


def test_discrepancy_and_history_are_those_of_the_last_training() -> None:
    made = method()
    with pytest.raises(NotReadyError, match=r"Call `train\(\)` first"):
        _ = made.discrepancy
    with pytest.raises(NotReadyError):
        _ = made.history
    made.append_calibration(*labelled()).train(**QUIET)
    assert made.discrepancy.num_pairs == 12
    made.append_calibration(*labelled(3))
    for ask in (lambda: made.discrepancy, made.build_posterior):
        with pytest.raises(NotReadyError, match=r"Call `train\(\)` first"):
            ask()
    assert made.train(**QUIET).discrepancy.num_pairs == 15
    assert len(method(num_steps=45).append_calibration(*labelled()).train(**QUIET)
               .history.training_loss) == 3  # fmt: skip


def test_what_is_learned_of_the_parameters_moves_the_posterior_there() -> None:
    theta = problems.box(2).sample((2000,))
    theta = theta[theta[:, 0] > 0.5][:100]
    x = problems.simulate(theta) + 3 * torch.randn(100, 3)  # that say next to nothing
    means = []
    for learn_prior in (False, True):
        made = method(learn_prior=learn_prior, num_steps=150, num_simulations=2000)
        made.append_calibration(theta, x).train(**QUIET)
        samples = made.build_posterior().sample_batched(
            (50,), x[:20], show_progress_bars=False
        )
        means.append(float(samples[..., 0].mean()))
    assert means[0] < 0.4
    assert 0.6 < means[1] < 0.9


@pytest.mark.parametrize("n", [2, 3])
@pytest.mark.parametrize("space", SPACES)
@pytest.mark.filterwarnings("ignore::sbi_rope.errors.RoPEWarning")
def test_two_pairs_are_enough(space: str, n: int) -> None:
    made = method(space=space).append_calibration(*labelled(n)).train(**QUIET)
    assert log_probs(made.build_posterior()).isfinite().all()


@pytest.mark.parametrize("space", SPACES)
def test_entries_that_are_constant_in_simulations_have_no_say(space: str) -> None:
    # One reading never moves in simulations; in reality it does, by a lot.
    def constant(theta: Tensor) -> Tensor:
        return torch.cat(
            [problems.simulate(theta), torch.full((len(theta), 1), 2.0)], 1
        )

    builder = posterior_nn(
        "maf", z_score_x="none", hidden_features=10, num_transforms=1
    )
    theta = problems.box(2).sample((300,))
    made = DiscrepancyNPE(
        problems.box(2),
        builder,
        simulator=constant,
        space=space,  # type: ignore[arg-type]
        npe_training=SHORT,
        **SMALL,
    )
    made.append_simulations(theta, constant(theta))
    theta, x = labelled()
    x = torch.cat([x, 100 * torch.randn(12, 1)], dim=1)
    posterior = made.append_calibration(theta, x).train(**QUIET).build_posterior()
    other = x.clone()
    other[:, 3] = -1e4
    if space == "tuned":  # whose nets see x whole; what they make of h's constants
        net = nn.Sequential(nn.Linear(4, 4), nn.ReLU())
        net[0].weight.data[3] = net[0].bias.data[3] = 0.0  # one unit is dead in h
        npe = estimator_of(made._trained_npe(show_progress_bars=False)[0])
        made = DiscrepancyNPE.from_posterior(
            DirectPosterior(with_embedding(npe, net), problems.box(2)),
            simulator=constant,
            space="tuned",
            **SMALL,
        )
        posterior = made.append_calibration(theta, x).train(**QUIET).build_posterior()
        part = posterior.posterior_estimator.parts[0]
        for g in part.mixing.nets:
            g[0][0].bias.data[3] = 1e3  # and alive in g
            assert (g(x)[:, 3] == 0).all()
        return
    densities = [
        posterior.log_prob_batched(theta[None], some, norm_posterior=False)
        for some in (x, other)
    ]
    assert torch.equal(*densities)


def test_simulations_in_which_nothing_varies_are_refused() -> None:
    flat = method(simulator=lambda theta: torch.ones(len(theta), 3), space="input")
    flat.append_calibration(*labelled())
    with pytest.raises(InvalidInputError, match="simulations that differ"):
        flat.train(**QUIET)


def identity_draws(width: int) -> DiscrepancyDraws:
    zeros = torch.zeros(1, width, width).double()
    return DiscrepancyDraws(
        gain=torch.eye(width).double()[None],
        offset=torch.zeros(1, width).double(),
        error_factor=zeros,
    )


class Exploding(nn.Module):
    """A density whose gradient is not a number every other time."""

    def __init__(self) -> None:
        super().__init__()
        self.bias = nn.Parameter(torch.zeros(2))
        self.count = 0

    def loss(self, theta: Tensor, condition: Tensor) -> Tensor:
        self.count += 1
        factor = torch.nan if self.count % 2 else 1.0
        return factor * (theta - self.bias).square().sum(dim=1)


def settle(density: nn.Module, **options: Any) -> Any:
    """Train on uncorrected simulations of parameters around five."""
    theta, x = simulations()
    settings: dict[str, Any] = {"num_steps": 40, "learning_rate": 0.1}
    return train_on_corrected(
        density,
        theta + 5.0,
        x,
        identity_draws(3),
        Standardisation(x.double()),
        probabilities=None,
        show_progress_bars=False,
        **settings | options,
    )


def test_a_gradient_that_is_not_finite_is_passed_over() -> None:
    density = Exploding()
    settle(density)
    assert (density.bias > 0.5).all()


class Slow(Exploding):
    def loss(self, theta: Tensor, condition: Tensor) -> Tensor:
        return (theta - self.bias).square().sum(dim=1)


def test_courses_are_added_until_one_changes_next_to_nothing() -> None:
    one, several = Slow(), Slow()
    assert len(settle(one).training_loss) == 2
    assert (one.bias < 3).all()
    history = settle(several, until_settled=True)
    assert 4 <= len(history.training_loss) < 24
    assert torch.allclose(several.bias, torch.full((2,), 5.0), atol=0.2)
    # From where it has settled one course is enough.
    assert len(settle(several, until_settled=True).training_loss) == 2


def test_only_simulations_with_a_probability_are_drawn() -> None:
    seen = []

    class Recording(Exploding):
        def loss(self, theta: Tensor, condition: Tensor) -> Tensor:
            seen.append((theta, condition))
            return (theta - self.bias).square().sum(dim=1)

    theta, x = simulations()
    probabilities = torch.zeros(300).index_fill(0, torch.tensor([7, 9]), 0.5)
    train_on_corrected(
        Recording(),
        theta,
        x,
        identity_draws(3),
        Standardisation(x.double()),
        probabilities=probabilities,
        num_steps=2,
        learning_rate=0.1,
        show_progress_bars=False,
    )
    drawn, conditions = (torch.cat(parts) for parts in zip(*seen, strict=True))
    first = (drawn == theta[7]).all(dim=1)
    assert (first | (drawn == theta[9]).all(dim=1)).all()
    assert 0.4 < float(first.double().mean()) < 0.6
    # Without a correction they are themselves, in the units of x.
    assert torch.allclose(
        conditions[first], x[7].expand(int(first.sum()), 3), atol=1e-5
    )


def test_the_number_of_draws_is_limited_where_each_is_large(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    counts = []

    class Counting(DiscrepancyModel):
        def fit(self, *arguments: Any) -> Any:
            discrepancy = super().fit(*arguments)
            sample = type(discrepancy).sample

            def counted(self: Any, count: int, **options: Any) -> Any:
                counts.append(count)
                return sample(self, count, **options)

            monkeypatch.setattr(type(discrepancy), "sample", counted)
            return discrepancy

    trained(model=Counting())
    monkeypatch.setattr("sbi_rope.discrepancy.correction.MAX_ENTRIES", 160)
    trained(model=Counting())
    assert counts[0] == 2000
    assert counts[-1] == 10  # an embedding of four entries


def simulator_of(function: Callable[[Tensor], Tensor]) -> Simulator:
    return Simulator(
        function, problems.box(1), event_shape=torch.Size((2,)), like=torch.zeros(1)
    )


MIXING = torch.tensor([[1.0, 0.6], [0.0, 0.8]])


def noisy(theta: Tensor) -> Tensor:
    """Curved in theta, with noise of covariance MIXING' MIXING / 4."""
    signal = torch.cat([3 * theta, theta.square()], dim=1)
    return signal + 0.5 * torch.randn(len(theta), 2) @ MIXING


def sometimes_nan(theta: Tensor) -> Tensor:
    x = noisy(theta)
    x[torch.rand(len(x)) < 0.3, 1] = torch.nan
    return x


@pytest.mark.filterwarnings("ignore:Dropped")
@pytest.mark.parametrize("function", [noisy, sometimes_nan])
def test_moments_of_a_simulator_are_those_of_finite_simulations(
    function: Callable[[Tensor], Tensor],
) -> None:
    theta = torch.tensor([[-0.5], [0.8]])
    moments = simulator_of(function).moments(theta, 20_000, lambda x: x, progress=False)
    signal = torch.cat([3 * theta, theta.square()], dim=1).double()
    expected = 0.25 * (MIXING.T @ MIXING).double()
    assert torch.allclose(moments.mean, signal, atol=0.02)
    assert torch.allclose(moments.covariance, expected.expand(2, 2, 2), atol=0.02)
    assert torch.equal(moments[torch.tensor([1])].mean, moments.mean[1:])
    assert moments.columns(slice(1, 2)).covariance.shape == (2, 1, 1)
    single = simulator_of(noisy).moments(theta, 1, lambda x: x, progress=False)
    assert (single.covariance == 0).all()


def test_a_simulator_may_change_what_it_is_given_and_reuse_its_memory() -> None:
    def in_place(theta: Tensor) -> Tensor:
        theta *= 2
        return theta.expand(-1, 2) + 0.01 * torch.randn(len(theta), 2)

    theta, x = simulator_of(in_place).kept(500, progress=False)
    assert (theta.abs() <= 1).all()
    assert torch.allclose(x, 2 * theta.expand(-1, 2), atol=0.1)
    memory = torch.zeros(2)

    def one_at_a_time(theta: Tensor) -> Tensor:
        memory[:] = float(theta)
        return memory

    theta, x = simulator_of(one_at_a_time).kept(50, progress=False)
    assert torch.equal(x, theta.expand(-1, 2))


def test_stored_simulations_are_handed_out_in_no_order() -> None:
    theta = torch.linspace(-1, 1, 1000)[:, None]
    stored = StoredSimulations(
        (theta, noisy(theta)),
        problems.box(1),
        theta_shape=torch.Size((1,)),
        event_shape=torch.Size((2,)),
        like=theta,
    )
    kept, _ = stored.kept(20_000, progress=False)
    assert torch.equal(kept.sort(dim=0).values, theta)
    assert abs(float(kept[:100].mean())) < 0.3


@pytest.mark.filterwarnings("ignore:Dropped")
def test_a_pair_without_any_finite_simulation_is_named() -> None:
    def failing(theta: Tensor) -> Tensor:
        return noisy(theta) / (theta < 0.5)

    theta = torch.tensor([[0.0], [0.9]])
    with pytest.raises(SimulationError, match=r"parameters \[\[0\.89.*1 pairs"):
        simulator_of(failing).moments(theta, 10, lambda x: x, progress=False)


@pytest.mark.parametrize("centre", [0.0, 1e4])
def test_moments_of_stored_simulations_follow_the_slope_around_a_parameter(
    centre: float,
) -> None:
    # A slope of 3: averaging around the edge of the box would miss its height.
    theta = 2 * torch.rand(20_000, 1) - 1
    stored = StoredSimulations(
        (theta + centre, noisy(theta)),
        problems.box(1, centre - 1, centre + 1),
        theta_shape=torch.Size((1,)),
        event_shape=torch.Size((2,)),
        like=theta,
    )
    at = torch.tensor([[-1.0], [0.3], [0.999]])
    moments = stored.moments(at + centre, 10, lambda x: x, progress=False)
    signal = torch.cat([3 * at, at.square()], dim=1).double()
    # Fifty are around; at an edge the height is as uncertain as of twelve.
    assert torch.allclose(moments.mean, signal, atol=0.45)
    expected = 0.25 * (MIXING.T @ MIXING).double()
    assert torch.allclose(moments.covariance.mean(dim=0), expected, atol=0.12)
    targets = stored.targets(
        at + centre,
        lambda x: x,
        simulations_per_target=1,
        num_neighbors=50,
        progress=False,
    )
    assert torch.allclose(targets[1].double(), signal[1], atol=0.3)


def test_few_stored_simulations_take_the_slope_of_all() -> None:
    theta = torch.tensor([[-1.0, 0.0], [0.0, 1.0], [1.0, 0.5], [0.2, -0.7]])
    x = theta @ torch.tensor([[2.0], [1.0]]) + 0.5
    stored = StoredSimulations(
        (theta, x),
        problems.box(2, -2, 2),
        theta_shape=torch.Size((2,)),
        event_shape=torch.Size((1,)),
        like=theta,
    )
    at = torch.tensor([[0.1, 0.1], [1.5, -1.5]])
    moments = stored.moments(at, 10, lambda x: x, progress=False)
    expected = (at @ torch.tensor([[2.0], [1.0]]) + 0.5).double()
    assert torch.allclose(moments.mean, expected, atol=1e-4)
    assert moments.covariance.abs().max() < 1e-6


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        pytest.param({"space": "output"}, InvalidInputError, "`space`", id="space"),
        pytest.param({"learn_prior": 1}, InvalidTypeError, "`learn_prior`", id="learn"),
        pytest.param({"model": "linear"}, InvalidTypeError, "`model`", id="model"),
        pytest.param(
            {"num_simulations": 1}, InvalidInputError, "`num_simulations`", id="number"
        ),
        pytest.param(
            {"simulations_per_pair": 1},
            InvalidInputError,
            "`simulations_per_pair`",
            id="per pair",
        ),
        pytest.param({"num_steps": 0}, InvalidInputError, "`num_steps`", id="steps"),
        pytest.param(
            {"learning_rate": -1.0}, InvalidInputError, "`learning_rate`", id="rate"
        ),
        pytest.param({"num_folds": 1}, InvalidInputError, "`num_folds`", id="folds"),
        pytest.param(
            {"finetuner": "adam"}, InvalidTypeError, "`finetuner`", id="finetuner"
        ),
    ],
)
def test_options_outside_their_range_are_refused(
    options: dict[str, Any], error: type, match: str
) -> None:
    with pytest.raises(error, match=match):
        DiscrepancyNPE(problems.box(2), **options)


def test_a_simulator_that_cannot_be_called_is_refused() -> None:
    with pytest.raises(InvalidTypeError, match="`simulator` to be callable"):
        trained(simulator="simulate")


def test_what_is_missing_is_asked_for() -> None:
    with pytest.raises(NotReadyError, match="append_calibration"):
        method().train(**QUIET)
    with pytest.raises(NotReadyError, match="at least 2 calibration pairs; got 1"):
        method().append_calibration(*labelled(1)).train(**QUIET)
    without = DiscrepancyNPE.from_posterior(problems.npe_posterior(), **SMALL)
    with pytest.raises(NotReadyError, match="append_simulations"):
        without.append_calibration(*labelled()).train(**QUIET)


def test_images_cannot_be_corrected_themselves() -> None:
    theta = problems.box(2).sample((12,))
    made = method(
        problems.npe_posterior(embedding="cnn"),
        simulator=problems.simulate_image,
        space="input",
    )
    made.append_calibration(theta, problems.simulate_image(theta))
    with pytest.raises(InvalidInputError, match=r"\(n, 1, 8, 8\). Use space='embed"):
        made.train(**QUIET)


def test_pairs_of_one_parameter_leave_nothing_to_hold_out_of_a_tuning() -> None:
    theta, x = labelled()
    made = method(space="tuned").append_calibration(theta[:1].expand(12, 2), x)
    with pytest.raises(InvalidInputError, match="all 12 have the same"):
        made.train(**QUIET)


def test_simulations_beside_a_simulator_are_trained_on_without_a_warning() -> None:
    made = method()
    assert not made.needs_simulations
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "sbi_rope.discrepancy.npe.correct_npe",
            lambda estimator, simulations, *rest, **options: pytest.fail(
                f"trained on {len(simulations[0])}"
            ),
        )
        made.append_simulations(*simulations(77)).append_calibration(*labelled())
        with pytest.raises(pytest.fail.Exception, match="trained on 77"):
            made.train(**QUIET)


def test_dropped_simulations_are_said() -> None:
    theta, x = simulations()
    x[:3] = torch.nan
    with pytest.warns(RoPEWarning, match="Dropped 3 of 300"):
        method(simulations=(theta, x))
