"""Who is drawn: hearts and arteries of people."""

import json

import numpy as np
import pytest
from scipy.stats import kstest, truncnorm

from sbi_rope.tasks.hemodynamics import population
from sbi_rope.tasks.hemodynamics import population_tables as tables
from sbi_rope.tasks.hemodynamics.population import (
    NUISANCES,
    TRUNCATED_SD,
    Population,
    Process,
    ejection_time_slopes,
)
from sbi_rope.tasks.hemodynamics.subject import Subject
from tests.conftest import TEST_DATA

N = 3000


def _draw(
    process: Process, n: int = N, **settings: float | str | bool
) -> list[Subject]:
    law = Population(**settings)  # type: ignore[arg-type]
    return [law.draw(process, seed=3, index=i) for i in range(n)]


@pytest.fixture(scope="module")
def people() -> dict[str, np.ndarray]:
    subjects = _draw("simulator")
    names = (*NUISANCES, "stroke_volume", "ejection_time", "period")
    return {name: np.array([getattr(s, name) for s in subjects]) for name in names}


def test_a_person_only_depends_on_settings_process_seed_and_index() -> None:
    law = Population()
    person = law.draw("real", seed=1, index=7)
    assert law.draw("real", seed=1, index=7) == person
    others = [
        law.draw("simulator", seed=1, index=7),
        law.draw("real", seed=2, index=7),
        law.draw("real", seed=7, index=1),
        law.draw("real", seed=1, index=8),
    ]
    assert len({person.age, *(other.age for other in others)}) == 5


@pytest.mark.medium
def test_age_and_heart_follow_their_laws(people: dict[str, np.ndarray]) -> None:
    age = people["age"]
    assert kstest((age - 25) / 50, "uniform").pvalue > 1e-3
    mean, sd = tables.stroke_volume_law(age)
    volume = (people["stroke_volume"] - mean) / sd
    rate = (people["heart_rate"] - tables.heart_rate_mean(age)) / 11.0
    time, slope, noise_sd = ejection_time_slopes()
    weissler = tables.weissler_time(people["stroke_volume"], people["heart_rate"])
    noise = (people["ejection_time"] - time - slope * weissler) / noise_sd
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
    subjects = _draw("real", 1500)
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
