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
        "unit/test_hemodynamics_inflow.py",
    ),
    Fault(
        "Recordings begin in the first half of a beat",
        "tasks.hemodynamics.records:play",
        argument(start=lambda start: start / 2),
        "unit/test_tasks_hemodynamics.py",
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
        "unit/test_tasks_splits.py",
    ),
    Fault(
        "Recorded calibration pairs are test pairs as well",
        "tasks.splits:RecordedPairs.rows_of",
        lambda right: (
            lambda self, part: sorted({*right(self, "calibration"), *right(self, part)})
        ),
        "unit/test_tasks_splits.py",
    ),
    Fault(
        "Biased calibration parameters crowd half as much",
        "tasks.variants:beta_shaped",
        result(torch.sqrt),
        "unit/test_tasks_base.py",
    ),
]


def caught_by(number: int) -> str | None:
    """Return the first test that fails with a fault, or None."""
    fault = FAULTS[number]

    class First:
        failed: str | None = None

        def pytest_runtest_logreport(self, report: Any) -> None:
            if report.failed and First.failed is None:
                First.failed = report.nodeid.split("/")[-1]

    fault.make()
    files = [str(TESTS / name) for name in fault.tests.split()]
    options = ["-q", "-x", "-p", "no:cacheprovider", "-m", "not gpu and not network"]
    with contextlib.redirect_stdout(io.StringIO()):
        status = pytest.main([*options, *files], plugins=[First()])
    if status == pytest.ExitCode.TESTS_FAILED:
        return First.failed
    assert status == pytest.ExitCode.OK, f"{fault.what}: pytest ended with {status}"
    return None


def main(word: str = "") -> int:
    """Print which test notices each fault, and return how many none does."""
    chosen = [k for k, fault in enumerate(FAULTS) if word in fault.what]
    # A process for each fault, so that none sees another's.
    context = multiprocessing.get_context("fork")
    missed = 0
    with context.Pool(os.cpu_count(), maxtasksperchild=1) as pool:
        found = pool.imap(caught_by, chosen, chunksize=1)
        for number, test in zip(chosen, found, strict=True):
            missed += test is None
            print(f"{FAULTS[number].what}: {test or 'NOT NOTICED'}", flush=True)
    print(f"{len(chosen) - missed} of {len(chosen)} faults noticed")
    return missed


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
