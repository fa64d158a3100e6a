"""Scores of candidates that no held-out label has touched."""

import copy
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from sbi_rope import CalibrationFinetuner, RoPE
from sbi_rope.errors import (
    InvalidInputError,
    NotReadyError,
)
from sbi_rope.stacking import (
    DensityCandidate,
    cross_validate,
    stack,
    stacking_weights,
)
from tests import problems
from tests.stacks import (
    COUPLINGS,
    FINETUNED,
    NPE,
    NUM_OBSERVED,
    NUM_PAIRS,
    OT_ONLY,
    QUIET,
    coupled_by_hand,
    observed,
    parameters,
    problem,
    quick_finetuned,
    same,
    stacked,
    the_rope,
    the_scores,
    trained,
    unnormalised,
    untrained,
    validate,
)

# Batches and calibration sets are small here on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::sbi_rope.errors.RoPEWarning")


def trained_state(estimator: Any) -> list[Tensor]:
    """All that scores a held-out pair: nets, components, batch and couplings."""
    couplings = estimator.coupled[0].couplings
    return [
        *estimator.state_dict().values(),
        *(coupling.potential for coupling in couplings),
        *(coupling.real for coupling in couplings),
    ]


def tuned_net(estimator: Any) -> nn.Module:
    return estimator.coupled[0].nets[0].net  # that of the first candidate


@pytest.mark.parametrize(
    ("num_pairs", "num_folds", "sizes"),
    [
        (20, 5, [4] * 5),
        (13, 5, [2, 2, 3, 3, 3]),
        (5, 5, [1] * 5),
        (4, 5, [1] * 4),
        (2, 5, [1, 1]),
        (9, 2, [4, 5]),
        (10, None, [1] * 10),
        (11, None, [2, 2, 2, 2, 3]),
    ],
)
def test_every_pair_is_held_out_once(
    num_pairs: int, num_folds: int | None, sizes: list[int]
) -> None:
    rope = untrained(num_pairs=num_pairs)
    seen: list[Tensor] = []

    def build(part: RoPE, seed: int) -> Any:
        seen.append(part.calibration[0])
        return part.npe

    spy = DensityCandidate(name="spy", build=build)
    scores = validate(rope, candidates=[OT_ONLY, spy], num_folds=num_folds)
    theta, x = rope.calibration
    assert torch.equal(scores.theta, theta)
    assert torch.equal(scores.x, x)
    assert sorted(scores.fold.bincount().tolist()) == sizes
    assert len(seen) == scores.num_folds == len(scores.estimators) == len(sizes)
    assert len(scores) == num_pairs
    # What is trained for a fold gets all pairs but those of the fold.
    for number, part in enumerate(seen):
        known = {tuple(row) for row in part.tolist()}
        others = {tuple(row) for row in theta[scores.fold != number].tolist()}
        assert known == others
        assert len(part) == len(known)


def test_folds_are_drawn_at_random() -> None:
    fold = the_scores().fold
    assert fold.tolist() != sorted(fold.tolist())
    other = validate(the_rope(), candidates=[OT_ONLY], seed=1).fold
    assert not torch.equal(other, fold)


def test_held_out_observations_are_coupled_together_with_the_batch() -> None:
    rope, scores, x_o = the_rope(), the_scores(), observed()
    for number, estimator in enumerate(scores.estimators):
        rows = scores.fold == number
        x = torch.cat([scores.x[rows], x_o])
        contexts = estimator.coupled[0].simulated
        alone = coupled_by_hand(OT_ONLY, rope, x, contexts)
        expected = unnormalised(alone, scores.theta[rows], scores.x[rows])[0]
        found = scores.scores_of(OT_ONLY.name)[rows]
        assert torch.allclose(found.float(), expected, atol=1e-3)
        assert len(estimator.coupled[0].batch) == int(rows.sum()) + NUM_OBSERVED


def test_scores_are_those_of_the_candidates_trained_without_the_fold() -> None:
    scores = the_scores()
    for number, estimator in enumerate(scores.estimators):
        rows = scores.fold == number
        theta, x = scores.theta[rows], scores.x[rows]
        expected = estimator.candidate_log_probs(theta, x)
        assert torch.allclose(scores.log_scores[rows], expected, atol=1e-5)
        # The tuned net of the fold stands behind the tuned candidates.
        alone = copy.deepcopy(the_rope())
        alone._g = tuned_net(estimator)
        coupled = estimator.coupled[0]
        for candidate in COUPLINGS[:2]:
            by_hand = coupled_by_hand(
                candidate, alone, coupled.batch, coupled.simulated
            )
            expected = unnormalised(by_hand, theta, x)[0].double()
            found = scores.scores_of(candidate.name)[rows]
            assert torch.allclose(found, expected, atol=1e-3)
        expected = unnormalised(alone.tuned_posterior(), theta, x)[0].double()
        assert torch.allclose(scores.scores_of("tuned")[rows], expected, atol=1e-4)


@pytest.mark.parametrize("number", range(5))
def test_shuffled_labels_of_a_fold_change_its_scores_and_nothing_behind_them(
    number: int,
) -> None:
    before = the_scores()
    rows = before.fold == number
    theta = before.theta.clone()
    theta[rows] = theta[rows].roll(1, dims=0)
    after = validate(untrained(pairs=(theta, before.x)))
    assert torch.equal(after.fold, before.fold)
    states = [
        (trained_state(a), trained_state(b))
        for a, b in zip(before.estimators, after.estimators, strict=True)
    ]
    assert same(*states[number])
    # Of the other folds the pairs do train the nets.
    assert not any(same(*state) for k, state in enumerate(states) if k != number)

    changed = before.log_scores != after.log_scores
    names = before.names
    assert changed[rows][:, [names.index("NPE"), names.index(OT_ONLY.name)]].all()
    assert changed[rows].any(dim=0).sum() == len(names) - 1  # all but the prior
    untouched = [k for k, name in enumerate(names) if name in ("NPE", OT_ONLY.name)]
    assert not changed[~rows][:, untouched].any()


def test_held_out_observations_train_nothing() -> None:
    before = the_scores()
    rows = before.fold == 1
    x = before.x.clone()
    x[rows] += 1.0
    after = validate(untrained(pairs=(before.theta, x)))
    nets = [
        (tuned_net(s.estimators[1]), s.estimators[1].parts[1:]) for s in (before, after)
    ]
    assert same(parameters(nets[0][0]), parameters(nets[1][0]))
    for part, other in zip(nets[0][1], nets[1][1], strict=True):
        assert same(parameters(part), parameters(other))
    # Unlabelled, they are coupled all the same.
    assert not same(
        trained_state(before.estimators[1]), trained_state(after.estimators[1])
    )


@pytest.mark.parametrize("resample", [False, True])
def test_labels_of_a_fold_reach_the_folds_that_train_on_it_only(
    resample: bool,
) -> None:
    finetuner = CalibrationFinetuner(
        num_steps=3, simulations_per_target=2, resample_targets=resample
    )
    options: dict[str, Any] = {
        "candidates": COUPLINGS[:1],
        "num_folds": 5,
        "num_training_folds": 2,
    }
    theta, x = problem(2, 10, seed=1)
    before = validate(untrained(pairs=(theta, x), finetuner=finetuner), **options)
    reached = []
    for number in range(5):
        other = theta.clone()
        other[before.fold == number] *= -1
        after = validate(untrained(pairs=(other, x), finetuner=finetuner), **options)
        changed = [
            not same(trained_state(a), trained_state(b))
            for a, b in zip(before.estimators, after.estimators, strict=True)
        ]
        assert not changed[number]
        assert sum(changed) == 2
        reached.append(changed)
    # Every fold is scored by what two others have trained.
    assert [sum(column) for column in zip(*reached, strict=True)] == [2] * 5
    assert before.num_trained_on == 4


def test_a_seed_reproduces_scores_and_leaves_no_trace() -> None:
    rope = the_rope()
    state = torch.random.get_rng_state()
    again = validate(rope)
    assert torch.equal(torch.random.get_rng_state(), state)
    assert torch.equal(again.log_scores, the_scores().log_scores)
    other = validate(rope, seed=1)
    assert not torch.equal(other.log_scores, again.log_scores)


def test_without_a_seed_the_states_of_torch_decide() -> None:
    draws = []
    for seed in (5, 5, 6):
        torch.manual_seed(seed)
        scores = validate(the_rope(), candidates=[OT_ONLY], seed=None)
        draws.append(scores.log_scores)
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])


def test_a_seed_reproduces_a_stack() -> None:
    candidates = (COUPLINGS[0], NPE, FINETUNED)
    theta, draws = problems.box(2).sample((NUM_OBSERVED,)), []
    for seed in (3, 3, 4):
        posterior = stacked(the_rope(), candidates=candidates, num_folds=2, seed=seed)
        draws.append(unnormalised(posterior, theta, posterior.x_o))
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])


@pytest.mark.parametrize("num_pairs", [5, 2])
def test_few_pairs_are_left_out_one_by_one(num_pairs: int) -> None:
    rope = trained(num_pairs=num_pairs)
    posterior = stacked(rope)
    scores = posterior.report.cross_validation
    assert scores.num_folds == num_pairs
    assert scores.log_scores.isfinite().all()
    assert scores.stack_scores.isfinite().all()
    assert sum(posterior.candidate_weights.values()) == pytest.approx(1.0)
    assert posterior.sample_batched((2,), posterior.x_o, **QUIET).shape == (2, 25, 2)


@pytest.mark.parametrize("num_pairs", [1, 0])
def test_too_few_pairs_are_refused(num_pairs: int) -> None:
    for call in (cross_validate, stack):
        with pytest.raises(NotReadyError, match="at least 2 calibration pairs"):
            call(untrained(num_pairs=num_pairs), observed(), **QUIET)


def test_a_stack_needs_a_trained_rope() -> None:
    with pytest.raises(NotReadyError, match=r"`train\(\)` first"):
        stacked(untrained())


def test_a_trainer_that_ignores_its_seed_is_reproduced_all_the_same() -> None:
    def build(rope: RoPE, seed: int) -> Any:
        return quick_finetuned(rope, int(torch.randint(1000, ())))

    candidate = DensityCandidate(name="careless", build=build)
    options: dict[str, Any] = {"candidates": [OT_ONLY, candidate], "num_folds": 2}
    first, second = (validate(the_rope(), **options).log_scores for _ in range(2))
    assert torch.equal(first, second)


def test_stored_simulations_serve_as_well() -> None:
    theta = problems.box(2).sample((300,))
    rope = trained(simulations=(theta, problems.simulate(theta)))
    posterior = stacked(rope, num_simulations=None)
    assert posterior.posterior_estimator.coupled[0].simulated.shape == (300, 4)
    assert posterior.report.cross_validation.log_scores.isfinite().all()


def test_a_stack_that_has_not_seen_the_fold_scores_its_pairs() -> None:
    scores = the_scores()
    for rows, posterior in scores.posteriors():
        others = torch.ones(len(scores), dtype=torch.bool)
        others[rows] = False
        assert (scores.fold[rows] == scores.fold[rows[0]]).all()
        weights = stacking_weights(scores.log_scores[others]).weights
        assert list(posterior.candidate_weights.values()) == weights.tolist()
        x = scores.x[rows]
        expected = torch.logsumexp(scores.log_scores[rows] + weights.log(), dim=1)
        expected = expected - posterior.leakage(x).mass.log()
        # Without the tail of weight 0.001 that the density leaves out.
        assert torch.allclose(scores.stack_scores[rows], expected, atol=0.01)


def test_levels_are_those_of_the_stacks_that_have_not_seen_the_pair() -> None:
    scores = the_scores()
    levels = scores.levels(num_samples=400)
    assert levels.shape == (NUM_PAIRS, 2)
    assert torch.equal(levels, scores.levels(num_samples=400))
    assert ((levels >= 0) & (levels <= 1)).all()
    for rows, posterior in scores.posteriors():
        samples = posterior.sample_batched((400,), scores.x[rows], **QUIET)
        below = (samples < scores.theta[rows]).double().mean(dim=0)
        expected = (2 * below - 1).abs()
        # Four standard errors of two independent sets of samples.
        assert torch.allclose(levels[rows].double(), expected, atol=0.3)


def test_differences_are_paired_and_their_interval_is_that_of_the_mean() -> None:
    scores = the_scores()
    names = scores.names
    for name, other in ((names[0], "NPE"), ("stack", "prior"), ("NPE", "NPE")):
        pairs = scores.scores_of(name) - scores.scores_of(other)
        found = scores.difference(name, other)
        assert found.mean == pytest.approx(float(pairs.mean()))
        error = float(pairs.std(correction=0)) / len(pairs) ** 0.5
        assert found.low == pytest.approx(found.mean - 1.96 * error, abs=0.5 * error)
        assert found.high == pytest.approx(found.mean + 1.96 * error, abs=0.5 * error)
        assert found == scores.difference(name, other)
        back = scores.difference(other, name)
        assert back.mean == pytest.approx(-found.mean)
    with pytest.raises(InvalidInputError, match="name"):
        scores.scores_of("nobody")


def test_rows_of_the_table_are_mean_error_and_weight_of_each_candidate() -> None:
    scores = the_scores()
    rows = scores.as_rows()
    assert [row["candidate"] for row in rows] == list(scores.names)
    assert [row["family"] for row in rows] == list(scores.families)
    for k, row in enumerate(rows):
        column = scores.log_scores[:, k]
        assert row["weight"] == float(scores.weights.weights[k])
        assert row["score"] == pytest.approx(float(column.mean()))
        error = float((column - column.mean()).square().sum() / (19 * 20)) ** 0.5
        assert row["standard_error"] == pytest.approx(error, abs=1e-12)
