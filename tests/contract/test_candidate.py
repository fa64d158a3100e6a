"""What holds for every candidate of a stack, also for one that a user has written."""

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from sbi_rope.data.pairs import Nodes, Pairs
from sbi_rope.density import Density, Flow
from sbi_rope.rope import finetuning
from sbi_rope.rope.finetuning import finetune_flow
from sbi_rope.stacking import Candidate, StackData, candidates
from sbi_rope.stacking.candidates import (
    DiscrepancyCandidate,
    FinetunedCandidate,
    UnlabelledCandidate,
)
from sbi_rope.utils.seeds import seeded
from tests import problems
from tests.stacks import BOX, CANDIDATES, data_of, observed, problem, quick, rope_of

# Batches and calibration sets are small here on purpose.
pytestmark = [
    pytest.mark.filterwarnings("ignore::sbi_rope.utils.errors.RoPEWarning"),
    pytest.mark.filterwarnings("ignore:Maximum number of epochs"),
]

ALL = [*CANDIDATES, BOX, UnlabelledCandidate(observed(40))]
LEARNING = [one for one in ALL if one.name not in ("prior", "NPE")]
each = pytest.mark.parametrize("candidate", ALL, ids=lambda one: one.name)


def fitted(
    candidate: Candidate, data: StackData, versions: Sequence[Tensor], *, seed: int = 0
) -> list[Density]:
    with quick(), seeded(seed):
        return candidate.fit(data, versions)


def log_probs(density: Density, n: int = 7) -> Tensor:
    theta, x = problem(n, seed=5)
    with torch.no_grad():
        return density.log_prob(theta[None].expand(3, -1, -1), x)


def changed(data: StackData, **values: Tensor) -> StackData:
    """Return the data with other pairs, of which nothing is computed yet."""
    other = copy.copy(data)
    other.kept, other.pairs = {}, replace(data.pairs, **values)
    return other


def poisoned(data: StackData, rows: Tensor) -> StackData:
    """Return the data with NaN in everything that is known of some pairs."""
    names = ("theta", "x", "weight")
    values = {
        name: getattr(data.pairs, name).index_fill(0, rows, torch.nan) for name in names
    }
    # NaN would be a parameter that was not measured.
    return changed(data, y=data.pairs.y.index_fill(0, rows, torch.inf), **values)


@each
@pytest.mark.parametrize(
    ("noise", "folds"),
    [(0.0, (0, 2)), pytest.param(0.1, (1,), marks=pytest.mark.medium)],
    ids=["exact", "noisy"],
)
def test_held_out_rows_change_nothing_that_scores_them(
    candidate: Candidate, noise: float, folds: tuple[int, ...]
) -> None:
    data = data_of(rope := rope_of(problem(16, seed=1), theta_std=noise))
    for fold in folds:
        versions = [data.without(fold), data.without(fold, 2)][: len(folds)]
        before, after = (
            [log_probs(one) for one in fitted(candidate, some, versions)]
            for some in (data_of(rope), poisoned(data, data.folds[fold]))
        )
        # Some processors round by where rows lie in memory. What leaks is not finite.
        torch.testing.assert_close(after, before, rtol=1e-5, atol=1e-5)
        assert before[0].isfinite().any()


# In a quick training with rehearsal the start is the best.
@pytest.mark.parametrize(
    "candidate",
    [c for c in LEARNING if "rehearsed" not in c.name],
    ids=lambda c: c.name,
)
def test_it_learns_from_the_rows_that_it_may_see(candidate: Candidate) -> None:
    theta, x = problem(16, seed=1)
    data = data_of(rope_of((theta, x)))
    flipped = theta.clone()
    flipped[data.folds[1]] = -0.9 * theta[data.folds[1]].flip(1)
    other, versions = changed(data, **vars(Pairs.exact(flipped, x))), [data.without(0)]
    [before], [after] = (fitted(candidate, one, versions) for one in (data, other))
    assert not torch.equal(log_probs(before), log_probs(after))


@each
def test_every_version_has_a_density_that_follows_from_the_seed(
    candidate: Candidate,
) -> None:
    rope, found = rope_of(problem(16, seed=1)), []
    for state in (1, 2):
        torch.manual_seed(state)
        data = data_of(rope)
        found.append(fitted(candidate, data, [data.without(0), data.every]))
    for density, again in zip(*found, strict=True):
        assert isinstance(density, Density)
        assert log_probs(density).shape == (3, 7)
        assert torch.equal(log_probs(density), log_probs(again))
        draws = density.sample(torch.Size((5,)), observed(4))
        assert draws.shape == (5, 4, 2)
        assert draws.isfinite().all()


@pytest.mark.parametrize("candidate", LEARNING, ids=lambda one: one.name)
def test_a_single_fold_or_person_is_enough(candidate: Candidate) -> None:
    """The first point of a learning curve is not that of NPE as it was."""
    data = data_of(rope_of(problem(24, seed=1)))
    [density] = fitted(candidate, data, [data.folds[2]])
    assert log_probs(density).isfinite().any()
    assert len(data.holdouts(data.folds[2])) > 1
    theta, x = problem(2, seed=1)
    data = data_of(rope_of((theta.repeat(4, 1), x.repeat(4, 1))), num_folds=2)
    assert data.holdouts(data.folds[0]) == []
    [density] = fitted(candidate, data, [data.folds[0]])
    assert log_probs(density).isfinite().any()


# --- who is held out inside a version ---


def test_recordings_of_a_person_are_never_both_trained_on_and_held_out() -> None:
    """There are nine people, three recordings of each, in mixed order."""
    (theta, x), order = problem(9, seed=4), torch.randperm(27)
    x = x.repeat(3, 1) + 0.1 * torch.randn(27, 3)
    data = data_of(rope_of((theta.repeat(3, 1)[order], x[order])))
    people = data.pairs.group
    for rows in (data.without(0), data.every, data.folds[0]):
        parts = data.holdouts(rows)
        held_out = torch.cat([part for _, part in parts])
        assert sorted(held_out.tolist()) == sorted(rows.tolist())
        for train, part in parts:
            assert len(train) + len(part) == len(rows)
            assert not {*people[train].tolist()} & {*people[part].tolist()}


def test_tuned_nets_have_not_seen_the_pairs_that_they_embed_or_start_from(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = data_of(rope_of(problem(12, seed=1)))
    versions, x = [data.without(0), data.every], data.pairs.x
    made: list[Any] = []
    tuned, finetune = candidates.tuned, candidates.finetune_flow

    def spied_nets(*args: Any) -> Any:
        made.append(tuned(*args))
        return made[0]

    def spied_flow(flow: Flow, labels: Any, x: Any, splits: Any, **options: Any) -> Any:
        made.append((flow.embed(x), splits))
        return finetune(flow, labels, x, splits, **options)

    monkeypatch.setattr(candidates, "tuned", spied_nets)
    monkeypatch.setattr(candidates, "finetune_flow", spied_flow)
    fitted(FinetunedCandidate(space="tuned"), data, versions)
    (nets, numbers, embedded), (starts, splits) = made
    # Each flow starts behind the net that was tuned without the part it holds out.
    expected = torch.stack([nets.member(k)(x) for k in numbers], dim=1)
    assert torch.allclose(starts, expected, atol=1e-5)
    parts = [(v, *one) for v in (0, 1) for one in data.holdouts(versions[v])]
    assert len(parts) == len(splits) == 3 + 4
    for k, (version, train, part) in enumerate(parts):
        assert torch.equal(torch.cat(splits[k]), torch.cat([train, part]))
        assert torch.allclose(embedded[version][part], expected[part, k], atol=1e-5)


def test_pairs_and_simulations_count_half_each_with_rehearsal_and_pairs_by_weight(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The first loss of two flows that share their start, against its formula."""
    estimator = problems.npe_posterior("mdn", "linear").posterior_estimator
    (theta, x), weights = problem(12, seed=1), torch.linspace(0.2, 3.0, 12)
    splits = [
        (torch.arange(8), torch.arange(8, 12)),
        (torch.arange(3, 12), torch.arange(2)),
    ]
    of_rows = estimator.loss(theta, condition=x).detach().double()

    def mean(rows: Tensor) -> float:
        return float(weights[rows].double() @ of_rows[rows] / weights[rows].sum())

    def spied(network: Any, batches: Any, loss: Any, *rest: Any, **options: Any) -> Any:
        first = torch.stack([loss(*batch).detach() for batch in batches(0)])
        held_out = options["validation_loss"](*options["held_out"]).detach()
        return first.mean(dim=0).tolist(), held_out.tolist()

    monkeypatch.setattr(finetuning, "fit", spied)
    monkeypatch.setattr(finetuning, "PAIRS_IN_BATCH", 20_000)
    options: dict[str, Any] = {"training": finetuning.FINETUNING, "weights": weights}
    arguments = Flow.of([estimator] * 2), [Nodes.exact(theta)] * 2, x, splits
    train = [mean(rows) for rows, _ in splits]
    first, held_out = finetune_flow(*arguments, **options)
    assert first == pytest.approx(train, abs=1e-4)
    assert held_out == pytest.approx([mean(rows) for _, rows in splits], abs=1e-4)
    with quick():
        one = theta[:1], x[:1]  # the only simulation
        first, _ = finetune_flow(*arguments, rehearsed=one, **options)
    expected = [0.5 * loss + 0.5 * float(of_rows[0]) for loss in train]
    assert first == pytest.approx(expected, abs=0.05)


def test_a_version_is_corrected_by_the_discrepancy_of_its_rows() -> None:
    """Pairs of two kinds, each shifted in its own way."""
    data = data_of(rope_of(problem(16, seed=1)), num_folds=2)
    moved = data.pairs.x.index_add(0, data.folds[0], torch.full((8, 3), 2.0))
    data = changed(data, x=moved)
    candidate = DiscrepancyCandidate(space="input", learn_prior=False)
    with seeded(0):  # and not only for a few steps
        first, second = candidate.fit(data, data.folds)
    theta, x = problem(200, seed=9)

    def mean(density: Density, shift: float) -> float:
        return float(density.log_prob(theta[None], x + shift).mean())

    assert mean(first, 2.0) > mean(second, 2.0) + 0.3
    assert mean(second, 0.0) > mean(first, 0.0) + 0.3
