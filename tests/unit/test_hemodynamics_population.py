"""Who is drawn: hearts and arteries of people, and the density of the former."""

import json
from typing import Any

import numpy as np
import pytest
import torch
from scipy.stats import kstest, truncnorm

from sbi_rope.tasks.hemodynamics import population
from sbi_rope.tasks.hemodynamics import population_tables as tables
from sbi_rope.tasks.hemodynamics.population import (
    TRUNCATED_SD,
    Population,
    Process,
    ejection_time_slopes,
)
from sbi_rope.tasks.hemodynamics.prior import PopulationPrior
from sbi_rope.tasks.hemodynamics.subject import Subject
from tests.conftest import TEST_DATA

N = 3000


def people_of(process: Process, n: int) -> list[Subject]:
    return [Population().draw(process, seed=3, index=i) for i in range(n)]


def test_a_person_only_depends_on_process_seed_and_index() -> None:
    who: list[tuple[Process, int, int]] = [
        *[("real", 1, 7), ("simulator", 1, 7), ("real", 2, 7), ("real", 7, 1)],
        ("real", 1, 8),
    ]
    ages = [Population().draw(*one).age for one in (*who, *who)]
    assert ages[:5] == ages[5:]
    assert len(set(ages)) == 5


@pytest.mark.medium
def test_age_and_heart_follow_their_laws() -> None:
    age, rate, volume, time = np.array(
        [
            (s.age, s.heart_rate, s.stroke_volume, s.ejection_time)
            for s in people_of("simulator", N)
        ]
    ).T
    assert kstest((age - 25) / 50, "uniform").pvalue > 1e-3
    start, slope, noise_sd = ejection_time_slopes()
    noise = (time - start - slope * tables.weissler_time(volume, rate)) / noise_sd
    mean, sd = tables.stroke_volume_law(age)
    volume = (volume - mean) / sd
    rate = (rate - tables.heart_rate_mean(age)) / 11.0
    law = truncnorm(-2.0, 2.0)
    for values in (volume, rate, noise):
        assert kstest(values, law.cdf).pvalue > 1e-3
        assert abs(np.corrcoef(values, age)[0, 1]) < 4 / N**0.5
    assert abs(np.corrcoef([volume, rate, noise])[np.triu_indices(3, 1)]).max() < 0.08


@pytest.mark.medium
def test_pulse_wave_velocity_has_the_published_quantiles() -> None:
    rng = np.random.default_rng(0)
    arteries = [population._draw_arteries(rng, 55.0) for _ in range(8000)]
    pressure = np.array([a["mean_pressure"] for a in arteries])
    usual = tables.velocity_trend(55.0, tables.pressure_law(55.0)[0])
    trend = [tables.velocity_trend(55.0, value) / usual for value in pressure]
    velocity = np.array([a["pulse_wave_velocity"] for a in arteries])
    # Of the cut law, other shares lie below the quantiles 0.1 and 0.9 of the whole.
    shares = truncnorm(-2, 2).cdf([-1.28155, 0.0, 1.28155])
    found = np.quantile(velocity / trend, shares)
    assert found == pytest.approx([6.2, 7.5, 9.2], rel=0.02)
    assert np.corrcoef(velocity, pressure)[0, 1] > 0.2


@pytest.mark.medium
def test_real_lengths_vary_with_height_and_by_segment() -> None:
    subjects = people_of("real", 1500)
    logs = np.log([s.length_factors for s in subjects])
    others = logs[:, 2:]
    height = others.mean(axis=1)
    assert (others - height[:, None]).std() == pytest.approx(0.15, rel=0.02)
    # The mean over segments has some of their scatter left.
    expected = np.hypot(0.1 / 1.7 * TRUNCATED_SD, 0.15 / 114**0.5)
    assert height.std() == pytest.approx(expected, rel=0.08)
    assert np.exp(height).mean() == pytest.approx(1.0, abs=0.01)
    aorta = (logs[:, :2] - height[:, None]).mean(axis=1)
    ages = np.array([s.age for s in subjects])
    growth = np.array([tables.aorta_growth(age) for age in ages])
    spread = np.hypot(0.134 * TRUNCATED_SD, 0.15 / 2**0.5)
    assert (aorta - np.log(growth)).std() == pytest.approx(spread, rel=0.08)
    assert np.exp(aorta[ages > 70]).mean() > 1.25


def test_tables_are_the_published_ones() -> None:
    path = TEST_DATA / "hemodynamics" / "pwdb_population.json"
    facts = json.loads(path.read_text())["population"]
    mean, sd = tables.stroke_volume_law(np.array([25.0, 75.0]))
    assert mean[0] == pytest.approx(facts["SV_ml"]["at_25"][0], abs=0.1)
    assert sd[1] == pytest.approx(facts["SV_ml"]["at_75"][1], abs=0.1)
    assert list(facts["HR_bpm"]["age"]) == tables.HR_AGES.tolist()
    pressure = facts["MBP_mmHg"]
    assert pressure["age"] == tables.PRESSURE_AGES.tolist()
    assert pressure["mean"] == tables.MEAN_PRESSURES.tolist()
    assert pressure["sd"] == tables.MEAN_PRESSURE_SDS.tolist()
    assert facts["DBP_mmHg"]["mean"] == tables.DIASTOLIC_PRESSURES.tolist()
    velocity = facts["aortic_PWV_m_s"]
    quantiles = velocity["p10_p50_p90_by_decade_optimalBP"].values()
    assert np.array(list(quantiles)).T.tolist() == tables.VELOCITY_QUANTILES.tolist()
    assert [velocity[k] for k in "ABC"] == tables.CLASS_TRENDS.tolist()
    assert velocity["sbp"] == tables.CLASS_SYSTOLIC.tolist()
    assert velocity["dbp"] == tables.CLASS_DIASTOLIC.tolist()
    assert facts["proximal_aorta_length"]["mm"] == tables.AORTA_LENGTHS.tolist()
    data = facts["LVET_ms"]["weissler_data"]
    design = np.stack([data["sv"], data["hr"], np.ones(22)], axis=1)
    fitted = 1000 * design @ np.linalg.lstsq(design, data["lvet_s"], rcond=None)[0]
    ours = tables.weissler_time(data["sv"], data["hr"])
    assert np.corrcoef(fitted, ours)[0, 1] > 0.97


# The density of stroke volume and ejection time --------------------------------------


@pytest.mark.parametrize(
    "source", ["prior", pytest.param("people", marks=pytest.mark.slow)]
)
def test_draws_and_people_follow_the_density_and_its_moments(source: str) -> None:
    prior = PopulationPrior()
    theta = prior.sample((8000,))
    if source == "people":
        people = people_of("simulator", 8000)
        theta = torch.tensor([(s.stroke_volume, s.ejection_time) for s in people])
    assert prior.support.check(theta).all()
    assert prior.log_prob(theta).isfinite().all()
    for probabilities in prior.marginal_cdf(theta).T:
        assert kstest(probabilities, "uniform").pvalue > 1e-3
    # Cells of a histogram, against sums of the density over midpoints of a grid.
    edges = [np.linspace(25, 105, 13), np.linspace(200, 365, 13)]
    counts = np.histogram2d(*theta.numpy().T, bins=edges)[0].ravel()
    places = (torch.arange(800, dtype=torch.float64) + 0.5) / 800
    points = torch.cartesian_prod(25 + 80 * places, 150 + 250 * places)
    mass = prior.log_prob(points).exp() * 80 * 250 / 800**2
    expected = np.histogram2d(*points.numpy().T, bins=edges, weights=mass)[0].ravel()
    expected *= len(theta)
    large = expected > 8
    chi_squared = ((counts - expected)[large] ** 2 / expected[large]).sum()
    assert chi_squared < large.sum() + 4 * (2 * large.sum()) ** 0.5
    assert large.sum() > 30
    torch.testing.assert_close(prior.mean, theta.mean(dim=0), rtol=0.01, atol=0.0)
    torch.testing.assert_close(prior.stddev, theta.std(dim=0), rtol=0.03, atol=0.0)


def test_density_is_the_integral_over_age_and_heart_rate() -> None:
    def law(value: np.ndarray | float, mean: np.ndarray, sd: Any) -> np.ndarray:
        return truncnorm.pdf((value - mean) / sd, -2.0, 2.0) / sd

    start, slope, noise_sd = ejection_time_slopes()
    age = 25 + 50 * (np.arange(2000) + 0.5) / 2000
    rate = (50 + 52 * (np.arange(2000) + 0.5) / 2000)[:, None]
    mean, sd = tables.stroke_volume_law(age)
    law_of_rate = law(rate, tables.heart_rate_mean(age), tables.HEART_RATE_SD)
    for volume, time in ((60.0, 280.0), (75.0, 310.0), (40.0, 262.0)):
        predicted = start + slope * tables.weissler_time(volume, rate)
        joint = law(volume, mean, sd) * law_of_rate * law(time, predicted, noise_sd)
        expected = joint.mean() * 52  # ages have the density 1 / 50
        found = PopulationPrior().log_prob(torch.tensor([volume, time])).exp()
        assert float(found) == pytest.approx(expected, rel=5e-3)
