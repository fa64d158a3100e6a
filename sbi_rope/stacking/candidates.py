"""The candidates that a stack can be made of, and those that it is made of by default.

A candidate is a class with a name and :meth:`Candidate.fit`. Nothing else knows its
type.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from sbi_rope.data.pairs import without_warning_of_few_pairs
from sbi_rope.density import Density, Flow, GaussianProcess, Prior, density_of
from sbi_rope.discrepancy.correction import (
    MOST_ENTRIES,
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
from sbi_rope.utils.errors import UnsupportedPosteriorError
from sbi_rope.utils.settings import check
from sbi_rope.utils.tensors import as_batch, as_numbers

Parts = Sequence[tuple[Tensor, Tensor]]  # the rows to train on, and those held out


class Candidate(ABC):
    """A candidate of a stack, in ten lines: give it a name and define :meth:`fit`.

    Attributes:
        name: Its name in the report.
        learns_prior: Whether it learns from the pairs how parameters are distributed,
            as all training on them does.
    """

    name: str
    learns_prior: bool = True

    def suits(self, data: StackData) -> bool:
        """Tell whether the data allow it. The default stack leaves it out if not."""
        return True

    @abstractmethod
    def fit(self, data: StackData, versions: Sequence[Tensor]) -> list[Density]:
        """Train all versions at once.

        Args:
            data: The pairs and simulations.
            versions: For each version, the rows of the pairs that it may see.

        Returns:
            For each version a density, or an amortised posterior. One that sees no
            pairs may be that of all versions.
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
        density: An amortised posterior of NPE or of this package, or a
            :class:`~sbi_rope.density.Density`.
        name: Its name in the report; that of its class if None.
    """

    learns_prior = False

    def __init__(self, density: Any, name: str | None = None) -> None:
        self.density = density
        self.name = type(density).__name__ if name is None else name

    def fit(self, data: StackData, versions: Sequence[Tensor]) -> list[Density]:
        """Return the density for all versions."""
        return [self.density] * len(versions)


def as_density(own: Any, data: StackData, name: str) -> Density:
    """Return a posterior as a density of the shapes of the pairs."""
    theta, x = data.pairs.mean, data.pairs.x
    if isinstance(own, NeuralPosterior):
        own = density_of(own, what=f"the candidate {name!r}")
    if not isinstance(own, Density):
        raise UnsupportedPosteriorError(
            f"Expected the candidate {name!r} to be a posterior or a "
            f"`sbi_rope.density.Density`; got {type(own).__name__}."
        )
    shapes = tuple(own.condition_shape), tuple(own.input_shape)
    if shapes != (expected := (tuple(x.shape[1:]), tuple(theta.shape[1:]))):
        raise UnsupportedPosteriorError(
            f"Expected the candidate {name!r} to have shapes of x and theta "
            f"{expected}; got {shapes}."
        )
    own.embed(x[:2])  # raises if it belongs to the observations of a batch
    return own


# NPE of corrected simulations ---------------------------------------------------------


class CorrectingCandidate(Candidate):
    """A candidate that corrects simulations; ``space`` says what, None nothing."""

    space: Space | None

    def name_of_space(self) -> str:
        """Return what the correction is called."""
        return "discrepancy" + f" ({self.space})" * (self.space != "embedding")

    def suits(self, data: StackData) -> bool:
        """Tell whether what it corrects is short, and what only nets help is long."""
        if self.space == "input":
            return data.reads_summaries
        # A short vector is corrected as it is, so that tuned nets add nothing.
        if self.space == "tuned" and (data.reads_summaries or len(data.folds) < 3):
            return False
        is_short = data.pairs.x[0].numel() <= MOST_ENTRIES
        return self.space is None or is_short or has_parameters(data.embedding_net)


class DiscrepancyCandidate(CorrectingCandidate):
    """NPE trained on simulations that are corrected as learned from the pairs.

    See :class:`~sbi_rope.methods.DiscrepancyNPE`. Corrected is the embedding h(x),
    the input x, or the embedding by tuned nets.
    """

    def __init__(self, space: Space = "embedding", *, learn_prior: bool = True) -> None:
        self.space, self.learns_prior = space, learn_prior
        self.name = self.name_of_space() + ("" if learn_prior else ", given prior")

    def fit(self, data: StackData, versions: Sequence[Tensor]) -> list[Density]:
        """Train NPE on corrected simulations."""
        learned = {"learn_prior": self.learns_prior}
        flow, members = started(data, versions, self.space, **learned)
        # Other spaces have the same flow for all parts of a version.
        several = None if self.space == "tuned" else 1
        return [flow[numbers[:several]] for numbers in members]


def started(
    data: StackData,
    versions: Sequence[Tensor],
    space: Space | None,
    *,
    learn_prior: bool = True,
) -> tuple[Flow, list[list[int]]]:
    """Return NPE, corrected or not, for each part of each version; their numbers."""
    # A single person is both seen and held out.
    parts = [data.holdouts(rows) or [(rows, rows)] for rows in versions]
    of_version = [v for v, some in enumerate(parts) for _ in some]
    each = torch.arange(len(of_version)).split([*map(len, parts)])
    numbers = [some.tolist() for some in each]
    if space is None:
        flow = Flow.of([data.estimator])
        return flow.made_of([(0, 0)] * len(of_version)), numbers
    if (key := (space, learn_prior, key_of(versions))) in data.kept:
        return data.kept[key], numbers
    nets, of_nets = None, []
    if space == "tuned":
        nets, of_nets, z = tuned(data, parts)
        z = [of_pairs[rows] for of_pairs, rows in zip(z, versions, strict=True)]
    else:
        net = network_of(data.estimator, space)
        # What the net reads may hold NaN.
        z = [as_batch("x", embed(net, data.pairs.x[rows])) for rows in versions]
    z_s = data.simulations[1] if space == "input" else data.embedded
    simulations = data.simulations[0], as_batch("x of simulations", z_s)
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
    corrected, constants, _ = correct_flow(
        data.estimator,
        simulations,
        fitted,
        space=space,
        in_a_stack=True,
        show_progress_bars=data.show,
    )
    if space == "embedding":
        flow = corrected[of_version]
    else:
        nets = nets.then(constants) if nets else None
        of_nets = of_nets or [min(v, len(corrected.nets) - 1) for v in of_version]
        flow = corrected.made_of([*zip(of_nets, of_version, strict=True)], nets)
    data.kept[key] = flow
    return flow, numbers


def tuned(
    data: StackData, versions: Sequence[Parts]
) -> tuple[Ensemble, list[int], list[Tensor]]:
    """Tune nets, with rehearsal, on what is seen when each part is held out.

    There are also the number of the net of each part and, for each version, embeddings
    of all pairs by nets that have not seen them.
    """
    sets = {key_of([seen]): seen for parts in versions for seen, _ in parts}
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
    place = {key: number for number, key in enumerate(sets)}
    numbers, held_out = [], []
    for parts in versions:
        z = data.embedded.new_empty(len(data), data.embedded.shape[1])
        for seen, part in parts:
            numbers.append(place[key_of([seen])])
            z[part] = embed(nets.member(numbers[-1]), data.pairs.x[part])
        held_out.append(z)
    return nets, numbers, held_out


# How NPE is fine-tuned. Behind a corrected x all parameters were trained already, and a
# smaller rate is enough. Chosen on calibration data, see benchmarks/choices.md.
LEARNING_RATE, LEARNING_RATE_OF_INPUT = 1e-3, 3e-4
# Nodes at which the density of a label is computed that is not exact.
NUM_NODES = 64
# With rehearsal, and pairs with different parameters that it needs: on calibration data
# it was worse than fine-tuned NPE with 50, and better with 200.
REHEARSED, MIN_TO_REHEARSE = replace(FINETUNING, stop_after_epochs=10), 100


class FinetunedCandidate(CorrectingCandidate):
    """NPE, corrected in a space or not, whose parameters are then trained on the pairs.

    It is the average of several nets. Each of them holds out another part of the
    pairs, to know when to stop training. Behind a corrected embedding h(x) only the
    density is trained. With ``rehearse`` it is trained on simulations, too, as
    :class:`~sbi_rope.baselines.JointNPE` is from scratch, and a version holds out a
    single part. This is for images, series and sets of trials, where the embedding net
    has to learn what simulations do not show.
    """

    def __init__(self, space: Space | None = None, *, rehearse: bool = False) -> None:
        self.space, self.rehearse = space, rehearse
        self.name = f"{self.name_of_space()}, fine-tuned" if space else "fine-tuned NPE"
        self.name += ", rehearsed" * rehearse

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
            nodes = data.nodes(rows, [starts[version]], NUM_NODES)[data.place(rows)]
            own = [*zip(members[version], data.holdouts(rows), strict=False)]
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


# Observations without labels that the candidate needs, and those that it takes: more
# add nothing. With more entries of x, its search takes long.
MIN_OBSERVATIONS, MAX_OBSERVATIONS, MAX_ENTRIES = 30, 200, 10


class UnlabelledCandidate(Candidate):
    """NPE trained on corrected simulations, as learned from unlabelled x, too.

    It assumes that the parameters of the observations follow the prior, see
    ``sbi_rope.discrepancy.unlabelled``. The labels decide about its weight. Those of
    the pairs should not be among ``x_o`` ``(n_o, l)``, of which up to 200 are used.
    """

    name = "discrepancy, with x_o"
    learns_prior = False

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

    def fit(self, data: StackData, versions: Sequence[Tensor]) -> list[Density]:
        """Train NPE on corrected simulations."""
        x_o = as_batch("x_o", data.rope.npe.as_x("x_o", self.x_o))
        x_s = data.simulations[1]
        unit = Standardisation(x_s.double())
        chosen = torch.randperm(len(x_o))[:MAX_OBSERVATIONS]
        rows = torch.cat(list(versions)).unique()
        weight = data.pairs.shared_weight[rows]
        is_seen = torch.stack([torch.isin(rows, seen) for seen in versions])
        found = fit_unlabelled(
            unit(data.pairs.x[rows].double()),
            in_units(data.moments(rows, "input"), unit),
            weight.where(is_seen, 0.0).double(),
            unit(x_o[chosen].to(x_s).double()),
            Marginal.of(unit(x_s.double())),
            show_progress_bars=data.show,
        )
        flow, _, _ = correct_flow(
            data.estimator,
            data.simulations,
            [(one, None) for one in found],
            space="input",
            in_a_stack=True,
            show_progress_bars=data.show,
        )
        return [flow[[version]] for version in range(len(versions))]


# Without the simulator ----------------------------------------------------------------

# With fewer pairs the candidate is left out.
MIN_TO_REGRESS = 10


class RegressionCandidate(Candidate):
    """A Gaussian process from x, or from h(x), which needs no simulator.

    See :class:`~sbi_rope.density.GaussianProcess`.
    """

    def __init__(self, *, embeds: bool = False) -> None:
        self.embeds = embeds
        self.name = "regression (embedding)" if embeds else "regression"

    def suits(self, data: StackData) -> bool:
        """Tell whether labels are exact and continuous, and x has no missing entry."""
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


# Those of a default stack -------------------------------------------------------------


def default_candidates(
    rope: RoPE | None = None, x_o: Tensor | None = None, *, learn_prior: bool = True
) -> tuple[Candidate, ...]:
    """Return the prior, NPE, fine-tuned NPE, discrepancy models, and regressions.

    Args:
        rope: A RoPE with its calibration pairs. Candidates that these data do not
            allow or need are left out, as in :func:`stack`. None returns all.
        x_o: Real observations without labels, shape ``(n_o, *event)``, other than those
            of the pairs. They add a discrepancy that is learned from them, too, if they
            are 30 vectors or more of at most ten entries, and labels are exact.
        learn_prior: Whether candidates may learn from the pairs how parameters are
            distributed. They should if the pairs are drawn like the observations to be
            inferred. With False, discrepancy models keep the prior of NPE, and others
            that are trained on pairs are left out.

    Raises:
        InvalidInputError: If x_o has the wrong shape, or is not finite.
        NotReadyError: If ``rope`` has fewer than two calibration pairs.
    """
    check("rope", rope, RoPE | None)
    check("learn_prior", learn_prior, bool)
    spaces: tuple[Space, ...] = ("embedding", "input", "tuned")
    candidates: list[Candidate] = [
        PriorCandidate(),
        NPECandidate(),
        FinetunedCandidate(),
        *(DiscrepancyCandidate(one, learn_prior=learn_prior) for one in spaces),
        *(FinetunedCandidate(one) for one in spaces),
        FinetunedCandidate(rehearse=True),
        RegressionCandidate(),
        RegressionCandidate(embeds=True),
    ]
    if x_o is not None:
        x_o = x_o if rope is None else rope.npe.as_x("x_o", x_o)
        candidates.append(UnlabelledCandidate(x_o))
    candidates = [one for one in candidates if learn_prior or not one.learns_prior]
    if rope is None:
        return tuple(candidates)
    data = StackData(rope, num_folds=NUM_FOLDS, seed=0, show_progress_bars=False)
    return tuple(one for one in candidates if one.suits(data))
