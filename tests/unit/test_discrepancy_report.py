"""What the report says of discrepancies that were planted, and where there is none."""

from typing import Any

import pytest
import torch
from torch import Tensor, nn

from sbi_rope.data.simulate import Moments
from sbi_rope.discrepancy import DiscrepancyModel, Interval
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


def inside(value: float, interval: Interval) -> bool:
    return interval.low <= value <= interval.high


def test_an_interval_holds_95_percent_of_the_draws() -> None:
    assert Interval.of(torch.arange(1001.0)) == Interval(500.0, 25.0, 975.0)


def test_a_planted_discrepancy_is_found_in_units_of_x_and_no_other() -> None:
    found = report_discrepancy(*pairs(200), simulated(5000), model=MODEL)
    found = found.renamed(NAMES)
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


def test_summaries_that_are_constant_in_simulations_are_named() -> None:
    x, moments = pairs(20)
    constant = simulated(500)
    constant[:, 0] = 3.0
    found = report_discrepancy(x, moments, constant, model=MODEL).renamed(NAMES)
    assert {summary.name for summary in found.summaries} == set(NAMES[1:])
    assert "The same in all simulations: light." in str(found)


def method(simulator: Any = problems.simulate) -> DiscrepancyNPE:
    """One that starts from any NPE, because a report is about x itself."""
    image = simulator is problems.simulate_image
    npe = problems.npe_posterior(embedding="cnn" if image else "linear")
    options = {"simulator": simulator, "num_simulations": 2000}
    return DiscrepancyNPE.from_posterior(npe, **options)


@pytest.mark.medium
def test_a_method_reports_without_training() -> None:
    theta = problems.box(2).sample((30,))
    x = problems.simulate(theta) + torch.tensor([0.0, 0.7, 0.0])
    stored = problems.box(2).sample((3000,))
    for asked in (
        method(),
        method(None).append_simulations(stored, problems.simulate(stored)),
    ):
        asked.append_calibration(theta, x)
        state = torch.get_rng_state()
        found = asked.report(x_names=["a", "b", "c"], show_progress_bars=False)
        assert torch.equal(torch.get_rng_state(), state)
        assert [s.name for s in found.summaries if s.is_off] == ["b"]
        assert inside(0.7, found["b"].shift)
        again = asked.report(x_names=["a", "b", "c"], show_progress_bars=False)
        assert again == found


def test_recordings_of_a_person_do_not_make_intervals_narrower() -> None:
    people, widths = problems.box(2).sample((20,)), []
    own = 0.5 * torch.randn(20, 3)  # errors that recordings of a person share
    for count in (1, 3):
        theta = people.repeat_interleave(count, dim=0)
        x = problems.simulate(theta) + own.repeat_interleave(count, dim=0) + 0.7
        found = method().append_calibration(theta, x).report(show_progress_bars=False)
        shifts = [summary.shift for summary in found.summaries]
        widths.append(sum(shift.high - shift.low for shift in shifts))
    # As independent pairs, they would be narrower by a factor of 1.7.
    assert widths[1] / widths[0] == pytest.approx(1.0, abs=0.2)
    assert "What 60 calibration pairs in 20 groups say about" in str(found)


def blocks(x: Tensor) -> Any:
    """Return the mean brightness of four blocks of an image of 8 x 8 pixels."""
    return nn.functional.avg_pool2d(x, 4).flatten(1).numpy()


@pytest.mark.medium
def test_the_discrepancy_of_an_image_is_that_of_its_summaries() -> None:
    theta = problems.box(2).sample((30,))
    x = problems.simulate_image(theta)
    x[..., :4, 4:] += 0.5  # the light of one quarter
    asked = method(problems.simulate_image).append_calibration(theta, x)
    found = asked.report(summaries=blocks, x_names=["NW", "NE", "SW", "SE"])
    assert [s.name for s in found.summaries if s.is_off] == ["NE"]
    assert inside(0.5, found["NE"].shift)
    with pytest.raises(InvalidInputError, match=r"shape \(n, l\).*`summaries=`"):
        asked.report()
    with pytest.raises(InvalidInputError, match=r"`summaries\(x\)`"):
        asked.report(summaries=lambda x: x.flatten(1)[:-1])
    with pytest.raises(NotReadyError, match="append_simulations"):
        method(None).append_calibration(theta, theta[:, [0, 1, 1]]).report()
