"""Faults that give wrong numbers without an error, each of which a test has to notice.

    python -m tests.faults          # all of them, some 15 minutes on two cores
    python -m tests.faults tau      # those with a word in their sentence

A fault replaces one function, or constant, of the package. The tests of its room then
run until the first fails. To add one, add a row: a sentence, the place, what takes its
place, and where it has to be noticed.
"""

import contextlib
import functools
import inspect
import io
import multiprocessing
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import torch

import sbi_rope.baselines  # noqa: F401  (before the processes part)

TESTS = Path(__file__).parent
Wrong = Callable[[Any], Any]


@dataclass(frozen=True)
class Fault:
    """What is wrong, the place as "module:name", its replacement, and the tests."""

    what: str
    place: str
    wrong: Wrong
    tests: str

    def make(self) -> None:
        """Make the fault in this process, wherever the function has been imported."""
        module, _, path = self.place.partition(":")
        owner: Any = import_module(f"sbi_rope.{module}")
        *classes, name = path.split(".")
        for one in classes:
            owner = getattr(owner, one)
        right = inspect.getattr_static(owner, name)
        made = self.wrong(getattr(right, "func", getattr(right, "__func__", right)))
        if isinstance(right, property | functools.cached_property):
            made = property(self.wrong(getattr(right, "fget", None) or right.func))
        if isinstance(right, classmethod | staticmethod):
            made = type(right)(made)
        setattr(owner, name, made)
        for other in [] if classes else list(sys.modules.values()):
            if getattr(other, "__name__", "").startswith("sbi_rope") and (
                getattr(other, name, None) is right
            ):
                setattr(other, name, made)


def result(change: Callable[[Any], Any]) -> Wrong:
    """Change what a function returns."""

    def of(right: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(right)
        def wrong(*args: Any, **options: Any) -> Any:
            return change(right(*args, **options))

        return wrong

    return of


def argument(**changes: Callable[[Any], Any]) -> Wrong:
    """Change some of the arguments of a function, by their names."""

    def of(right: Callable[..., Any]) -> Callable[..., Any]:
        signature = inspect.signature(right)

        @functools.wraps(right)
        def wrong(*args: Any, **options: Any) -> Any:
            given = signature.bind(*args, **options)
            given.apply_defaults()
            for name, change in changes.items():
                given.arguments[name] = change(given.arguments[name])
            return right(*given.args, **given.kwargs)

        return wrong

    return of


def value(new: Any) -> Wrong:
    """Replace a constant."""
    return lambda right: new


FAULTS = [
    # --- coupling ---
    Fault(
        "The target of the column marginal is not divided by tau",
        "coupling.sinkhorn:marginal_error",
        argument(tau=lambda tau: 1.0),
        "unit/test_coupling.py",
    ),
    Fault(
        "The prior of simulations is always trusted, as with tau = 1",
        "coupling.coupling:SinkhornCoupler.couple",
        argument(self=lambda coupler: replace(coupler, tau=1.0)),
        "unit/test_coupling.py",
    ),
    Fault(
        "The cost is the squared distance",
        "coupling.sinkhorn:distances",
        result(torch.square),
        "unit/test_coupling.py",
    ),
    Fault(
        "Weights are normalised over observations instead of simulations",
        "coupling.coupling:Coupling.rows",
        result(lambda weights: weights / weights.sum(dim=0)),
        "unit/test_coupling.py",
    ),
    Fault(
        "POT is given another regularisation of the marginal",
        "coupling.sinkhorn:solve_pot",
        argument(tau=lambda tau: tau * tau),
        "unit/test_coupling.py",
    ),
    Fault(
        "Gamma is in units of twice the distance between simulations",
        "coupling.coupling:_median_distance",
        result(lambda distance: 2 * distance),
        "unit/test_coupling.py",
    ),
    # --- pairs and labels ---
    Fault(
        "Training sees the pairs that are held out",
        "data.pairs:split_pairs",
        result(lambda rows: (torch.cat(rows), rows[1])),
        "unit/test_data.py unit/test_finetuning.py",
    ),
    Fault(
        "Recordings of a person are on both sides of a split",
        "data.pairs:groups_of",
        result(lambda groups: torch.arange(len(groups))),
        "unit/test_data.py",
    ),
    Fault(
        "Each of several recordings of a person counts as a pair",
        "data.pairs:Pairs.shared_weight",
        lambda right: lambda self: self.weight,
        "integration/test_stacking_report.py unit/test_data.py",
    ),
    Fault(
        "The effective number of pairs ignores their weights",
        "data.pairs:effective_number",
        argument(weight=torch.ones_like),
        "unit/test_data.py unit/test_metrics.py unit/test_labels.py",
    ),
    Fault(
        "Labels have half of their noise",
        "data.labels:draws_of",
        argument(pairs=lambda pairs: replace(pairs, std=pairs.std / 2)),
        "unit/test_labels.py",
    ),
    Fault(
        "The density of a label takes half of its noise",
        "data.labels:nodes_of",
        argument(pairs=lambda pairs: replace(pairs, std=pairs.std / 2)),
        "unit/test_labels.py",
    ),
    Fault(
        "Nodes of labels outside the prior count",
        "data.labels:nodes_of",
        result(lambda n: replace(n, log_weights=n.log_weights.clamp_min(-3.0))),
        "unit/test_labels.py",
    ),
    Fault(
        "The density of a label is the geometric mean over its nodes",
        "data.pairs:Nodes.log_mean",
        lambda right: lambda self, log_q: log_q.double().mean(dim=1),
        "unit/test_labels.py",
    ),
    Fault(
        "Labels that are rounded to a bound are improbable under the prior",
        "data.parameters:SETS_CUT_OFF",
        value(1e12),
        "unit/test_discrepancy_parameters.py",
    ),
    Fault(
        "Pairs that follow the prior are said not to",
        "data.parameters:IMPROBABLE",
        value(0.99),
        "unit/test_discrepancy_parameters.py integration/test_stacking_report.py",
    ),
    Fault(
        "Equal parameters of simulations have the lowest of their ranks",
        "data.parameters:normal_scores",
        result(lambda scores: 0.8 * scores),
        "unit/test_discrepancy_parameters.py",
    ),
    # --- simulations ---
    Fault(
        "Simulations are made at the parameters of the pair before",
        "data.simulate:Simulated.at",
        argument(theta=lambda theta: theta.roll(1, 0)),
        "unit/test_simulate.py",
    ),
    Fault(
        "Simulations that were dropped count in the mean of a target",
        "data.simulate:Simulated.at",
        result(lambda embedded: embedded.nan_to_num()),
        "unit/test_simulate.py unit/test_rope.py",
    ),
    Fault(
        "The covariance of simulations is that of their mean",
        "data.simulate:moments",
        result(lambda m: replace(m, covariance=m.covariance / 10)),
        "unit/test_simulate.py",
    ),
    Fault(
        "Stored simulations near a label are not moved to it",
        "data.simulate:_nearest",
        argument(theta=lambda theta: theta.roll(1, 0)),
        "unit/test_simulate.py unit/test_rope.py",
    ),
    # --- fine-tuning ---
    Fault(
        "The weights of pairs are forgotten in fine-tuning",
        "rope.finetuning:side_by_side",
        argument(weights=lambda weights: None),
        "unit/test_finetuning.py contract/test_candidate.py",
    ),
    Fault(
        "Of several learning rates the smallest is taken, and not the best",
        "rope.finetuning:best_rates",
        lambda right: lambda histories, count: [*range(0, len(histories), count)],
        "contract/test_candidate.py unit/test_baselines_finetuned_npe.py",
    ),
    # --- densities ---
    Fault(
        "The tail that is left out is a hundred times as large",
        "density.coupled:without_tail",
        argument(tail_mass=lambda mass: 100 * mass),
        "contract/test_density.py",
    ),
    Fault(
        "Draws of a mixture ignore the weights of simulations",
        "density.coupled:_chosen",
        argument(weights=lambda weights: (weights > 0).to(weights)),
        "contract/test_density.py",
    ),
    Fault(
        "A mixture of densities averages their logarithms",
        "density.mixture:Mixture.log_q",
        lambda right: (
            lambda self, theta, z: sum(
                weight * part.log_q(theta, one)
                for weight, part, one in zip(self.weights, self.parts, z, strict=True)
            )
        ),
        "contract/test_density.py",
    ),
    Fault(
        "Densities are not divided by their mass inside the prior",
        "density.posterior:MixturePosterior._normaliser",
        result(torch.zeros_like),
        "contract/test_density.py contract/test_posterior.py",
    ),
    Fault(
        "The mass inside the prior is the largest of all observations",
        "density.base:Density.mass",
        result(lambda mass: mass.max().expand_as(mass)),
        "contract/test_density.py",
    ),
    Fault(
        "The noise of the Gaussian process is forgotten",
        "density.regression:_learned",
        result(lambda found: torch.cat([found[:-1], 1e-4 * found[-1:]])),
        "unit/test_regression.py",
    ),
    # --- sets ---
    Fault(
        "The rank of a guarantee is that of n pairs instead of n + 1",
        "density.sets:rank_needed",
        argument(n=lambda n: n - 1),
        "unit/test_sets.py",
    ),
    Fault(
        "The score of a set counts draws of lower density",
        "density.sets:joint_scores",
        result(lambda level: 1 - level),
        "unit/test_sets.py",
    ),
    Fault(
        "Intervals lie between ends of one rank less",
        "density.sets:marginal_ends",
        argument(scores=lambda scores: 0.9 * scores),
        "unit/test_sets.py",
    ),
    # --- discrepancy ---
    Fault(
        "Every pair of a group counts as an independent one",
        "discrepancy.posterior:independent_pairs",
        argument(correlation=lambda correlation: 0 * correlation),
        "unit/test_discrepancy_model.py",
    ),
    Fault(
        "Errors of a group are independent in the evidence",
        "discrepancy.posterior:decorrelated",
        argument(correlation=lambda correlation: 0.0),
        "unit/test_discrepancy_model.py",
    ),
    Fault(
        "Gain and offset are known exactly",
        "discrepancy.posterior:Term.sample",
        argument(self=lambda term: replace(term, row_factor=1e-3 * term.row_factor)),
        "unit/test_discrepancy_model.py",
    ),
    Fault(
        "Corrected simulations have no errors of their own",
        "discrepancy.posterior:DiscrepancyDraws.correct",
        argument(self=lambda d: d._replace(error_factor=0 * d.error_factor)),
        "unit/test_discrepancy_model.py",
    ),
    Fault(
        "Imputed means of partial labels know nothing of x",
        "discrepancy.model:_probabilities",
        result(lambda p: torch.full_like(p, 1 / p.shape[-1])),
        "unit/test_discrepancy_model.py unit/test_labels.py",
    ),
    Fault(
        "A right simulator surprises as a wrong one does",
        "discrepancy.correction:surprise",
        result(lambda found: 10 + found),
        "unit/test_discrepancy_model.py unit/test_discrepancy_none.py "
        "unit/test_discrepancy_npe.py",
    ),
    Fault(
        "The density of a right simulator forgets its noise",
        "discrepancy.posterior:log_density_of_right",
        argument(noise=lambda noise: 4 * noise),
        "unit/test_discrepancy_model.py unit/test_discrepancy_none.py",
    ),
    Fault(
        "The search for a discrepancy sees noise instead of observations",
        "discrepancy.unlabelled:fit_unlabelled",
        argument(z_o=lambda z: 2 * torch.randn_like(z)),
        "integration/test_stacking_labels.py",
    ),
    # --- stack ---
    Fault(
        "The weights that score a fold have seen its scores",
        "stacking.weights:fold_weights",
        lambda right: (
            lambda log_scores, fold, weight: (
                import_module("sbi_rope.stacking.weights")
                .stacking_weights(log_scores, pair_weights=weight)
                .expand(int(fold.max()) + 1, -1)
            )
        ),
        "integration/test_stacking.py contract/test_candidate.py "
        "unit/test_stacking_weights.py",
    ),
    Fault(
        "A version is trained on the fold that it is scored on",
        "stacking.data:StackData.without",
        lambda right: lambda self, fold, num_folds=None: torch.cat(self.folds),
        "integration/test_stacking.py contract/test_candidate.py",
    ),
    Fault(
        "The moments of the pairs are put in the wrong order",
        "stacking.data:StackData.moments",
        result(lambda moments: moments[torch.arange(len(moments)).roll(1)]),
        "contract/test_candidate.py integration/test_stacking.py "
        "unit/test_discrepancy_npe.py",
    ),
    Fault(
        "Fine-tuning trains on the part that tells it when to stop",
        "stacking.data:StackData.holdouts",
        result(lambda parts: [(torch.cat(part), part[1]) for part in parts]),
        "contract/test_candidate.py integration/test_stacking.py",
    ),
    Fault(
        "The weights of pairs are forgotten in the weights of candidates",
        "stacking.weights:stacking_weights",
        argument(pair_weights=lambda weights: None),
        "unit/test_labels.py unit/test_stacking_weights.py",
    ),
    Fault(
        "The gain of more labels is that of all of them",
        "stacking.report:LearningCurve.gain",
        argument(num_more=lambda number: 10 * number),
        "integration/test_stacking_report.py",
    ),
    Fault(
        "Sets with a guarantee are scored by a stack that has seen the pair",
        "stacking.posterior:StackedPosterior._held_out",
        result(lambda found: (found[0], [found[1][0]] * len(found[1]))),
        "unit/test_sets.py integration/test_stacking.py",
    ),
    # --- metrics and diagnosis ---
    Fault(
        "Intervals of few observations are those of many",
        "metrics.statistics:Estimate.of",
        argument(group=lambda group: None, weight=lambda weight: None),
        "unit/test_metrics.py",
    ),
    Fault(
        "Ties count as if the sample were below the parameter",
        "metrics.evaluation:estimates_and_ranks",
        argument(samples=lambda samples: samples - 1e-6),
        "unit/test_metrics.py",
    ),
    Fault(
        "The area of the coverage curve has the wrong sign",
        "metrics.evaluation:Evaluation.acauc",
        lambda right: lambda self: replace(right(self), mean=-right(self).mean),
        "unit/test_metrics.py",
    ),
    Fault(
        "Coverage by estimate is tested with the ranks of another pair",
        "metrics.evaluation:_p_value",
        argument(ranks=lambda ranks: ranks.roll(1)),
        "unit/test_metrics.py",
    ),
    Fault(
        "The energy of two sets is that of another division",
        "metrics.statistics:_energies",
        argument(member=lambda member: member.roll(1, 0)),
        "unit/test_diagnosis.py unit/test_metrics.py",
    ),
    Fault(
        "All recordings of a person count as pairs of their own",
        "metrics.statistics:compare_with_pairs",
        argument(groups=lambda groups: torch.arange(len(groups))),
        "unit/test_diagnosis.py",
    ),
    Fault(
        "The chance of a flagged simulation is ten times as large",
        "diagnosis.misspecification:distances",
        result(lambda distance: 2 * distance),
        "unit/test_diagnosis.py",
    ),
    Fault(
        "Residuals come from a net that has seen their pairs",
        "diagnosis.prior_shift:cross_fit",
        result(lambda found: (found[1], found[1])),
        "unit/test_diagnosis.py",
    ),
    # --- networks and priors ---
    Fault(
        "A parameter just outside the prior has the density of one inside",
        "npe.prior:PriorDistribution.log_prob",
        result(lambda log_prob: log_prob.clamp_min(-50.0)),
        "contract/test_prior.py",
    ),
    Fault(
        "Units of the prior are variances",
        "npe.prior:PriorDistribution.log_units",
        result(lambda units: 2 * units),
        "integration/test_stacking_report.py unit/test_metrics.py",
    ),
    Fault(
        "Entries that never vary in simulations are read",
        "npe.sbi:leave_out_constants",
        lambda right: lambda net: None,
        "contract/test_estimator_families.py unit/test_far_entries.py",
    ),
    Fault(
        "The member of an ensemble is that before",
        "training.ensemble:Ensemble.member",
        argument(number=lambda number: max(0, number - 1)),
        "unit/test_ensemble.py",
    ),
    # --- baselines ---
    Fault(
        "Spike and slab have exchanged their probabilities",
        "baselines.error_model:SpikeAndSlab.log_prob",
        argument(self=lambda m: replace(m, slab_probability=1 - m.slab_probability)),
        "unit/test_baselines_rnpe.py",
    ),
    Fault(
        "R-hat compares whole chains, which may all drift alike",
        "baselines.error_model:split_r_hat",
        argument(draws=lambda draws: draws.mean(dim=-2, keepdim=True) + 0 * draws),
        "unit/test_baselines_rnpe.py",
    ),
    Fault(
        "The discrepancy of NPE-RS is taken of distances that are not squared",
        "baselines.npe_rs:_squared_distances",
        result(torch.sqrt),
        "unit/test_baselines_npe_rs.py",
    ),
    Fault(
        "The hybrid VAE takes variances for standard deviations",
        "baselines.hvae_model:_gaussian",
        argument(log_variance=lambda log_variance: 2 * log_variance),
        "unit/test_baselines_hvae.py",
    ),
    Fault(
        "Joint NPE trains on the pairs that it holds out",
        "baselines.joint_npe:split_pairs",
        result(lambda rows: (torch.cat(rows), rows[1])),
        "unit/test_baselines_simple.py",
    ),
    Fault(
        "The change of volume of FMCPE's map has the wrong sign",
        "baselines.flow_matching:VelocityField.follow_back",
        result(lambda found: (found[0], -found[1])),
        "unit/test_baselines_fmcpe.py",
    ),
    Fault(
        "FMCPE forgets the volume of its map onto the prior's support",
        "baselines.flow_matching:Unbounded.log_scale",
        result(torch.zeros_like),
        "unit/test_baselines_fmcpe.py",
    ),
    Fault(
        "The weights of FRISBI have no gradient",
        "baselines.frisbi:Aligned._weights",
        result(torch.Tensor.detach),
        "unit/test_baselines_frisbi.py",
    ),
    Fault(
        "FRISBI sums squared differences instead of averaging them",
        "baselines.frisbi:_cost",
        result(lambda cost: 2 * cost),
        "unit/test_baselines_frisbi.py",
    ),
    Fault(
        "The bound of RVNP forgets the errors of real observations",
        "baselines.rvnp:ErrorModel.forward",
        result(lambda found: (0 * found[0], *found[1:])),
        "unit/test_baselines_rvnp.py",
    ),
    Fault(
        "NNPE sees far statistics as they are",
        "baselines.statistics:SoftClip.forward",
        lambda right: lambda self, statistics: statistics,
        "unit/test_baselines_nnpe.py",
    ),
    Fault(
        "The calibration MLP is surer than its errors on the pairs allow",
        "baselines.calibration_mlp:DiagonalGaussian.set_bounds",
        lambda right: lambda self, theta, x, draws: None,
        "unit/test_baselines_simple.py",
    ),
    # --- tasks ---
    Fault(
        "The necrosis of cancer cells compares a radius with squared distances",
        "tasks.cs:tissue_statistics",
        argument(necrosis_radius=lambda radius: radius**0.5),
        "unit/test_tasks_cs.py",
    ),
    Fault(
        "The noise of an epidemic grows with the step instead of its root",
        "tasks.sir:SIRSimulator.infections",
        argument(
            self=lambda s: replace(s, volatility=s.volatility / s.steps_per_day**0.5)
        ),
        "unit/test_tasks_sir.py",
    ),
    Fault(
        "Reports of a weekend are lost instead of late",
        "tasks.sir:delay_weekend_reports",
        result(lambda reported: 0.99 * reported),
        "unit/test_tasks_sir.py",
    ),
    Fault(
        "Friction makes the swing of a pendulum grow",
        "tasks.pendulum:PendulumSimulator.position",
        argument(damping=lambda damping: -damping),
        "unit/test_tasks_pendulum.py",
    ),
    Fault(
        "Blood flows with half of its friction",
        "tasks.hemodynamics.solver:solve",
        argument(
            network=lambda network: replace(network, friction=network.friction / 2)
        ),
        "unit/test_hemodynamics_solver.py",
    ),
    Fault(
        "Pulse waves are a tenth too fast",
        "tasks.hemodynamics.network:wave_speed",
        result(lambda speed: 1.1 * speed),
        "unit/test_hemodynamics_network.py",
    ),
    Fault(
        "Hearts eject a tenth less than their stroke volume",
        "tasks.hemodynamics.inflow:aortic_inflow",
        result(lambda flow: 0.9 * flow),
        "unit/test_hemodynamics_network.py",
    ),
    Fault(
        "Recordings begin in the first half of a beat",
        "tasks.hemodynamics.records:play",
        argument(start=lambda start: start / 2),
        "unit/test_hemodynamics_records.py",
    ),
    Fault(
        "The light through two polarisers falls with the cosine",
        "tasks.light_tunnel_models:malus",
        result(torch.sqrt),
        "unit/test_tasks_light_tunnel.py",
    ),
    Fault(
        "Light at a sensor falls with the distance instead of its square",
        "tasks.light_tunnel_sensors:DISTANCES",
        value((0.1**0.5, 0.17**0.5, 0.25**0.5)),
        "unit/test_tasks_light_tunnel_sensors.py",
    ),
    Fault(
        "The exhaust fan of the wind tunnel is as fast as the intake",
        "tasks.wind_tunnel_model:EXHAUST_LOADS",
        value((0.01, 1.0)),
        "unit/test_tasks_wind_tunnel.py",
    ),
    Fault(
        "The test set of a seed is the calibration set of the next",
        "tasks.splits:stream_of",
        lambda right: (
            lambda seed, use: (
                right(seed + 1, "calibration") if use == "test" else right(seed, use)
            )
        ),
        "unit/test_tasks_base.py",
    ),
    Fault(
        "Recorded calibration pairs are test pairs as well",
        "tasks.splits:RecordedPairs.rows_of",
        lambda right: (
            lambda self, part: sorted({*right(self, "calibration"), *right(self, part)})
        ),
        "unit/test_tasks_base.py",
    ),
    Fault(
        "Biased calibration parameters crowd half as much",
        "tasks.variants:beta_shaped",
        result(torch.sqrt),
        "unit/test_tasks_base.py",
    ),
]


def noticed(number: int) -> tuple[bool, str]:
    """Return whether a test fails with a fault, and the first that does."""
    found: list[str] = []

    class First:
        def pytest_runtest_logreport(self, report: Any) -> None:
            if report.failed and not found:
                error = getattr(report.longrepr, "reprcrash", report.longrepr)
                error = str(getattr(error, "message", error)).split("\n")[0]
                found.append(f"{report.nodeid.split('/')[-1]}: {error}")

    fault = FAULTS[number]
    fault.make()
    files = [str(TESTS / name) for name in fault.tests.split()]
    options = ["-q", "-x", "-p", "no:cacheprovider", "-m", "not gpu and not network"]
    with contextlib.redirect_stdout(io.StringIO()):
        status = pytest.main([*options, *files], plugins=[First()])
    if status == pytest.ExitCode.OK:
        return False, "NOT NOTICED"
    test = found[0] if found else f"pytest ended with {status}"
    # What breaks the code is no wrong number.
    broken = (": TypeError", ": AttributeError", ": NameError", ": KeyError", "pytest ")
    return not any(kind in test for kind in broken), test


def main(word: str = "") -> int:
    """Print which test notices each fault, and return how many none does."""
    chosen = [k for k, fault in enumerate(FAULTS) if word in fault.what]
    # A process for each fault, so that none sees another's.
    context = multiprocessing.get_context("fork")
    missed = []
    with context.Pool(os.cpu_count(), maxtasksperchild=1) as pool:
        for number, (is_noticed, test) in zip(
            chosen, pool.imap(noticed, chosen, chunksize=1), strict=True
        ):
            print(f"{FAULTS[number].what}: {test}", flush=True)
            missed += [] if is_noticed else [FAULTS[number].what]
    print(f"{len(chosen) - len(missed)} of {len(chosen)} faults noticed")
    print("\n".join(f"NOT NOTICED: {what}" for what in missed))
    return len(missed)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
