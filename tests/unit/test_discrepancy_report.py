"""What the report says of discrepancies that were planted, and where there is none."""

from typing import Any

import pytest
import torch
from scipy import stats
from torch import Tensor, nn

from sbi_rope.data.simulate import Moments
from sbi_rope.discrepancy import DiscrepancyModel, DiscrepancyReport, Interval
from sbi_rope.discrepancy.report import report_discrepancy
from sbi_rope.methods import DiscrepancyNPE
from sbi_rope.utils.errors import InvalidInputError, NotReadyError
from tests import problems

# Mean, spread over the prior and noise of four simulated summaries, in their units.
CENTRE = torch.tensor([100.0, -5.0, 0.0, 2e-6]).double()
SPREAD = torch.tensor([20.0, 0.5, 1.0, 1e-6]).double()
NOISE = 0.2 * SPREAD
NAMES = ["light", "shade", "heat", "dust"]
# Of the second summary, the others are clean.
GAIN, SHIFT, ERROR = 0.7, 0.6, 0.3
MODEL = DiscrepancyModel()
# Quicker, for many repetitions.
ONE_SETTING = DiscrepancyModel(
    gain_precisions=(1.0,), error_scales=(0.1,), degrees_of_freedom=(1.0,)
)


def simulated(n: int) -> Tensor:
    """Simulations from the prior."""
    return CENTRE + SPREAD * torch.randn(n, 4).double() + NOISE * torch.randn(n, 4)


def pairs(n: int) -> tuple[Tensor, Moments]:
    """Real observations, and the moments of simulations at their parameters."""
    mean = CENTRE + SPREAD * torch.randn(n, 4).double()
    x = mean + NOISE * torch.randn(n, 4)
    off = CENTRE[1] + SHIFT + GAIN * (x[:, 1] - CENTRE[1]) + ERROR * torch.randn(n)
    x[:, 1] = off
    covariance = NOISE.square().diag().expand(n, -1, -1)
    return x, Moments(means=mean[:, None], covariance=covariance)


def report(n: int = 40, *, model: DiscrepancyModel = MODEL) -> DiscrepancyReport:
    return report_discrepancy(*pairs(n), simulated(5000), model=model).renamed(NAMES)


def inside(value: float, interval: Interval) -> bool:
    return interval.low <= value <= interval.high


def test_a_planted_discrepancy_is_found_in_units_of_x_and_no_other() -> None:
    found = report(200)
    assert found.summaries[0].name == "shade"
    shade = found["shade"]
    assert shade.is_off
    for true, interval, width in [
        (GAIN, shade.gain, 0.4),
        (SHIFT, shade.shift, 0.2),
        (ERROR, shade.error, 0.15),
    ]:
        assert inside(true, interval)
        assert interval.high - interval.low < width
    found_shift = shade.shift.median**2 + shade.error.median**2
    size = ((shade.gain.median - 1) ** 2 + found_shift / (0.5**2 * 1.04)) ** 0.5
    assert shade.size.median == pytest.approx(size, rel=0.04)
    for name in ("light", "heat", "dust"):
        assert not found[name].is_off
        assert inside(1.0, found[name].gain)
        assert inside(0.0, found[name].shift)
    text = str(found)
    assert "What 200 calibration pairs say" in text
    clean = next(line for line in text.split("\n") if "no sign of discrep" in line)
    assert set(clean.split(": ")[1].split(", ")) == {"light", "heat", "dust"}
    assert found.notes == []


@pytest.mark.slow
def test_intervals_of_95_percent_hold_the_truth_in_95_percent_of_repetitions() -> None:
    # Gains, shifts and errors are drawn from the prior of the model.
    n, num_repetitions, covered = 5, 250, torch.zeros(3)
    model = DiscrepancyModel(
        gain_precisions=(3.0,), error_scales=(0.4,), degrees_of_freedom=(4.0,)
    )
    noise, prior = 0.01, 7.0 + 3.0 * torch.randn(20_000, 1).double()
    centre, scale = float(prior.mean()), float(prior.std())
    for repetition in range(num_repetitions):
        sigma = stats.invgamma.rvs(3.0, scale=2 * 0.16, random_state=repetition)
        gain = 1 + (sigma / 3) ** 0.5 * float(torch.randn(()))
        shift = sigma**0.5 * float(torch.randn(()))
        mean = torch.randn(n, 1).double()
        z = gain * mean + shift + sigma**0.5 * torch.randn(n, 1)
        covariance = torch.full((n, 1, 1), noise * scale**2).double()
        moments = Moments(means=(centre + scale * mean)[:, None], covariance=covariance)
        x = centre + scale * z
        found = report_discrepancy(x, moments, prior, model=model)["x[0]"]
        error = max(sigma - gain**2 * noise, 0.0) ** 0.5
        truth = gain, shift * scale, error * scale
        intervals = found.gain, found.shift, found.error
        covered += torch.tensor(list(map(inside, truth, intervals)))
    # Binomial: 95 % of 250 and more than three standard errors.
    assert (covered / num_repetitions > 0.95 - 0.045).all(), covered
    assert (covered / num_repetitions < 0.95 + 0.04).all(), covered


def test_a_pair_that_does_not_fit_the_others_is_named() -> None:
    for n in (12, 40):
        x, moments = pairs(n)
        x[3, 2] += 8.0
        x[5, 3] -= 8e-6
        found = report_discrepancy(x, moments, simulated(5000), model=MODEL)
        found = found.renamed(NAMES)
        assert {s.name: s.outliers for s in found.summaries if s.outliers} == {
            "heat": (3,),
            "dust": (5,),
        }, n
        text = str(found)
        assert "row 3 (heat)" in text
        assert "row 5 (dust)" in text


@pytest.mark.slow
def test_pairs_that_fit_the_others_are_rarely_named() -> None:
    for n in (10, 300):
        repetitions = 50 if n < 300 else 20
        named = [
            bool(summary.outliers)
            for _ in range(repetitions)
            for summary in report(n, model=ONE_SETTING).summaries
        ]
        # The rate is meant to be one in a hundred.
        assert sum(named) <= 0.03 * len(named), n


def test_summaries_that_are_constant_in_simulations_are_named() -> None:
    x, moments = pairs(20)
    constant = simulated(500)
    constant[:, 0] = 3.0
    found = report_discrepancy(x, moments, constant, model=MODEL).renamed(NAMES)
    assert found.constant == ("light",)
    assert {summary.name for summary in found.summaries} == set(NAMES[1:])
    assert "The same in all simulations: light." in str(found)
    with pytest.raises(InvalidInputError, match="all summaries are constant"):
        report_discrepancy(x, moments, torch.ones(500, 4), model=MODEL)


def method(**options: Any) -> DiscrepancyNPE:
    return DiscrepancyNPE(problems.box(2), num_simulations=2000, **options)


def shifted(n: int = 30) -> tuple[Tensor, Tensor]:
    """Labelled observations whose second reading is 0.7 too high."""
    theta = problems.box(2).sample((n,))
    return theta, problems.simulate(theta) + torch.tensor([0.0, 0.7, 0.0])


@pytest.mark.medium
def test_a_method_reports_without_training() -> None:
    theta = problems.box(2).sample((3000,))
    stored = method().append_simulations(theta, problems.simulate(theta))
    for asked in (stored, method(simulator=problems.simulate)):
        asked.append_calibration(*shifted())
        state = torch.get_rng_state()
        found = asked.report(x_names=["a", "b", "c"], show_progress_bars=False)
        assert torch.equal(torch.get_rng_state(), state)
        assert found.num_pairs == 30
        assert [s.name for s in found.summaries if s.is_off] == ["b"]
        assert inside(0.7, found["b"].shift)
        again = asked.report(x_names=["a", "b", "c"], show_progress_bars=False)
        assert again == found


def test_recordings_of_a_person_do_not_make_intervals_narrower() -> None:
    theta, x = shifted(20)
    several = theta.repeat_interleave(3, dim=0)
    own = 0.5 * torch.randn(20, 3)  # errors that recordings of a person share
    x_several = problems.simulate(several) + own.repeat_interleave(3, dim=0)
    x_several[:, 1] += 0.7
    widths = []
    for pairs in ((theta, x + own), (several, x_several)):
        asked = method(simulator=problems.simulate).append_calibration(*pairs)
        found = asked.report(seed=0, show_progress_bars=False)
        shifts = [summary.shift for summary in found.summaries]
        widths.append(sum(shift.high - shift.low for shift in shifts))
    # As independent pairs, they would be narrower by a factor of 1.7.
    assert widths[1] / widths[0] == pytest.approx(1.0, abs=0.2)
    assert "What 60 calibration pairs in 20 groups say about" in str(found)


def test_a_report_asks_for_the_data_that_it_lacks() -> None:
    with pytest.raises(NotReadyError, match="simulations"):
        method().append_calibration(*shifted()).report()
    images = method(simulator=problems.simulate_image)
    theta = problems.box(2).sample((5,))
    images.append_calibration(theta, problems.simulate_image(theta))
    with pytest.raises(InvalidInputError, match=r"shape \(n, l\).*`summaries=`"):
        images.report()
    with pytest.raises(InvalidInputError, match=r"`summaries\(x\)`"):
        images.report(summaries=lambda x: x.flatten(1)[:-1])


def blocks(x: Tensor) -> Tensor:
    """Return the mean brightness of four blocks of an image of 8 x 8 pixels."""
    return nn.functional.avg_pool2d(x, 4).flatten(1)


@pytest.mark.medium
def test_the_discrepancy_of_an_image_is_that_of_its_summaries() -> None:
    theta = problems.box(2).sample((30,))
    x = problems.simulate_image(theta)
    x[..., :4, 4:] += 0.5  # the light of one quarter
    stored = problems.box(2).sample((2000,))
    for asked in (
        method(simulator=problems.simulate_image),
        method().append_simulations(stored, problems.simulate_image(stored)),
    ):
        asked.append_calibration(theta, x)
        names = ["NW", "NE", "SW", "SE"]
        found = asked.report(summaries=blocks, x_names=names)
        assert [s.name for s in found.summaries if s.is_off] == ["NE"]
        assert inside(0.5, found["NE"].shift)
        arrays = asked.report(summaries=lambda x: blocks(x).numpy(), x_names=names)
        assert arrays == found
