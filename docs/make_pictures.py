"""Make the pictures of the documentation, most from fifty labelled measurements.

    python docs/make_pictures.py

The measurements are the extract of the light tunnel's sensors that the tests use. One
picture shows simulated beats of the heart, and needs numba. It takes about ten minutes,
and writes PNG files into ``docs/pictures``.
"""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib.pyplot as plt
import pandas as pd
import torch
from sbi.inference import NPE
from sbi.neural_nets import posterior_nn
from torch import Tensor

from sbi_rope import RoPE, SinkhornCoupler, diagnose, plots, stack
from sbi_rope.methods import DiscrepancyNPE
from sbi_rope.metrics import draw_samples, evaluate
from sbi_rope.tasks import get_task
from sbi_rope.tasks.hemodynamics.population import PROCESSES, Population
from sbi_rope.tasks.hemodynamics.waveforms import SITES, simulate_beat

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DOCS = Path(__file__).parent
EXTRACT = DOCS.parent / "tests/data/causal_chamber"
TABLE = EXTRACT / "lt_interventions_standard_v1/uniform_reference.csv"
QUIET: dict[str, Any] = {"show_progress_bars": False}
NUM_LABELLED = 50
# The parameters that pair plots show, and the observation that they show them of.
SHOWN, NAMES = [0, 3], ["red", "polariser angle [degree]"]
ALL_NAMES = ["red", "green", "blue", "angle"]
OBSERVED = 2


def measurements() -> tuple[Tensor, Tensor]:
    """Return parameters and sensor readings of the light tunnel."""
    table = pd.read_csv(TABLE)
    theta = table[["red", "green", "blue"]]
    theta = theta.assign(angle=(table["pol_1"] - table["pol_2"]).abs())
    light = table[["ir_1", "vis_1", "ir_2", "vis_2", "ir_3", "vis_3"]]
    x = torch.cat([_tensor(light).log1p(), _tensor(table[["current"]])], dim=1)
    return _tensor(theta), x


def _tensor(table: pd.DataFrame) -> Tensor:
    return torch.tensor(table.to_numpy(), dtype=torch.float32)


def trained_npe() -> tuple[Any, Any]:
    """Return NPE that was trained on the published simulator, and this simulator."""
    task = get_task("light_tunnel_sensors")
    prior, simulator = task.get_prior(), task.get_simulator()
    theta = prior.sample((20_000,))
    npe = NPE(
        prior,
        density_estimator=posterior_nn(
            "nsf",
            embedding_net=task.get_embedding_net(),
            num_transforms=3,
            hidden_features=50,
        ),
        **QUIET,
    )
    npe.append_simulations(theta, simulator(theta))
    npe.train(training_batch_size=200, learning_rate=1e-3, max_num_epochs=30)
    return npe.build_posterior(), simulator


def overconfident(npe: Any, posterior: Any, theta_o: Tensor, x_o: Tensor) -> "Figure":
    """Draw the coverage of NPE and of the stack."""
    found = {
        name: evaluate(one, theta_o, x_o, num_samples=1000, seed=0)
        for name, one in {"NPE": npe, "stack": posterior}.items()
    }
    return plots.calibration_curves(found)


def intervals(npe: Any, posterior: Any, theta: Tensor, x: Tensor) -> "Figure":
    """Draw intervals of the brightness of blue, of sixty test measurements."""
    figure = plt.figure(figsize=(8, 3.6), layout="constrained")
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    rows = torch.randperm(len(theta), generator=torch.Generator().manual_seed(0))[:60]
    for axes, (name, one) in zip(
        panels, {"NPE": npe, "stack": posterior}.items(), strict=True
    ):
        samples = draw_samples(one, x, num_samples=1000)[..., 2]
        low, middle, high = samples.quantile(torch.tensor([0.05, 0.5, 0.95]), dim=0)
        truth = theta[:, 2]
        inside = (low <= truth) & (truth <= high)
        for rows_of, color in (
            (rows[inside[rows]], "#0072B2"),
            (rows[~inside[rows]], "#D55E00"),
        ):
            ends = torch.stack([middle - low, high - middle])[:, rows_of]
            axes.errorbar(
                truth[rows_of], middle[rows_of], ends, fmt="o", ms=3, lw=1, color=color
            )
        axes.axline((0, 0), slope=1, color="0.4", lw=0.8, zorder=0)
        share = f"{inside.double().mean():.0%} of 90% intervals hold the truth"
        axes.set(title=f"{name}: {share}", xlabel="true brightness of blue")
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("inferred, with 90% interval")
    return figure


def shown(posterior: Any, x: Tensor) -> Tensor:
    """Return samples of one observation, of the parameters that are shown."""
    return draw_samples(posterior, x, num_samples=2000)[:, 0, SHOWN]


def one_observation(npe: Any, posterior: Any, theta: Tensor, x: Tensor) -> "Figure":
    """Draw the posteriors of a single observation."""
    samples = {"NPE": shown(npe, x), "stack": shown(posterior, x)}
    prior = npe.prior.sample((2000,))[:, SHOWN]
    return plots.pair_plot(samples, theta[SHOWN], parameter_names=NAMES, prior=prior)


def overview(rope: RoPE, npe: Any, theta: Tensor, x_o: Tensor) -> "Figure":
    """Draw the three steps of RoPE for the first observation."""
    posterior = rope.build_posterior(x_o, seed=0, **QUIET)
    with torch.no_grad():
        before, after = (net(x_o) for net in (rope.npe.h, rope.tuned_embedding_net))
    draws = posterior[0].sample((2000,), **QUIET)[:, SHOWN]
    return plots.overview(
        simulated=posterior.coupling.simulated,
        before=before,
        after=after,
        weights=posterior.weights[0],
        samples={"NPE": shown(npe, x_o[:1]), "RoPE": draws},
        theta=theta[SHOWN],
        parameter_names=NAMES,
        prior=npe.prior.sample((2000,))[:, SHOWN],
    )


def discrepancy(npe: Any, simulator: Any, theta: Tensor, x: Tensor) -> "Figure":
    """Draw what the labelled measurements say about each sensor."""
    method = DiscrepancyNPE.from_posterior(npe, simulator=simulator)
    names = get_task("light_tunnel_sensors").x_names
    report = method.append_calibration(theta, x).report(x_names=names, seed=0)
    print(report)
    return plots.discrepancy(report)


def gammas(rope: RoPE, theta: Tensor, x_o: Tensor) -> "Figure":
    """Draw posteriors of one observation at several gammas."""
    values = (1.0, 0.1, 0.02)
    samples = {}
    for gamma in values:
        coupler = SinkhornCoupler(gamma=gamma)
        posterior = rope.build_posterior(x_o, coupler=coupler, seed=0, **QUIET)
        draws = posterior[OBSERVED].sample((2000,), **QUIET)
        samples[f"gamma {gamma:g}"] = draws[:, SHOWN]
    return plots.pair_plot(samples, theta[SHOWN], parameter_names=NAMES)


def other_prior(rope: RoPE, theta_o: Tensor, x_o: Tensor) -> "Figure":
    """Draw the parameters that a batch with much red implies."""
    bright = x_o[theta_o[:, 0] > 45]
    diagnosis = diagnose(rope, bright, seed=0, **QUIET)
    return arranged(plots.implied_parameters(diagnosis), columns=2, size=(7.0, 5.0))


def learning_curve(report: Any) -> "Figure":
    """Draw the panel of the learning curve alone."""
    figure = plots.stacking_report(report)
    for axes in figure.axes[:-1]:
        axes.remove()
    return arranged(figure, columns=1, size=(5.5, 3.4))


def arranged(figure: "Figure", *, columns: int, size: tuple[float, float]) -> "Figure":
    """Put the panels of a wide figure into a grid, which is readable on a page."""
    grid = figure.add_gridspec(-(-len(figure.axes) // columns), columns)
    for axes, place in zip(figure.axes, grid, strict=True):
        axes.set_subplotspec(place)
    figure.set_size_inches(size)
    return figure


def hemodynamics() -> "Figure":
    """Draw beats of ten people without and with arteries of their own lengths."""
    figure = plt.figure(figsize=(10, 6), layout="constrained")
    grid = figure.subplots(len(PROCESSES), len(SITES), sharex=True, sharey=True)
    for index in range(10):
        real = Population().draw("real", seed=0, index=index)
        people = (replace(real, length_factors=(1.0,) * len(real.length_factors)), real)
        for row, subject in zip(grid, people, strict=True):
            beat = simulate_beat(subject)
            for ax, site in zip(row, reversed(SITES), strict=True):
                wave = beat.pressure[site]
                time = beat.period * torch.arange(len(wave)) / len(wave)
                color = plt.get_cmap("viridis")((real.age - 25.0) / 50.0)
                ax.plot(time, wave, color=color, linewidth=1.0)
    for row, process in zip(grid, PROCESSES, strict=True):
        row[0].set_ylabel("pressure [mmHg]")
        for ax, site in zip(row, reversed(SITES), strict=True):
            ax.set(title=f"{site}, {process}", xlabel="time [s]")
    return figure


def save(figure: "Figure", name: str) -> None:
    """Write a picture and say how large it is."""
    path = DOCS / "pictures" / f"{name}.png"
    figure.savefig(path, dpi=110, bbox_inches="tight")
    print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB", flush=True)


def main() -> None:
    """Make all pictures."""
    torch.manual_seed(0)
    theta, x = measurements()
    theta_cal, x_cal = theta[:NUM_LABELLED], x[:NUM_LABELLED]
    theta_o, x_o = theta[NUM_LABELLED:], x[NUM_LABELLED:]
    npe, simulator = trained_npe()
    coupler = SinkhornCoupler(gamma=0.1)
    rope = RoPE(npe, simulator=simulator, coupler=coupler, parameter_names=ALL_NAMES)
    rope.append_calibration(theta_cal, x_cal).train(seed=0, **QUIET)

    save(hemodynamics(), "hemodynamics")
    save(overview(rope, npe, theta_o[0], x_o), "overview")
    save(discrepancy(npe, simulator, theta_cal, x_cal), "discrepancy")
    save(gammas(rope, theta_o[OBSERVED], x_o), "gammas")
    save(other_prior(rope, theta_o, x_o), "other_prior")
    posterior = stack(rope, learning_curve=True, seed=0, **QUIET)
    print(posterior.report)
    save(learning_curve(posterior.report), "learning_curve")
    without = replace(posterior.report, learning_curve=None)
    save(plots.stacking_report(without), "stacking")
    save(overconfident(npe, posterior, theta_o, x_o), "overconfident")
    save(intervals(npe, posterior, theta_o, x_o), "intervals")
    theta_1, x_1 = theta_o[OBSERVED], x_o[OBSERVED : OBSERVED + 1]
    save(one_observation(npe, posterior, theta_1, x_1), "one_observation")
    sets = plots.credible_set(posterior, x_1, theta_1, parameter_names=ALL_NAMES)
    save(sets, "guaranteed_sets")


if __name__ == "__main__":
    main()
