"""RVNP as a candidate of a stack, which learns from observations without labels."""

import functools
from collections.abc import Iterator
from typing import Any
from unittest.mock import patch

import pytest
import torch
from torch import Tensor
from torch.distributions import Independent, Normal

from sbi_rope import RoPE, StackedPosterior, stack
from sbi_rope._random import seeded
from sbi_rope._sbi import estimator_of
from sbi_rope.baselines import RVNP, Training
from sbi_rope.baselines.rvnp import fit_surrogate
from sbi_rope.errors import InvalidInputError, RoPEWarning
from sbi_rope.stacking import RVNPCandidate, default_candidates
from tests import gaussian, problems
from tests.stacks import (
    BOX,
    NPE,
    NUM_PAIRS,
    PRIOR,
    data_of,
    observed,
    problem,
    rope_of,
    stacked,
)

pytestmark = pytest.mark.filterwarnings(
    "ignore::sbi_rope.errors.RoPEWarning", "ignore:Maximum number of epochs"
)
NUM_OBSERVATIONS, EXTRA_STD = 120, 0.7
SHORT = Training(training_batch_size=50, max_num_epochs=2)


@pytest.fixture(autouse=True)
def short(request: pytest.FixtureRequest) -> Iterator[None]:
    """Train RVNP for a few steps only, but in slow tests."""
    if request.node.get_closest_marker("slow"):
        yield
        return
    room = "sbi_rope.baselines.rvnp."

    def quickly(*data: Tensor, training: Training, **options: Any) -> Any:
        return fit_surrogate(*data, training=SHORT, **options)

    with (
        patch(room + "DEFAULT_TRAINING", SHORT),
        patch(room + "fit_surrogate", quickly),
    ):
        yield


def with_rvnp(**options: Any) -> list[Any]:
    x_o = observed(NUM_OBSERVATIONS)
    return [PRIOR, NPE, BOX, RVNPCandidate(x_o, **options)]


@functools.cache
def the_stack(**options: Any) -> StackedPosterior:
    """Return a stack with RVNP. Tests share it and must not change it."""
    with torch.random.fork_rng():
        return stacked(rope_of(), candidates=with_rvnp(**options))


def other_x() -> Tensor:
    return observed(5) + 0.1


@pytest.mark.medium
def test_it_is_rvnp_of_the_simulations_that_other_candidates_see() -> None:
    candidate = RVNPCandidate(observed(NUM_OBSERVATIONS), space="input")
    with patch("sbi_rope.stacking.data.NUM_SIMULATIONS", 300):
        data = data_of(rope_of())
        with seeded(7):
            [density] = candidate.fit(data, [data.without(0)])
        method = RVNP.from_posterior(data.npe, noise_on="input")
        method.append_simulations(*data.simulations)
    method.append_observations(candidate.x_o)
    with seeded(7):
        method.train(show_progress_bars=False)
    expected = estimator_of(method.build_posterior())
    theta, x = torch.zeros(1, 5, 2), other_x()
    found = density.log_prob(theta, x)
    torch.testing.assert_close(found, expected.log_prob(theta, x))
    assert not torch.allclose(found, data.estimator.log_prob(theta, x))


@pytest.mark.medium
def test_the_labels_of_the_pairs_change_its_weight_only() -> None:
    theta, x = rope_of().calibration
    other = rope_of((theta.flip(0), x))
    posteriors = the_stack(), stacked(other, candidates=with_rvnp())
    densities = [
        p.candidate_log_probs(torch.zeros(5, 2), other_x()) for p in posteriors
    ]
    names = list(the_stack().candidate_weights)
    assert names[3] == "RVNP"
    assert torch.equal(densities[0][:, 3], densities[1][:, 3])
    assert posteriors[0].candidate_weights != posteriors[1].candidate_weights


@pytest.mark.medium
def test_a_batch_of_a_hundred_observations_brings_it_into_the_default_stack() -> None:
    rope, x_o = rope_of(), observed(100)
    plain = [candidate.name for candidate in default_candidates(rope)]
    assert [candidate.name for candidate in default_candidates(rope, x_o)] == [
        *(*plain, "RVNP (input)"),
    ]
    with pytest.warns(RoPEWarning, match="adds no candidate"):
        assert [c.name for c in default_candidates(rope, x_o[:99])] == plain
    # Without an embedding net the embedding is the input.
    flat = rope_of(embedding="none")
    names = [candidate.name for candidate in default_candidates(flat, x_o)]
    assert names[-1] == "RVNP"
    made = stacked(rope, x_o)
    assert list(made.candidate_weights) == [*plain, "RVNP (input)"]
    # It answers any x, and is the stack of the candidates for this batch.
    same = stacked(rope, candidates=default_candidates(rope, x_o))
    assert torch.equal(
        *(p.log_prob(torch.zeros(1, 2), x=other_x()[0]) for p in (made, same))
    )


def test_what_would_take_hours_or_cannot_be_learned_is_left_out_with_a_warning() -> (
    None
):
    rope, x_o = rope_of(), observed(120)
    number = len(default_candidates(rope))
    room = "sbi_rope.stacking.candidates."
    with (
        patch(room + "MAX_STATISTICS", 2),
        pytest.warns(RoPEWarning, match="adds no candidate"),
    ):
        assert len(default_candidates(rope, x_o)) == number
    # An embedding that is the same in all simulations.
    theta = problems.box(2).sample((60,))
    same = RoPE(
        problems.npe_posterior("mdn", "none"), simulations=(theta, torch.ones(60, 3))
    )
    same.append_calibration(*problem(NUM_PAIRS, seed=1))
    number = len(default_candidates(same))
    with pytest.warns(RoPEWarning, match="adds no candidate"):
        assert len(default_candidates(same, x_o)) == number


@pytest.mark.parametrize(
    ("x_o", "match"),
    [
        (torch.zeros(120, 7), r"\(120, 7\)"),
        (torch.full((120, 3), float("nan")), "NaN"),
    ],
)
def test_wrong_observations_are_refused_before_anything_is_trained(
    x_o: Tensor, match: str
) -> None:
    with (
        patch.object(type(BOX), "fit", side_effect=AssertionError("was trained")),
        pytest.raises(InvalidInputError, match=match),
    ):
        stacked(rope_of(), candidates=[BOX, RVNPCandidate(x_o)])
    with pytest.raises(InvalidInputError, match=match):
        default_candidates(rope_of(), x_o)
    with pytest.raises(InvalidInputError, match="space"):
        RVNPCandidate(x_o, space="tuned")  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.parametrize("sign", [1, -1])
def test_labels_decide_what_it_is_worth(sign: int) -> None:
    # With the sign changed, the observations are distributed as before. Nothing can be
    # seen in them without labels, and RVNP is as wrong as NPE.
    torch.manual_seed(0)
    theta = gaussian.prior().sample((1040,))
    x = gaussian.simulator(sign * theta) + EXTRA_STD * torch.randn(1040, 2)
    rope = RoPE(gaussian.posterior(), simulator=gaussian.simulator)
    rope.append_calibration(theta[:40], x[:40])
    posterior = stack(
        rope,
        candidates=[PRIOR, NPE, RVNPCandidate(x[40:], space="input")],
        seed=0,
        show_progress_bars=False,
    )
    weight = posterior.report.family_weights["RVNP"]
    if sign < 0:
        assert weight < 0.05
        return
    assert weight > 0.8
    variance = gaussian.NOISE_STD**2 + EXTRA_STD**2
    std = torch.tensor((variance / (1 + variance)) ** 0.5)
    exact = Independent(Normal(x / (1 + variance), std), 1).log_prob(theta)
    found = posterior.log_prob_batched(theta[None], x, norm_posterior=False)[0]
    assert float(found.mean()) > float(exact.mean()) - 0.1
