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
from sbi_rope.npe.sbi import embed
from sbi_rope.rope.finetuning import CalibrationFinetuner, finetune_flow
from sbi_rope.stacking import (
    Candidate,
    FinetunedCandidate,
    StackData,
    UnlabelledCandidate,
    candidates,
)
from sbi_rope.stacking.candidates import started, tuned
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


def poisoned(data: StackData, rows: Tensor) -> StackData:
    """Return the data with NaN in everything that is known of some pairs."""
    changed, pairs = copy.copy(data), data.pairs
    # NaN would be a parameter that was not measured.
    y = pairs.y.index_fill(0, rows, torch.inf)
    theta, x, weight = (
        one.index_fill(0, rows, torch.nan)
        for one in (pairs.theta, pairs.x, pairs.weight)
    )
    changed.pairs = replace(pairs, theta=theta, x=x, weight=weight, y=y)
    changed.kept = {}
    return changed


@each
@pytest.mark.parametrize(
    ("noise", "folds"),
    [(0.0, (0, 2)), pytest.param(0.1, (1,), marks=pytest.mark.medium)],
    ids=["exact", "noisy"],
)
def test_held_out_rows_change_nothing_that_scores_them(
    candidate: Candidate, noise: float, folds: tuple[int, ...]
) -> None:
    theta, x = problem(16, seed=1)
    rope = rope_of((theta[:0], x[:0])).append_calibration(theta, x, theta_std=noise)
    data = data_of(rope)
    for fold in folds:
        versions = [data.without(fold), data.without(fold, 2)][: len(folds)]
        before, after = (
            [log_probs(one) for one in fitted(candidate, some, versions)]
            for some in (data_of(rope), poisoned(data, data.folds[fold]))
        )
        assert all(map(torch.equal, before, after))
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
    changed = copy.copy(data)
    changed.kept, changed.pairs = {}, Pairs.exact(flipped, x)
    versions = [data.without(0)]
    [before], [after] = (fitted(candidate, one, versions) for one in (data, changed))
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


# --- who is held out ---


@pytest.fixture
def splits(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Tensor, Tensor]]:
    """What each fine-tuning trains on and holds out, in the order of the flows."""
    found: list[tuple[Tensor, Tensor]] = []

    def spied(flow: Any, labels: Any, x: Any, some: Any, **options: Any) -> Any:
        found.extend(some)
        return finetune_flow(flow, labels, x, some, **options)

    monkeypatch.setattr(candidates, "finetune_flow", spied)
    return found


def test_recordings_of_a_person_are_never_both_trained_on_and_held_out(
    splits: list[tuple[Tensor, Tensor]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """There are nine people, three recordings of each, in mixed order."""
    (theta, x), order = problem(9, seed=4), torch.randperm(27)
    x = x.repeat(3, 1) + 0.1 * torch.randn(27, 3)
    data = data_of(rope_of((theta.repeat(3, 1)[order], x[order])))
    people = data.pairs.group
    sets: list[Tensor] = []
    tuning = CalibrationFinetuner.tuned

    def spied(
        self: Any, h: Any, x: Any, targets: Any, some: Any, **options: Any
    ) -> Any:
        sets.extend(some)
        assert torch.equal(options["groups"], people)
        return tuning(self, h, x, targets, some, **options)

    monkeypatch.setattr(CalibrationFinetuner, "tuned", spied)
    versions = [data.without(k) for k in range(4)] + [data.every]
    for candidate in (FinetunedCandidate(), FinetunedCandidate(space="tuned")):
        fitted(candidate, data, versions)
    # Each of four versions holds out each of its three parts, and the last one four.
    assert len(splits) == 2 * (4 * 3 + 4)
    for train, held_out in splits:
        assert not {*people[train].tolist()} & {*people[held_out].tolist()}
        assert len(held_out) > 0
    # A net for each set of two folds, and of three.
    assert len(sets) == 6 + 4
    for rows in sets:
        assert (people[rows].bincount(minlength=9) % 3 == 0).all()


def test_with_rehearsal_every_part_is_held_out_by_another_version(
    splits: list[tuple[Tensor, Tensor]],
) -> None:
    data = data_of(rope_of(problem(12, seed=1)))
    versions = [data.without(k) for k in range(4)] + [data.every]
    fitted(FinetunedCandidate(rehearse=True), data, versions)
    of_rows = {tuple(fold.tolist()): k for k, fold in enumerate(data.folds)}
    held_out = [of_rows[tuple(part.tolist())] for _, part in splits]
    assert held_out == [1, 2, 3, 0, 0]


def test_tuned_nets_have_not_seen_the_pairs_that_they_embed_or_start_from(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = data_of(rope_of(problem(12, seed=1)))
    versions, x = [data.without(0), data.every], data.pairs.x
    made: list[Any] = []
    starts: list[Tensor] = []

    def spied_nets(*args: Any) -> Any:
        made.append(tuned(*args))
        return made[0]

    def spied_flow(flow: Flow, *rest: Any, **options: Any) -> Any:
        starts.append(flow.embed(x))
        return finetune_flow(flow, *rest, **options)

    monkeypatch.setattr(candidates, "tuned", spied_nets)
    monkeypatch.setattr(candidates, "finetune_flow", spied_flow)
    fitted(FinetunedCandidate(space="tuned"), data, versions)
    [(nets, numbers, embedded)] = made
    # Each flow starts behind the net that was tuned without the part it holds out.
    expected = torch.stack([nets.member(k)(x) for k in numbers], dim=1)
    assert expected.shape[1] == 3 + 4
    assert torch.allclose(starts[0], expected, atol=1e-5)
    parts = [(v, part) for v in (0, 1) for _, part in data.holdouts(versions[v])]
    for number, (version, part) in zip(numbers, parts, strict=True):
        z = embed(nets.member(number), x[part])
        assert torch.allclose(embedded[version][part], z, atol=1e-5)


# --- losses ---


def test_pairs_and_simulations_count_half_each_with_rehearsal_and_pairs_by_weight(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The first loss of two flows that share their start, against its formula."""
    from sbi_rope.rope import finetuning

    estimator = problems.npe_posterior("mdn", "linear").posterior_estimator
    (theta, x), weights = problem(12, seed=1), torch.linspace(0.2, 3.0, 12)

    def spied(network: Any, batches: Any, loss: Any, *rest: Any, **options: Any) -> Any:
        first = torch.stack([loss(*batch).detach() for batch in batches(0)])
        held_out = options["validation_loss"](*options["held_out"]).detach()
        return first.mean(dim=0).double(), held_out.double()

    monkeypatch.setattr(finetuning, "fit", spied)
    monkeypatch.setattr(finetuning, "PAIRS_IN_BATCH", 20_000)
    rows = torch.arange(12)
    splits = [(rows[:8], rows[8:]), (rows[3:], rows[:2])]

    def run(**options: Any) -> Any:
        flow, labels = Flow.of([estimator] * 2), [Nodes.exact(theta)] * 2
        options |= {"training": finetuning.FINETUNING, "weights": weights}
        with quick():
            return finetune_flow(flow, labels, x, splits, **options)

    of_rows = estimator.loss(theta, condition=x).detach()

    def means(of_splits: Sequence[Tensor]) -> Tensor:
        weighted = [weights[some] @ of_rows[some] for some in of_splits]
        total = [weights[some].sum() for some in of_splits]
        return (torch.stack(weighted) / torch.stack(total)).double()

    train, part = map(means, zip(*splits, strict=True))
    first, held_out = run()
    assert torch.allclose(first, train, atol=1e-4)
    assert torch.allclose(held_out, part, atol=1e-4)
    first, _ = run(rehearsed=(theta[:1], x[:1]))  # the only simulation
    assert torch.allclose(first, 0.5 * train + 0.5 * float(of_rows[0]), atol=0.05)


def test_a_version_is_corrected_by_the_discrepancy_of_its_rows() -> None:
    """Pairs of two kinds, each shifted in its own way."""
    data = data_of(rope_of(problem(16, seed=1)), num_folds=2)
    moved = data.pairs.x.index_add(0, data.folds[0], torch.full((8, 3), 2.0))
    data.pairs = replace(data.pairs, x=moved)
    flow, numbers = started(data, data.folds, "input", learn_prior=False)
    theta, x = problem(200, seed=9)
    for version in (0, 1):
        density = flow[numbers[version]]
        own, other = (
            float(density.log_prob(theta[None], x + 2.0 * kind).mean())
            for kind in (version == 0, version == 1)
        )
        assert own > other + 0.3
