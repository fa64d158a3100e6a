"""The candidates that a stack can be made of, and those that it is made of by default.

A candidate is a class with a name and :meth:`Candidate.fit`. Nothing else knows its
type.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor

from sbi_rope.data.pairs import without_warning_of_few_pairs
from sbi_rope.density import Density, Flow, GaussianProcess, Given, Prior, density_of
from sbi_rope.discrepancy.correction import (
    Correction,
    SimulatedConstants,
    Space,
    Version,
    correct_flow,
    fit_version,
    in_units,
    network_of,
)
from sbi_rope.discrepancy.unlabelled import Marginal, fit_unlabelled
from sbi_rope.npe.sbi import MixedDensity, NeuralPosterior, embed, has_parameters
from sbi_rope.npe.standardisation import Standardisation
from sbi_rope.rope.finetuning import FINETUNING, TUNING, finetune_flow
from sbi_rope.rope.rope import RoPE
from sbi_rope.stacking.data import NUM_FOLDS, StackData, key_of
from sbi_rope.training.ensemble import Ensemble
from sbi_rope.utils.errors import (
    InvalidInputError,
    UnsupportedPosteriorError,
    warn_user,
)
from sbi_rope.utils.settings import check
from sbi_rope.utils.tensors import as_batch, as_numbers


class Candidate(ABC):
    """A candidate of a stack, in ten lines: give it a name and define :meth:`fit`.

    Attributes:
        name: Its name in the report.
        family: The name of its method, by which weights are added up in the report;
            that of the candidate if it has none.
        learns_prior: Whether it learns from the pairs how parameters are distributed,
            as all training on them does.
        needs: What the data need for it, for the report of a stack that leaves it out.
    """

    name: str
    family: str = ""
    learns_prior: bool = True
    needs: str = ""

    def suits(self, data: StackData) -> bool:
        """Tell whether the data allow it. The default stack leaves it out if not."""
        return True

    def check(self, data: StackData) -> None:
        """Raise if it cannot be trained, before any candidate is."""
        return

    @abstractmethod
    def fit(self, data: StackData, versions: Sequence[Tensor]) -> list[Density]:
        """Train all versions at once.

        Args:
            data: The pairs and simulations.
            versions: For each version, the rows of the pairs that it may see.

        Returns:
            For each version a density, or anything else that :class:`GivenCandidate`
            takes. One that sees no pairs may be that of all versions.
        """


class PriorCandidate(Candidate):
    """The prior, which learns nothing from x."""

    name = "prior"
    learns_prior = False

    def fit(self, data: StackData, versions: Sequence[Tensor]) -> list[Density]:
        """Return the prior for all versions."""
        return [Prior(data.prior, data.pairs.x.shape[1:])] * len(versions)


class NPECandidate(Candidate):
    """NPE as it is."""

    name = "NPE"
    learns_prior = False

    def fit(self, data: StackData, versions: Sequence[Tensor]) -> list[Density]:
        """Return NPE for all versions."""
        return [Flow.of([data.estimator])] * len(versions)


class GivenCandidate(Candidate):
    """A density that is there already, and has not seen the calibration pairs.

    Args:
        density: An amortised posterior of NPE or of this package, a
            :class:`~sbi_rope.density.Density`, or anything with its methods
            ``log_prob(theta, x)``, shapes ``(S, B, d)`` and ``(B, *event)`` to
            ``(S, B)``, and ``sample((n,), x)``, shape ``(n, B, d)``.
        name: Its name in the report; that of its class if None.
    """

    learns_prior = False

    def __init__(self, density: Any, name: str | None = None) -> None:
        self.density = density
        self.name = type(density).__name__ if name is None else name

    def check(self, data: StackData) -> None:
        """Try the density on two pairs."""
        as_density(self.density, data, self.name)

    def fit(self, data: StackData, versions: Sequence[Tensor]) -> list[Density]:
        """Return the density for all versions."""
        return [as_density(self.density, data, self.name)] * len(versions)


def as_densities(found: Sequence[Any], data: StackData, name: str) -> list[Density]:
    """Return what a candidate returned as densities; equal ones stay one object."""
    different = {id(one): as_density(one, data, name) for one in found}
    return [different[id(one)] for one in found]


def as_density(own: Any, data: StackData, name: str) -> Density:
    """Return a posterior or anything else as a density, tried on two pairs.

    Raises:
        InvalidInputError: If the shapes of what it returns do not fit.
        UnsupportedPosteriorError: If it has no density, belongs to a batch, or has
            other shapes of theta or x.
    """
    theta, x = data.pairs.mean[:2], data.pairs.x[:2]
    if isinstance(own, NeuralPosterior):
        if not getattr(own, "is_amortised", True):
            raise UnsupportedPosteriorError(
                f"Expected the candidate {name!r} to answer any x; got a posterior "
                "that belongs to a batch."
            )
        own = density_of(own, what=f"the candidate {name!r}")
    if isinstance(own, Prior):
        return Prior(own.prior, x.shape[1:])  # that of no observation in particular
    if not isinstance(own, Density):
        return Given(own, theta, x)
    shapes = own.condition_shape, own.input_shape
    if shapes != (x.shape[1:], theta.shape[1:]):
        raise UnsupportedPosteriorError(
            f"Expected the candidate {name!r} to map x {tuple(x.shape[1:])} to theta "
            f"{tuple(theta.shape[1:])}; got x {tuple(shapes[0])} and theta "
            f"{tuple(shapes[1])}."
        )
    return own


# What a correction is called, and what the data need for it, in words.
NAMES: dict[Space, str] = {
    "embedding": "discrepancy",
    "input": "discrepancy (input)",
    "tuned": "discrepancy (tuned)",
}
NEEDS: dict[Space, str] = {
    "embedding": "",
    "input": "short x without NaN, and an embedding net",
    "tuned": "long x, 3 folds",
}


class CorrectingCandidate(Candidate):
    """A candidate that corrects simulations; ``space`` says what, None nothing."""

    space: Space | None

    def suits(self, data: StackData) -> bool:
        """Tell whether x is a short vector, or else there are folds enough to tune."""
        # A short vector is corrected as it is, so that tuned nets add nothing.
        if self.space == "tuned":
            return not data.reads_summaries and len(data.folds) > 2
        return self.space != "input" or data.reads_summaries

    def check(self, data: StackData) -> None:
        """Raise if x is too long, or for ``space="input"`` no vector without NaN."""
        if self.space is not None:
            network_of(data.estimator, self.space)
        if self.space == "input":
            as_batch("x", data.pairs.x)
            as_batch("x of simulations", data.simulations[1])


class DiscrepancyCandidate(CorrectingCandidate):
    """NPE trained on corrected simulations, as learned from the pairs.

    See :class:`~sbi_rope.discrepancy.DiscrepancyNPE`.

    Args:
        space: What is corrected: the embedding h(x), the input x, or the embedding
            by tuned nets.
        learn_prior: Whether the distribution of parameters is learned from the pairs.
    """

    family = "discrepancy"

    def __init__(self, *, space: Space = "embedding", learn_prior: bool = True) -> None:
        check("space", space, Space)
        check("learn_prior", learn_prior, bool)
        self.space, self.learns_prior, self.needs = space, learn_prior, NEEDS[space]
        self.name = NAMES[space] + ("" if learn_prior else ", given prior")

    def fit(self, data: StackData, versions: Sequence[Tensor]) -> list[Density]:
        """Train NPE on corrected simulations."""
        flow, members = started(
            data, versions, self.space, learn_prior=self.learns_prior
        )
        # Other spaces have the same flow for all parts of a version.
        several = None if self.space == "tuned" else 1
        return [flow[numbers[:several]] for numbers in members]


def corrected(
    data: StackData, versions: Sequence[Tensor], space: Space, *, learn_prior: bool
) -> Correction:
    """Return NPE trained on corrected simulations, a copy for each version."""
    key = space, learn_prior, key_of(versions)
    if key not in data.kept:
        z_s = data.simulations[1] if space == "input" else data.embedded
        simulations = data.simulations[0], z_s
        if space == "tuned":
            nets = tuned(data, versions)
            z = [nets.held_out(rows, data) for rows in versions]
        else:
            net = network_of(data.estimator, space)
            z = [embed(net, data.pairs.x[rows]) for rows in versions]
        fitted: list[Version] = [
            fit_version(
                data.pairs[rows],
                of_rows,
                data.moments(rows, space),
                simulations,
                data.model,
                learn_prior=learn_prior,
            )
            for of_rows, rows in zip(z, versions, strict=True)
        ]
        data.kept[key] = correct_flow(
            data.estimator,
            simulations,
            fitted,
            space=space,
            in_a_stack=True,
            show_progress_bars=data.show,
        )
    return data.kept[key]


@dataclass(frozen=True, eq=False)
class Tuned:
    """Embedding nets that are tuned on sets of pairs."""

    nets: Ensemble
    number: dict[Any, int]  # of the net that was tuned on a set of rows

    def of(self, rows: Tensor, data: StackData) -> list[int]:
        """Return the numbers of the nets that do not see each part of some rows."""
        return [self.number[key_of([seen])] for seen, _ in _seen(rows, data)]

    def held_out(self, rows: Tensor, data: StackData) -> Tensor:
        """Return the embeddings of pairs by nets that have not seen them."""
        z = data.embedded.new_empty(len(data), data.embedded.shape[1])
        parts = [part for _, part in _seen(rows, data)]
        for number, part in zip(self.of(rows, data), parts, strict=True):
            z[part] = embed(self.nets.member(number), data.pairs.x[part])
        return z[rows]


def _seen(rows: Tensor, data: StackData) -> list[tuple[Tensor, Tensor]]:
    """Return what is seen and what is not; one person alone is both."""
    return data.holdouts(rows) or [(rows, rows)]


def tuned(data: StackData, versions: Sequence[Tensor]) -> Tuned:
    """Return nets tuned on each version without each of its parts, with rehearsal."""
    key = "tuned", key_of(versions)
    if key not in data.kept:
        sets = {
            key_of([seen]): seen for rows in versions for seen, _ in _seen(rows, data)
        }
        with without_warning_of_few_pairs():
            nets, _ = TUNING.tuned(
                data.embedding_net,
                data.pairs.x,
                [data.targets(rows) for rows in sets.values()],
                list(sets.values()),
                groups=data.pairs.group,
                weights=data.pairs.weight,
                draw_simulations=lambda count: data.simulations[1][:count],
                show_progress_bars=data.show,
            )
        data.kept[key] = Tuned(nets, {rows: number for number, rows in enumerate(sets)})
    return data.kept[key]


def started(
    data: StackData,
    versions: Sequence[Tensor],
    space: Space | None,
    *,
    learn_prior: bool = True,
) -> tuple[Flow, list[list[int]]]:
    """Return NPE, corrected or not, for each part of each version; their numbers."""
    numbers: list[list[int]] = []
    of_version: list[int] = []
    for version, rows in enumerate(versions):
        first, count = len(of_version), len(_seen(rows, data))
        numbers.append([*range(first, first + count)])
        of_version += [version] * count
    if space is None:
        flow = Flow.of([data.estimator])
        return flow.made_of([(0, 0)] * len(of_version)), numbers
    found = corrected(data, versions, space, learn_prior=learn_prior)
    if space == "embedding":
        return found.flow.behind_one_net(of_version), numbers
    of_nets, nets = [min(v, len(found.flow.nets) - 1) for v in of_version], None
    if space == "tuned":
        of_parts = tuned(data, versions)
        of_nets = [number for rows in versions for number in of_parts.of(rows, data)]
        nets = of_parts.nets.then(found.constants)
    members = list(zip(of_nets, of_version, strict=True))
    return found.flow.made_of(members, nets), numbers


# How NPE is fine-tuned. Behind a corrected x all parameters were trained already, and a
# smaller rate is enough. Chosen on calibration data, see benchmarks/choices.md.
LEARNING_RATE, LEARNING_RATE_OF_INPUT = 1e-3, 3e-4
# With rehearsal, and pairs with different parameters that it needs: on calibration data
# it was worse than fine-tuned NPE with 50, and better with 200.
REHEARSED, MIN_TO_REHEARSE = replace(FINETUNING, stop_after_epochs=10), 100


class FinetunedCandidate(CorrectingCandidate):
    r"""NPE, unchanged or corrected, whose parameters are then trained on the pairs.

    It is the average of several nets. Each of them holds out another part of the
    pairs, to know when to stop training. Behind a corrected embedding h(x) only the
    density is trained.

    Args:
        space: What is corrected in the NPE that it starts from; nothing if None.
        rehearse: Whether to train on simulations, too, as
            :class:`~sbi_rope.baselines.JointNPE` does from scratch. It is for images,
            series and sets of trials, where the embedding net has to learn what
            simulations do not show. A version then holds out a single part.
    """

    def __init__(self, *, space: Space | None = None, rehearse: bool = False) -> None:
        check("space", space, Space | None)
        check("rehearse", rehearse, bool)
        self.space, self.rehearse = space, rehearse
        self.name = self.family = "fine-tuned NPE"
        self.needs = f"{MIN_TO_REHEARSE} pairs, long x" if rehearse else "3 folds"
        if space is not None:
            self.family = "discrepancy, fine-tuned"
            self.name = f"{NAMES[space]}, fine-tuned"
            self.needs = NEEDS[space] or "long x"
        self.name += ", rehearsed" if rehearse else ""

    def suits(self, data: StackData) -> bool:
        """Tell whether there are parts to hold out, and the starting NPE applies."""
        if len(data.folds) < 3:
            return False
        if self.rehearse:
            return data.pairs.num_groups >= MIN_TO_REHEARSE and not data.is_short
        if self.space == "embedding":  # x itself is corrected otherwise
            return not data.reads_summaries
        return super().suits(data)

    def fit(self, data: StackData, versions: Sequence[Tensor]) -> list[Density]:
        """Train one net without each part of the pairs of each version."""
        flow, members = started(data, versions, self.space)
        starts: list[Density] = [flow[numbers] for numbers in members]
        jobs, of_version = [], []
        for version, rows in enumerate(versions):
            nodes = data.nodes(rows, starts[version])
            own = list(zip(members[version], data.holdouts(rows), strict=False))
            if self.rehearse and own:
                own = [own[version % len(own)]]
            of_version.append([*range(len(jobs), len(jobs) + len(own))])
            jobs += [(*job, nodes) for job in own]
        if not jobs:  # there is nothing to hold out
            return starts
        numbers, splits, labels = zip(*jobs, strict=True)
        flow = flow[numbers]
        rate = LEARNING_RATE_OF_INPUT if self.space == "input" else LEARNING_RATE
        finetune_flow(
            flow,
            labels,
            data.pairs.x,
            splits,
            training=REHEARSED if self.rehearse else FINETUNING,
            learning_rates=[rate] * len(jobs),
            weights=data.pairs.weight,
            rehearsed=data.simulations if self.rehearse else None,
            # The net h has not changed, so that it is enough to train the density.
            only_densities=self.space == "embedding",
            show_progress_bars=data.show,
        )
        trained = zip(of_version, starts, strict=True)
        return [flow[own] if own else start for own, start in trained]


# With fewer pairs the candidate is left out.
MIN_TO_REGRESS = 10


class RegressionCandidate(Candidate):
    """A Gaussian process of the labels, which needs no simulator.

    See :class:`~sbi_rope.density.GaussianProcess`.

    Args:
        space: What it depends on: x itself, with ``"input"``, or the embedding h(x).
    """

    name = family = "regression"
    needs = f"{MIN_TO_REGRESS} exact labels of continuous parameters, x without NaN"

    def __init__(self, *, space: Literal["embedding", "input"] = "input") -> None:
        check("space", space, Literal["embedding", "input"])
        self.embeds = space == "embedding"
        if self.embeds:
            self.name += " (embedding)"
            self.needs += ", an embedding net"

    def suits(self, data: StackData) -> bool:
        """Tell whether the data are as it needs them."""
        theta, pairs = data.pairs.mean, data.pairs
        return (
            (has_parameters(data.embedding_net) or not self.embeds)
            and pairs.num_groups >= MIN_TO_REGRESS
            and pairs.are_exact
            and bool((theta != theta[0]).any(dim=0).all())
            and bool(torch.isfinite(pairs.x).all())
            and not any(isinstance(m, MixedDensity) for m in data.estimator.modules())
        )

    def fit(self, data: StackData, versions: Sequence[Tensor]) -> list[Density]:
        """Fit a process to each version of the pairs."""
        pairs, net = data.pairs, None
        if self.embeds:
            net = data.embedding_net
        elif pairs.x.ndim == 2 and torch.isfinite(x_s := data.simulations[1]).all():
            # Entries that never vary in simulations are ignored, as by all candidates.
            net = SimulatedConstants(Standardisation(x_s.double()))
        return [
            GaussianProcess(
                pairs.mean[rows],
                pairs.x[rows],
                weights=pairs.shared_weight[rows],
                groups=pairs.group[rows],
                net=net,
            )
            for rows in versions
        ]


# Observations without labels that the candidate needs, and those that it takes: more
# add nothing. With more entries of x, its search takes long.
MIN_OBSERVATIONS, MAX_OBSERVATIONS, MAX_ENTRIES = 30, 200, 10


class UnlabelledCandidate(CorrectingCandidate):
    """NPE trained on corrected simulations, as learned from unlabelled x, too.

    It assumes that the parameters of the observations follow the prior, see
    ``sbi_rope.discrepancy.unlabelled``. The labels decide about its weight.

    Args:
        x_o: Real observations, shape ``(n_o, l)``, of which up to 200 are used. Those
            of the calibration pairs should not be among them, so that the scores are
            those of new observations. The stack may be asked about others, too.

    Raises:
        InvalidInputError: If x_o holds no numbers. Its shape is checked in the stack.
    """

    name = "discrepancy, with x_o"
    learns_prior = False
    needs = f"{MIN_OBSERVATIONS} observations of {MAX_ENTRIES} numbers, exact labels"
    space = "input"

    def __init__(self, x_o: Tensor) -> None:
        self.x_o = as_numbers("x_o", x_o).clone()

    def suits(self, data: StackData) -> bool:
        """Tell whether there are enough observations, of few entries."""
        return (
            len(self.x_o) >= MIN_OBSERVATIONS
            and data.pairs.are_exact
            and data.compares_entries
            and data.pairs.x.shape[1] <= MAX_ENTRIES
            and bool(torch.isfinite(self.x_o).all())
        )

    def check(self, data: StackData) -> None:
        """Raise for observations of another shape, and those that are not finite."""
        as_batch("x_o", data.rope.npe.as_x("x_o", self.x_o))
        super().check(data)

    def fit(self, data: StackData, versions: Sequence[Tensor]) -> list[Density]:
        """Train NPE on corrected simulations."""
        x_s = data.simulations[1]
        unit = Standardisation(x_s.double())
        chosen = torch.randperm(len(self.x_o))[:MAX_OBSERVATIONS]
        rows = torch.cat(list(versions)).unique()
        weight = data.pairs.shared_weight[rows]
        is_seen = torch.stack([torch.isin(rows, seen) for seen in versions])
        found = fit_unlabelled(
            unit(data.pairs.x[rows].double()),
            in_units(data.moments(rows, "input"), unit),
            weight.where(is_seen, 0.0).double(),
            unit(self.x_o[chosen].to(x_s).double()),
            Marginal.of(unit(x_s.double())),
            show_progress_bars=data.show,
        )
        flow = correct_flow(
            data.estimator,
            data.simulations,
            [(one, None) for one in found],
            space="input",
            in_a_stack=True,
            show_progress_bars=data.show,
        ).flow
        return [flow[[version]] for version in range(len(versions))]


def default_candidates(
    rope: RoPE | None = None, x_o: Tensor | None = None, *, learn_prior: bool = True
) -> tuple[Candidate, ...]:
    """Return the prior, NPE, fine-tuned NPE, discrepancy models, and regressions.

    Args:
        rope: A RoPE with its calibration pairs. Candidates that these data do not
            allow or need are left out, as in :func:`stack`. None returns all.
        x_o: Real observations without labels, shape ``(n_o, *event)``, other than those
            of the pairs. They add a discrepancy that is learned from them, too, unless
            they are fewer than 30 or no vectors of at most ten entries, or labels are
            not exact.
        learn_prior: Whether candidates may learn from the pairs how parameters are
            distributed. They should if the pairs are drawn like the observations to be
            inferred. With False, discrepancy models keep the prior of NPE, and others
            that are trained on pairs are left out.

    Raises:
        InvalidInputError: If an argument has the wrong type, or, with a rope, x_o has
            the wrong shape or device, is empty or not finite.
        NotReadyError: If ``rope`` has fewer than two calibration pairs.
    """
    check("learn_prior", learn_prior, bool)
    if rope is None:
        return _all_candidates(x_o, learn_prior=learn_prior)
    check("rope", rope, RoPE)
    x_o = None if x_o is None else rope.npe.as_x("x_o", x_o)
    data = StackData(rope, num_folds=NUM_FOLDS, seed=0, show_progress_bars=False)
    return _suitable_candidates(data, x_o, learn_prior=learn_prior)


def _suitable_candidates(
    data: StackData, x_o: Tensor | None, *, learn_prior: bool = True
) -> tuple[Candidate, ...]:
    """Return the default candidates that the data allow; warn if x_o adds none."""
    known = _all_candidates(x_o, learn_prior=learn_prior)
    chosen = tuple(candidate for candidate in known if candidate.suits(data))
    if x_o is not None and known[-1] not in chosen:
        warn_user(
            f"`x_o` adds no candidate, which takes {MIN_OBSERVATIONS} observations of "
            f"at most {MAX_ENTRIES} numbers, and exact labels; got {len(x_o)} of shape "
            f"{tuple(x_o.shape[1:])}. It is compared with the pairs."
        )
    return chosen


def left_out(candidates: Sequence[Candidate], x_o: Tensor | None) -> str:
    """Return which default candidates are not among some, and what they need."""
    names = {candidate.name for candidate in candidates}
    return "; ".join(
        f"{one.name} (needs {one.needs})"
        for one in _all_candidates(x_o, learn_prior=True)
        if one.name not in names
    )


def _all_candidates(x_o: Tensor | None, *, learn_prior: bool) -> tuple[Candidate, ...]:
    spaces: tuple[Space, ...] = ("embedding", "input", "tuned")
    candidates: list[Candidate] = [
        PriorCandidate(),
        NPECandidate(),
        FinetunedCandidate(),
        *(DiscrepancyCandidate(space=one, learn_prior=learn_prior) for one in spaces),
        *(FinetunedCandidate(space=one) for one in spaces),
        FinetunedCandidate(rehearse=True),
        RegressionCandidate(),
        RegressionCandidate(space="embedding"),
        *([] if x_o is None else [UnlabelledCandidate(x_o)]),
    ]
    return tuple(one for one in candidates if learn_prior or not one.learns_prior)


def chosen_candidates(
    candidates: Sequence[Any] | None, data: StackData, x_o: Tensor | None
) -> tuple[Candidate, ...]:
    """Return the candidates of a user, or those by default, all of which can be used.

    Raises:
        InvalidInputError: If there is none, two have the same name, or entries of x are
            missing that one of them corrects.
        UnsupportedPosteriorError: If one that is given cannot be used.
    """
    check("candidates", candidates, Sequence | None)
    if candidates is None:
        candidates = _suitable_candidates(data, x_o)
    chosen = tuple(
        one if isinstance(one, Candidate) else GivenCandidate(one) for one in candidates
    )
    names = [candidate.name for candidate in chosen]
    if not names or len(set(names)) < len(names) or "stack" in names:
        raise InvalidInputError(
            "Expected `candidates` with different names, none of them 'stack'; got "
            f"{names}. Name a density with `GivenCandidate(density, name)`."
        )
    for one in chosen:
        one.check(data)
    return chosen
