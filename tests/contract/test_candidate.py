"""What holds for every candidate of a stack, also for one that a user has written."""

import copy
import math
from collections.abc import Sequence
from typing import Any
from unittest.mock import patch

import pytest
import torch
from torch import Tensor

from sbi_rope._random import seeded
from sbi_rope._sbi import embed
from sbi_rope.data import Nodes, Pairs
from sbi_rope.density import Density, Flow
from sbi_rope.ensemble import embedded
from sbi_rope.finetuning import CalibrationFinetuner, finetune_flow
from sbi_rope.fit import Training
from sbi_rope.stacking import (
    Candidate,
    FinetunedCandidate,
    StackData,
    UnlabelledCandidate,
    candidates,
)
from sbi_rope.stacking.candidates import corrected, tuned
from tests import problems
from tests.stacks import BOX, CANDIDATES, data_of, observed, problem, quick, rope_of

# Batches and calibration sets are small here on purpose.
pytestmark = [
    pytest.mark.filterwarnings("ignore::sbi_rope.errors.RoPEWarning"),
    pytest.mark.filterwarnings("ignore:Maximum number of epochs"),
]

SHORT = Training(training_batch_size=50, max_num_epochs=2)
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

    def nan(values: Tensor, value: float = torch.nan) -> Tensor:
        values = values.clone()
        values[rows] = value
        return values

    pairs, label = data.pairs, copy.copy(data.pairs.label)
    # NaN would be a parameter that was not measured.
    object.__setattr__(label, "y", nan(label.y, torch.inf))
    changed = copy.copy(data)
    changed.__dict__.pop("has_summaries", None)
    changed.kept = {}
    changed.pairs = Pairs(
        theta=nan(pairs.theta),
        x=nan(pairs.x),
        group=pairs.group,
        weight=nan(pairs.weight),
        label=label,
    )
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
def test_versions_trained_at_once_are_those_trained_alone(candidate: Candidate) -> None:
    """But for random numbers: here nothing random is left."""
    data = data_of(rope_of(problem(16, seed=1)))
    versions = [data.without(0), data.every]
    densities = fitted(candidate, data, versions)
    assert len(densities) == 2
    assert all(isinstance(density, Density) for density in densities)
    for density in densities:
        assert log_probs(density).shape == (3, 7)
        draws = density.sample(torch.Size((5,)), observed(4))
        assert draws.shape == (5, 4, 2)
        assert draws.isfinite().all()


@each
def test_the_seed_decides_and_not_the_state_of_torch(candidate: Candidate) -> None:
    rope, found = rope_of(problem(12, seed=1)), []
    for state in (1, 2):
        torch.manual_seed(state)
        data = data_of(rope, num_folds=3)
        [density] = fitted(candidate, data, [data.without(0)])
        found.append(log_probs(density))
    assert torch.equal(*found)


@pytest.mark.parametrize("candidate", LEARNING, ids=lambda one: one.name)
def test_a_single_fold_or_person_is_enough(candidate: Candidate) -> None:
    """The first point of a learning curve is not that of NPE as it was."""
    data = data_of(rope_of(problem(24, seed=1)))
    [density] = fitted(candidate, data, [data.folds[2]])
    assert log_probs(density).isfinite().any()
    assert len(data.parts(data.folds[2])) > 1
    theta, x = problem(2, seed=1)
    data = data_of(rope_of((theta.repeat(4, 1), x.repeat(4, 1))), num_folds=2)
    assert data.holdouts(data.folds[0]) == []
    [density] = fitted(candidate, data, [data.folds[0]])
    assert log_probs(density).isfinite().any()


# --- who is held out ---


def recordings() -> tuple[Tensor, Tensor]:
    """Of nine people, three each, in mixed order."""
    theta, x = problem(9, seed=4)
    order = torch.randperm(27)
    x = x.repeat(3, 1) + 0.1 * torch.randn(27, 3)
    return theta.repeat(3, 1)[order], x[order]


def test_recordings_of_a_person_are_never_both_trained_on_and_held_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = data_of(rope_of(recordings()))
    people = data.pairs.group
    splits: list[tuple[Tensor, Tensor]] = []
    sets: list[Tensor] = []

    def spied_flow(flow: Any, labels: Any, x: Any, some: Any, **options: Any) -> Any:
        splits.extend(some)
        return finetune_flow(flow, labels, x, some, **options)

    tuning = CalibrationFinetuner.tuned

    def spied_tuning(
        self: Any, h: Any, x: Any, targets: Any, some: Any, **options: Any
    ) -> Any:
        sets.extend(some)
        assert torch.equal(options["groups"], people)
        return tuning(self, h, x, targets, some, **options)

    monkeypatch.setattr(candidates, "finetune_flow", spied_flow)
    monkeypatch.setattr(CalibrationFinetuner, "tuned", spied_tuning)
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
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = data_of(rope_of(problem(12, seed=1)))
    held_out: list[Tensor] = []

    def spied(flow: Any, labels: Any, x: Any, some: Any, **options: Any) -> Any:
        held_out.extend(part for _, part in some)
        assert options["rehearsed"] is data.simulations
        return finetune_flow(flow, labels, x, some, **options)

    monkeypatch.setattr(candidates, "finetune_flow", spied)
    versions = [data.without(k) for k in range(4)] + [data.every]
    fitted(FinetunedCandidate(rehearse=True), data, versions)
    number = [
        next(k for k, fold in enumerate(data.folds) if torch.equal(fold, part))
        for part in held_out
    ]
    assert number == [1, 2, 3, 0, 0]


def test_pairs_are_embedded_by_tuned_nets_that_have_not_seen_them() -> None:
    data = data_of(rope_of(problem(12, seed=1)))
    version = data.without(1)
    with quick():
        nets = tuned(data, [version])
        z = nets.held_out(version, data)
    for number, part in zip(nets.of(version, data), data.parts(version), strict=True):
        [seen] = [rows for rows, own in nets.number.items() if own == number]
        assert {*seen[0]} == {*version.tolist()} - {*part.tolist()}
        expected = embed(nets.nets.member(number), data.pairs.x[part])
        assert torch.allclose(z[torch.isin(version, part)], expected, atol=1e-5)


def test_fine_tuning_of_a_tuned_candidate_starts_behind_the_net_without_the_part() -> (
    None
):
    data = data_of(rope_of(problem(12, seed=1)))
    versions = [data.without(0), data.every]
    seen: list[Flow] = []

    def spied(flow: Flow, *rest: Any, **options: Any) -> Any:
        seen.append(copy.deepcopy(flow))
        return finetune_flow(flow, *rest, **options)

    with quick(), seeded(0), patch.object(candidates, "finetune_flow", spied):
        FinetunedCandidate(space="tuned").fit(data, versions)
    with quick():
        nets, x = tuned(data, versions), data.pairs.x
    expected = [number for rows in versions for number in nets.of(rows, data)]
    z = seen[0].embed(x)
    assert z.shape[1] == len(expected) == 3 + 4
    for column, number in enumerate(expected):
        own = nets.nets.member(number)(x)
        assert torch.allclose(z[:, column], own, atol=1e-5)


# --- losses ---


def test_pairs_and_simulations_count_half_each_with_rehearsal_and_pairs_by_weight(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The first loss of two flows that share their start, against its formula."""
    from sbi_rope import finetuning

    estimator = problems.npe_posterior("mdn", "linear").posterior_estimator
    (theta, x), weights = problem(12, seed=1), torch.linspace(0.2, 3.0, 12)
    losses: list[Tensor] = []

    def spied(network: Any, batches: Any, loss: Any, *rest: Any, **options: Any) -> Any:
        losses.append(torch.stack([loss(*batch).detach() for batch in batches(0)]))
        losses.append(options["validation_loss"](*options["held_out"]).detach())
        return []

    monkeypatch.setattr(finetuning, "fit", spied)
    rows = torch.arange(12)
    splits = [(rows[:8], rows[8:]), (rows[3:], rows[:2])]

    def run(**options: Any) -> tuple[Tensor, Tensor]:
        losses.clear()
        flow = Flow.of([estimator] * 2)
        with quick():
            finetune_flow(
                flow,
                [Nodes.exact(theta)] * 2,
                x,
                splits,
                training=finetuning.FINETUNING,
                weights=weights,
                **options,
            )
        first, held_out = losses
        return first, held_out

    of_rows = estimator.loss(theta, condition=x).detach()

    def mean(some: Tensor) -> Tensor:
        return (weights[some] * of_rows[some]).sum() / weights[some].sum()

    first, held_out = run()
    train = torch.stack([mean(train) for train, _ in splits]).double()
    assert torch.allclose(first[0].double(), train, atol=1e-4)
    expected = torch.stack([mean(part) for _, part in splits]).double()
    assert torch.allclose(held_out.double(), expected, atol=1e-4)
    simulations = theta[:1], x[:1]  # the only one
    of_batches, _ = run(rehearsed=simulations)
    assert of_batches.shape == (3, 2)
    with patch("sbi_rope.finetuning.PAIRS_IN_BATCH", 20_000):
        of_batches, _ = run(rehearsed=simulations)
    half = 0.5 * train + 0.5 * float(of_rows[0])
    plain = torch.stack(
        [(weights[t] * of_rows[t]).mean() / weights[t].mean() for t, _ in splits]
    ).double()
    assert torch.allclose(
        of_batches.mean(0).double(), 0.5 * plain + half - 0.5 * train, atol=0.05
    )


def test_an_observation_is_embedded_once_whatever_its_label_leaves_possible() -> None:
    theta, x = problem(12, seed=1)
    rope = rope_of(problem(0, seed=1)).append_calibration(theta, x, theta_std=0.1)
    data = data_of(rope)
    flow = Flow.of([data.estimator])
    nodes = data.nodes(data.every, flow)
    assert nodes.theta.shape[1] > 10
    sizes: list[int] = []
    answer = type(flow.nets).answer

    def counted(self: Any, question: Any, *rows: Tensor) -> Tensor:
        if question is embedded:
            sizes.append(len(rows[0]))
        return answer(self, question, *rows)

    histories: list[Any] = []
    with patch.object(type(flow.nets), "answer", counted), quick():
        split = [(data.every[:8], data.every[8:])]
        histories = finetune_flow(
            flow, [nodes], data.pairs.x, split, training=candidates.FINETUNING
        )
    assert {*sizes} == {8, 4}
    log_q = flow.log_prob(nodes.theta.movedim(1, 0), data.pairs.x).T
    assert math.isfinite(histories[0].kept_validation_loss)
    assert nodes.log_mean(log_q).isfinite().all()


def test_a_version_is_corrected_by_the_discrepancy_of_its_rows() -> None:
    """Pairs of two kinds, each shifted in its own way."""
    theta, x = problem(16, seed=1)
    data = data_of(rope_of((theta, x)), num_folds=2)
    moved = data.pairs.x.clone()
    moved[data.folds[0]] += 2.0
    object.__setattr__(data.pairs, "x", moved)
    found = corrected(data, data.folds, "input", learn_prior=False).flow
    shift = embed(data.embedding_net, moved).std()
    assert float(shift) > 0
    theta, x = problem(200, seed=9)
    with torch.no_grad():
        own = [
            float(found[[k]].log_prob(theta[None], x + 2.0 * (k == 0)).mean())
            for k in (0, 1)
        ]
        others = [
            float(found[[k]].log_prob(theta[None], x + 2.0 * (k == 1)).mean())
            for k in (0, 1)
        ]
    assert all(a > b + 0.3 for a, b in zip(own, others, strict=True))
