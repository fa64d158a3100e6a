"""Scores of candidates do not depend on the labels that they are scored by."""

import functools
import math
from typing import Any, ClassVar
from unittest.mock import patch

import pytest
import torch
from torch import Tensor, nn

from sbi_rope import CalibrationFinetuner, RoPE
from sbi_rope._groups import groups_of
from sbi_rope._sbi import embed, embedding_of, estimator_of
from sbi_rope.discrepancy.training import ONE_COURSE
from sbi_rope.metrics import acauc_of
from sbi_rope.mixture import MixtureEstimator, MixturePosterior, part_of
from sbi_rope.stacking import (
    Candidate,
    CrossValidation,
    DensityCandidate,
    FinetunedCandidate,
    RehearsedCandidate,
    StackedPosterior,
    stacking_weights,
    workbench,
)
from sbi_rope.stacking import candidates as stack_candidates
from sbi_rope.stacking.finetuning import BATCH_SIZE, finetune_without
from sbi_rope.stacking.workbench import Fold, Workbench
from tests import problems
from tests.stacks import (
    CANDIDATES,
    FINETUNED,
    FITTED,
    NUM_PAIRS,
    PRIOR,
    QUIET,
    finetuned,
    observed,
    problem,
    quick,
    rope_of,
    stacked,
    the_stack,
    validated,
)

# Batches and calibration sets are small here on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::sbi_rope.errors.RoPEWarning")

UNTRAINED = {"prior", "NPE"}


def scores_of(posterior: StackedPosterior) -> CrossValidation:
    return posterior.report.cross_validation


# --- folds ---


@pytest.mark.medium
def test_every_pair_is_held_out_once_and_trains_all_other_folds() -> None:
    seen: list[Tensor] = []

    def build(rope: RoPE, seed: int) -> Any:
        seen.append(rope.calibration[0])
        return rope.npe

    spy = DensityCandidate(name="spy", build=build)
    # By default there are five folds, and never more folds than pairs.
    for num_pairs, num_folds, sizes in (
        (13, None, [2, 2, 3, 3, 3]),
        (4, 5, [1] * 4),
        (9, 2, [4, 5]),
    ):
        seen.clear()
        pairs = problem(num_pairs, seed=1)
        scores = validated(rope_of(pairs), candidates=[spy], num_folds=num_folds)
        assert sorted(scores.fold.bincount().tolist()) == sizes
        assert scores.fold.tolist() != sorted(scores.fold.tolist())
        for number, part in enumerate(seen):
            expected = pairs[0][scores.fold != number]
            assert {*map(tuple, part.tolist())} == {*map(tuple, expected.tolist())}
            assert len(part) == len(expected)
        assert len(seen) == scores.num_folds


def test_a_fixed_candidate_is_built_once_and_sees_no_pair() -> None:
    seen: list[int] = []

    def build(rope: RoPE, seed: int) -> Any:
        seen.append(len(rope.calibration[0]))
        return rope.npe

    stacked(rope_of(), candidates=[DensityCandidate(name="a", build=build, fixed=True)])
    assert seen == [0]


def recordings() -> tuple[Tensor, Tensor]:
    """Of nine people, three each, in mixed order."""
    theta, x = problem(9, seed=4)
    order = torch.randperm(27)
    x = x.repeat(3, 1) + 0.1 * torch.randn(27, 3)
    return theta.repeat(3, 1)[order], x[order]


@pytest.mark.medium
def test_recordings_of_a_person_are_never_both_trained_on_and_held_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    theta, x = recordings()
    people = groups_of(theta)
    person_of = {tuple(row): int(p) for row, p in zip(x.tolist(), people, strict=True)}
    tuned: list[tuple[set[int], Tensor]] = []
    splits: list[tuple[set[int], set[int]]] = []
    rehearsed: list[tuple[set[int], set[int]]] = []
    corrected: list[Tensor] = []
    finetune, without, correct = (
        CalibrationFinetuner.finetune,
        stack_candidates.finetune_without,
        workbench.correct_npe,
    )

    def spied_finetune(self: Any, h: Any, x: Tensor, *args: Any, **options: Any) -> Any:
        tuned.append(({person_of[tuple(row)] for row in x.tolist()}, options["groups"]))
        of_row = [person_of[tuple(row)] for row in x.tolist()]
        assert torch.equal(
            groups_of(options["groups"]), groups_of(torch.tensor(of_row))
        )
        return finetune(self, h, x, *args, **options)

    def spied_without(start: Any, fold: Any, part: int, **options: Any) -> Any:
        bench = fold.bench
        sides = [bench.rows_of(fold.used - {part}), bench.folds[part]]
        train, held_out = ({int(p) for p in people[side]} for side in sides)
        (rehearsed if options.get("rehearse") else splits).append((train, held_out))
        return without(start, fold, part, **options)

    def spied_correct(
        estimator: Any, simulations: Any, z: Any, *args: Any, **options: Any
    ) -> Any:
        corrected.append(options["groups"])
        assert len(options["groups"]) == len(z)
        return correct(estimator, simulations, z, *args, **options)

    monkeypatch.setattr(workbench, "correct_npe", spied_correct)
    monkeypatch.setattr(CalibrationFinetuner, "finetune", spied_finetune)
    monkeypatch.setattr(stack_candidates, "finetune_without", spied_without)
    scores = validated(
        rope_of((theta, x)), candidates=[*CANDIDATES, FINETUNED], num_folds=4
    )
    fold_of = {int(p): int(f) for p, f in zip(people, scores.fold, strict=True)}
    assert all(
        int(f) == fold_of[int(p)] for p, f in zip(people, scores.fold, strict=True)
    )
    held_out = [
        {*range(9)} - {p for p in range(9) if fold_of[p] in folds}
        for folds in [{0}, {1}, {2}, {3}]
    ]
    # RoPE is tuned for each fold. The tuned discrepancy leaves out two folds.
    assert sum(known in held_out for known, _ in tuned) == 4
    pairs = [held_out[i] & held_out[j] for i in range(4) for j in range(i)]
    assert sorted(sorted(k) for k, _ in tuned if k not in held_out) == sorted(
        sorted(known) for known in pairs
    )
    # The discrepancy is learned from whole people, and knows who they are.
    assert corrected
    assert all((groups.bincount(minlength=9) % 3 == 0).all() for groups in corrected)
    # Each of the four versions of a fine-tuned candidate holds out each of its parts.
    assert splits
    assert len(splits) % 12 == 0
    # One of each version with rehearsal.
    assert len(rehearsed) == 4
    assert all(
        known.isdisjoint(others) and others for known, others in splits + rehearsed
    )


class Indifferent(nn.Module):
    """An estimator that cannot improve, and notes the observations it is asked for."""

    trained: ClassVar[set[float]] = set()
    judged: ClassVar[list[set[float]]] = []

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(()))

    def loss(self, theta: Tensor, condition: Tensor) -> Tensor:
        rows = set(condition[:, 0].tolist())
        if torch.is_grad_enabled():
            self.trained.update(rows)
        else:
            self.judged.append(rows)
        return self.weight.square().expand(len(theta))


def test_a_net_is_not_tuned_on_the_part_that_tells_it_when_to_stop() -> None:
    bench = Workbench(
        rope_of(problem(12, seed=1)), num_folds=4, seed=0, show_progress_bars=False
    )
    finetune_without(Indifferent(), Fold(bench, [0, 1, 3]), 1, learning_rates=[1e-3])
    # At first it is asked which pairs have a density.
    _, _, part, *_ = Indifferent.judged
    assert part == set(bench.x[bench.folds[1], 0].tolist())
    others = torch.cat([bench.folds[0], bench.folds[3]])
    assert Indifferent.trained == set(bench.x[others, 0].tolist())


def test_of_several_learning_rates_the_best_on_the_part_that_is_held_out_is_kept() -> (
    None
):
    bench = Workbench(
        rope_of(problem(12, seed=1)), num_folds=4, seed=0, show_progress_bars=False
    )
    fold, start = Fold(bench, [0, 1, 3]), estimator_of(bench.npe)
    rows = fold.parts[1]

    def held_out_loss(*rates: float) -> float:
        found = finetune_without(start, fold, 1, learning_rates=rates)
        return float(found.loss(bench.theta[rows], condition=bench.x[rows]).mean())

    with quick():
        slow, fast = held_out_loss(1e-5), held_out_loss(1e-2)
        assert slow != fast
        for rates in ((1e-5, 1e-2), (1e-2, 1e-5)):
            assert held_out_loss(*rates) == min(slow, fast)


def test_a_single_fold_is_divided_so_that_nets_can_be_tuned_on_it() -> None:
    """The first point of a learning curve is not that of NPE as it was."""
    bench = Workbench(
        rope_of(problem(24, seed=1)), num_folds=4, seed=0, show_progress_bars=False
    )
    fold = Fold(bench, [2])
    rows = torch.cat([*fold.parts.values()])
    assert sorted(rows.tolist()) == sorted(bench.folds[2].tolist())
    part, *others = fold.parts
    rows = torch.cat([fold.parts[number] for number in others])
    assert torch.equal(fold.rows_without(part), rows)
    with quick():
        found = FinetunedCandidate().parts(fold)
    assert len(found) == len(fold.parts) > 1
    start = part_of(estimator_of(bench.npe))
    both = [zip(one.parameters(), start.parameters(), strict=True) for one in found]
    assert any(not torch.equal(*pair) for parameters in both for pair in parameters)


def test_recordings_of_one_person_are_not_divided_and_npe_stays_as_it_is() -> None:
    theta, x = problem(2, seed=1)
    two = rope_of((theta.repeat(4, 1), x.repeat(4, 1)))
    bench = Workbench(two, num_folds=2, seed=0, show_progress_bars=False)
    fold = Fold(bench, [0])
    assert len(fold.parts) == 1
    start = estimator_of(bench.npe).log_prob(bench.theta[None], bench.x)
    for candidate in (FinetunedCandidate(), RehearsedCandidate()):
        (part,) = candidate.parts(fold)
        found = MixtureEstimator([part], [1.0]).log_prob(bench.theta[None], bench.x)
        assert torch.allclose(found, start, atol=1e-5)


def test_with_rehearsal_pairs_and_simulations_count_half_each() -> None:
    bench = Workbench(
        rope_of(problem(12, seed=1)), num_folds=4, seed=0, show_progress_bars=False
    )
    start = estimator_of(bench.npe)
    with quick():
        simulated = bench.simulations
        with patch("sbi_rope.stacking.finetuning.train_network") as train:
            finetune_without(
                start, Fold(bench, [0, 1, 3]), 1, learning_rates=[1e-3], rehearse=True
            )
        _, batches, loss, training = train.call_args.args
        found = list(batches(0))
    assert len(found) == 3  # of a quick stack
    assert training.learning_rate == 1e-3
    pairs, others = found[0]
    assert len(pairs) == len(others) == BATCH_SIZE
    # Neither the part that is held out nor the fold that is scored is trained on.
    seen = torch.cat([rows for rows, _ in found]).unique()
    assert set(seen.tolist()) == set(bench.rows_of(frozenset({0, 3})).tolist())
    of_pairs, of_others = (
        -start.log_prob(theta[rows][None], x[rows]).mean()
        for (theta, x), rows in (((bench.theta, bench.x), pairs), (simulated, others))
    )
    assert torch.allclose(loss(pairs, others), (of_pairs + of_others) / 2)


def test_a_pair_weighs_as_much_in_a_small_batch_as_among_all() -> None:
    weights = torch.linspace(0.2, 3.0, 12)
    bench = Workbench(
        rope_of(problem(12, seed=1), weights=weights),
        num_folds=4,
        seed=0,
        show_progress_bars=False,
    )
    with patch("sbi_rope.stacking.finetuning.train_network") as train:
        finetune_without(
            estimator_of(bench.npe), Fold(bench, [0, 1, 3]), 1, learning_rates=[1e-3]
        )
    _, batches, loss, _ = train.call_args.args
    rows = torch.cat([rows for (rows,) in batches(0)])
    one_by_one = torch.stack([loss(row[None]) for row in rows])
    assert torch.allclose(one_by_one.mean(), loss(rows))
    start = estimator_of(bench.npe)
    losses = -start.log_prob(bench.theta[rows][None], bench.x[rows])[0]
    of_rows = weights[rows].to(losses)
    expected = (of_rows * losses).sum() / of_rows.sum()
    assert torch.allclose(loss(rows), expected, atol=1e-5)


def test_an_observation_is_embedded_once_whatever_its_label_leaves_possible() -> None:
    theta, x = problem(12, seed=1)
    rope = rope_of(problem(0, seed=1)).append_calibration(theta, x, theta_std=0.1)
    bench = Workbench(rope, num_folds=4, seed=0, show_progress_bars=False)
    start, seen = estimator_of(bench.npe), []
    embedding_of(start).register_forward_hook(lambda net, x, s: seen.append(len(x[0])))
    fold = Fold(bench, [0, 1, 3])
    with patch("sbi_rope.stacking.finetuning.train_network") as train:
        finetune_without(start, fold, 1, learning_rates=[1e-3])
    rows = fold.rows
    seen.clear()
    losses = train.call_args.args[2](rows)
    assert seen == [len(rows)]
    nodes = fold.nodes(start)
    log_prob = start.log_prob(nodes.theta.movedim(1, 0), bench.x[rows]).T
    assert torch.allclose(losses, -nodes.log_mean(log_prob).mean(), atol=1e-4)


def test_equal_labels_of_named_specimens_are_several_draws_of_parameters() -> None:
    torch.manual_seed(3)
    theta = problem(5, seed=1)[0].repeat(8, 1)
    x = problems.simulate(theta)

    def probability(labels: Tensor, **options: Any) -> float:
        rope = rope_of((labels, x), **options)
        bench = Workbench(rope, num_folds=4, seed=0, show_progress_bars=False)
        return bench.probability_of_prior()

    together, apart = probability(theta), probability(theta, groups=range(40))
    nearly_equal = probability(theta + 1e-5 * torch.randn_like(theta))
    assert apart == pytest.approx(nearly_equal, rel=1e-2)
    assert together > 10 * apart


def test_every_part_is_held_out_by_another_version_with_rehearsal() -> None:
    bench = Workbench(
        rope_of(problem(12, seed=1)), num_folds=4, seed=0, show_progress_bars=False
    )
    start = estimator_of(bench.npe)
    held_out = []
    with patch.object(
        stack_candidates, "finetune_without", return_value=start
    ) as train:
        for used in ([1, 2, 3], [2, 3, 0], [3, 0, 1], [0, 1, 2], [0, 1, 2, 3]):
            RehearsedCandidate().parts(Fold(bench, used))
            held_out.append(train.call_args.args[2])
    assert held_out == [1, 2, 3, 0, 0]


def test_fine_tuning_of_a_tuned_candidate_starts_with_the_net_without_the_part() -> (
    None
):
    bench = Workbench(
        rope_of(problem(12, seed=1)), num_folds=4, seed=0, show_progress_bars=False
    )
    fold = Fold(bench, [0, 1, 3])
    with quick():
        nets = fold.corrected("tuned", learn_prior=True).nets
        for number, net in zip((0, 1, 3), nets, strict=True):
            start = FinetunedCandidate(space="tuned")._start(fold, number)
            found = embed(embedding_of(start), bench.x)
            assert torch.equal(found, embed(net, bench.x))
            without = bench.tuned_net(frozenset({0, 1, 3} - {number}))
            assert torch.equal(found, embed(without, bench.x))


@pytest.mark.medium
def test_a_version_goes_through_another_course_if_it_gains_enough() -> None:
    def trained(min_gain: float) -> Tensor:
        bench = Workbench(
            rope_of(problem(12, seed=1)), num_folds=4, seed=0, show_progress_bars=False
        )
        with quick(), patch("sbi_rope.stacking.workbench.IN_A_STACK", min_gain):
            version = Fold(bench, [0, 1]).corrected("embedding", learn_prior=False)
        return nn.utils.parameters_to_vector(version.estimator.parameters())

    assert torch.equal(trained(ONE_COURSE), trained(ONE_COURSE))
    assert not torch.equal(trained(ONE_COURSE), trained(-math.inf))


# --- labels ---


@functools.cache
def base(num_pairs: int) -> tuple[StackedPosterior, Tensor, Tensor]:
    with torch.random.fork_rng():
        theta, x = problem(num_pairs, seed=1)
        return stacked(rope_of((theta, x)), candidates=CANDIDATES), theta, x


@pytest.mark.medium
@pytest.mark.parametrize(
    ("num_pairs", "number"), [pytest.param(6, 1, marks=pytest.mark.slow), (15, 1)]
)
def test_labels_of_a_fold_do_not_change_the_versions_that_are_scored_on_it(
    num_pairs: int, number: int
) -> None:
    before, theta, x = base(num_pairs)
    rows = scores_of(before).fold == number
    shuffled = theta.clone()
    shuffled[rows] = shuffled[rows].roll(1, dims=0)
    after = stacked(rope_of((shuffled, x)), candidates=CANDIDATES)
    assert torch.equal(scores_of(before).fold, scores_of(after).fold)
    # Anywhere: at the batch, and at the pairs.
    batch = torch.cat([observed(), x])
    points = problems.box(2).sample((len(batch),))
    same = [
        (
            before.versions.log_probs(points, batch, [v])
            == after.versions.log_probs(points, batch, [v])
        ).all(dim=0)
        for v in range(4)
    ]
    names = before.versions.names
    assert same[number].all()
    for version in {0, 1, 2} - {number}:
        changed = {
            name
            for name, equal in zip(names, same[version].tolist(), strict=True)
            if not equal
        }
        # All other versions of candidates that learn have learned from these labels.
        # Where some pairs are held out, the start can be the best: with rehearsal, and
        # with more pairs.
        learn = {*names} - UNTRAINED
        assert changed <= learn
        assert len(changed) > 3
        assert num_pairs > 6 or changed >= learn - {"fine-tuned NPE, rehearsed"}
    # The scores of the fold itself have changed with its labels.
    changed = scores_of(before).log_scores != scores_of(after).log_scores
    assert changed[rows][:, [k for k, n in enumerate(names) if n != "prior"]].any()
    fixed = [k for k, name in enumerate(names) if name in UNTRAINED]
    assert not changed[~rows][:, fixed].any()


@pytest.mark.slow
def test_observations_of_a_fold_do_not_change_the_versions_scored_on_it() -> None:
    before, theta, x = base(6)
    rows = scores_of(before).fold == 1
    moved = x.clone()
    moved[rows] += 1.0
    after = stacked(rope_of((theta, moved)), candidates=CANDIDATES)
    points, batch = problems.box(2).sample((25,)), observed()
    for version in range(4):
        first = before.versions.log_probs(points, batch, [version])
        second = after.versions.log_probs(points, batch, [version])
        assert torch.equal(first, second) == (version == 1)


@pytest.mark.medium
def test_with_two_training_folds_labels_of_a_fold_affect_two_others() -> None:
    # With so few pairs in a fold, tuning holds none of them out.
    theta, x = problem(10, seed=1)
    tuned = [DensityCandidate(name="tuned", build=lambda r, _: r.tuned_posterior())]
    for resample in (False, True):
        finetuner = CalibrationFinetuner(
            max_num_epochs=3, simulations_per_target=2, resample_targets=resample
        )
        before, after = (
            validated(
                rope_of((labels, x), finetuner=finetuner),
                candidates=tuned,
                num_folds=5,
                num_training_folds=2,
            )
            for labels in (theta, changed_in_a_fold(theta, x, finetuner))
        )
        assert before.num_trained_on == 4
        # Folds other than the first whose scores have changed.
        changed = {
            int(f)
            for f, a, b in zip(
                before.fold, before.log_scores, after.log_scores, strict=True
            )
            if int(f) != 0 and not torch.equal(a, b)
        }
        assert len(changed) == 2


def changed_in_a_fold(theta: Tensor, x: Tensor, finetuner: Any) -> Tensor:
    rope = rope_of((theta, x), finetuner=finetuner)
    scores = validated(rope, candidates=[PRIOR], num_folds=5)
    return torch.where((scores.fold == 0)[:, None], -theta, theta)


# --- scores ---


@pytest.mark.medium
def test_scores_are_the_densities_of_the_versions_without_the_fold() -> None:
    posterior = the_stack()
    scores, (theta, x) = scores_of(posterior), problem(NUM_PAIRS, seed=1)
    weights = torch.zeros(len(scores.names), dtype=torch.double)
    for k, name in enumerate(scores.names):
        alone = weights.clone()
        alone[k] = 1.0
        for number in range(scores.num_folds):
            rows = scores.fold == number
            estimator = posterior.versions.estimator(alone, [number])
            expected = estimator.log_prob(theta[rows][None], x[rows])[0].double()
            found = scores.scores_of(name)[rows]
            assert torch.allclose(found, expected, atol=1e-4), name


@pytest.mark.medium
def test_the_stack_that_scores_a_fold_is_weighted_by_the_others() -> None:
    posterior = the_stack()
    scores, (theta, x) = scores_of(posterior), problem(NUM_PAIRS, seed=1)
    for number in range(scores.num_folds):
        rows = scores.fold == number
        weights = stacking_weights(scores.log_scores[~rows]).weights
        mixed = torch.logsumexp(scores.log_scores[rows] + weights.log(), dim=1)
        assert torch.allclose(scores.scores_of("stack")[rows], mixed)
        without = MixturePosterior(
            posterior.versions.estimator(weights, [number]), posterior.prior
        )
        leakage = without.leakage(x[rows])
        expected = mixed - leakage.mass.log()
        error = 6 * leakage.standard_error / leakage.mass
        assert ((scores.stack_scores[rows] - expected).abs() < error + 1e-5).all()
        assert (error < 0.25).all()
        samples = without.sample_batched((400,), x[rows], **QUIET)
        below = (samples < theta[rows]).double().mean(dim=0)
        found = scores.levels[rows].double()
        # Four standard errors of 40 samples, two-sided.
        assert torch.allclose(found, (2 * below - 1).abs(), atol=0.65)
        assert ((found >= 0) & (found <= 1)).all()


def test_the_stack_of_each_fold_is_normalised_by_its_own_mass() -> None:
    """Its mass inside the prior differs from fold to fold."""

    def build(rope: RoPE, seed: int) -> Any:
        widths.append(1.5 + len(widths))
        width = torch.full((2,), widths[-1])
        return type(FITTED.build(rope, seed))(problems.BoxUniform(-width, width))

    widths: list[float] = []
    scores = validated(
        rope_of(), candidates=[DensityCandidate(name="wide", build=build)]
    )
    # After normalisation all versions are uniform on the box of the prior.
    box = torch.full((NUM_PAIRS,), math.log(0.25), dtype=torch.double)
    raw = -2 * (2 * torch.tensor(widths)).log().double()[scores.fold]
    assert torch.allclose(scores.log_scores[:, 0], raw, atol=1e-5)
    assert torch.allclose(scores.stack_scores, box, atol=0.7)
    assert float((scores.stack_scores - box).mean()) == pytest.approx(0.0, abs=0.15)


@pytest.mark.medium
def test_a_cross_validation_is_that_of_the_stack_with_the_same_seed() -> None:
    options: dict[str, Any] = {"candidates": [PRIOR, FINETUNED], "num_folds": 2}
    scores = validated(rope_of(), **options)
    expected = scores_of(stacked(rope_of(), **options))
    assert torch.equal(scores.log_scores, expected.log_scores)
    assert torch.equal(scores.levels, expected.levels)
    assert torch.allclose(scores.stack_scores, expected.stack_scores, atol=0.01)


def test_a_candidate_that_ignores_its_seed_is_seeded_all_the_same() -> None:
    class Careless(Candidate):
        name = "careless"

        def parts(self, fold: Any) -> Any:
            fitted = finetuned(fold.rope, int(torch.randint(1000, ())))
            return DensityCandidate(name="a", build=lambda rope, seed: fitted).parts(
                fold
            )

    found = []
    for seed in (1, 2):
        torch.manual_seed(seed)
        state = torch.get_rng_state()
        found.append(validated(rope_of(), candidates=[Careless()], num_folds=2))
        assert torch.equal(torch.get_rng_state(), state)
    assert torch.equal(found[0].log_scores, found[1].log_scores)


def test_the_seed_of_folds_does_not_depend_on_their_number() -> None:
    with quick():
        bench = Workbench(rope_of(), num_folds=5, seed=3, show_progress_bars=False)
    sets = [frozenset(s) for s in ([0], [1], [0, 1], [1, 2], [0, 1, 2, 3, 4], [40, 90])]
    seeds = [bench.seed_of(one) for one in sets]
    assert len(set(seeds)) == len(sets)
    assert seeds == [bench.seed_of(one) for one in sets]


# --- the table ---


@pytest.mark.medium
def test_differences_are_means_over_pairs_with_a_bootstrap_interval() -> None:
    scores = scores_of(the_stack())
    for name, other in (("NPE", "prior"), ("stack", "prior"), ("NPE", "NPE")):
        pairs = scores.scores_of(name) - scores.scores_of(other)
        found = scores.difference(name, other)
        assert found.mean == pytest.approx(float(pairs.mean()))
        error = float(pairs.std(correction=0)) / len(pairs) ** 0.5
        assert found.low == pytest.approx(found.mean - 1.96 * error, abs=0.5 * error)
        assert found.high == pytest.approx(found.mean + 1.96 * error, abs=0.5 * error)
        assert found == scores.difference(name, other)


def test_rows_of_the_table_are_mean_error_and_weight_of_each_candidate() -> None:
    scores = scores_of(the_stack())
    rows = scores.as_rows()
    assert [row["candidate"] for row in rows] == list(scores.names)
    assert [row["family"] for row in rows] == list(scores.families)
    for k, row in enumerate(rows):
        column = scores.log_scores[:, k]
        assert row["weight"] == float(scores.weights.weights[k])
        assert row["score"] == pytest.approx(float(column.mean()))
        error = float((column - column.mean()).square().sum() / (19 * 20)) ** 0.5
        assert row["standard_error"] == pytest.approx(error, abs=1e-12)
    assert math.isfinite(acauc_of(scores.levels).value)
