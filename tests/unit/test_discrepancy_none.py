"""When pairs refute that the simulator is right, whatever the evidence says."""

import torch
from torch import Tensor

from sbi_rope.data.pairs import Pairs
from sbi_rope.data.simulate import Moments
from sbi_rope.discrepancy import DiscrepancyModel
from sbi_rope.discrepancy.correction import fit_discrepancy, surprise
from sbi_rope.npe.standardisation import Standardisation

WIDTH = 9
UNIT = Standardisation(torch.randn(2000, WIDTH).double())


def observed(n: int, *, error: float = 0.0, seed: int = 0) -> tuple[Tensor, Moments]:
    """Observations of a simulator whose noise depends on the parameters.

    The standard deviation of ``error`` is in that of the noise.
    """
    generator = torch.Generator().manual_seed(seed)
    draw = torch.randn(n, WIDTH, WIDTH, generator=generator).double()
    # Some entries are known much more precisely than others.
    scale = torch.logspace(-1.5, 0, WIDTH)[:, None].double()
    scale = (0.3 + 0.3 * torch.rand(n, 1, 1, generator=generator).double()) * scale
    factor = scale * torch.linalg.cholesky(draw @ draw.mT / WIDTH + torch.eye(WIDTH))
    mean = torch.randn(n, WIDTH, generator=generator).double()
    noise = torch.randn(n, WIDTH, 1, generator=generator).double()
    z = mean + (1 + error**2) ** 0.5 * (factor @ noise)[..., 0]
    return z, Moments(means=mean[:, None], covariance=factor @ factor.mT)


def pairs(z: Tensor, groups: Tensor | None = None) -> Pairs:
    """Pairs that are independent of each other unless they are in groups."""
    groups = torch.arange(len(z)) if groups is None else groups
    return Pairs.exact(groups[:, None].double(), z)


def test_the_surprise_of_a_right_simulator_is_about_standard_normal() -> None:
    """A little lower, because a smallest noise is assumed that is not there."""
    found = []
    for seed in range(300):
        z, moments = observed(20, seed=seed)
        found.append(surprise(pairs(z), z, moments))
    values = torch.tensor(found)
    assert -0.5 < float(values.mean()) < 0.1
    assert 0.8 < float(values.std()) < 1.25
    assert float(values.max()) < 5


def test_ten_pairs_refute_a_simulator_that_all_discrepancies_are_worse_than() -> None:
    """Each discrepancy of nine entries has so much to learn that evidence is small."""
    z, moments = observed(10, error=1.6)
    # Rotated, so that no entry by itself is more precise than the others.
    turn, _ = torch.linalg.qr(torch.randn(WIDTH, WIDTH).double())
    covariance = turn @ moments.covariance @ turn.T
    moments = Moments(means=moments.means @ turn.T, covariance=covariance)
    z = z @ turn.T
    evidence = DiscrepancyModel().fit(z, moments.mean, moments.covariance.mean(dim=0))
    assert evidence.probability_of_none > 0.99
    for prior, expected in ((0.5, 0.0), (1.0, 1.0)):
        model = DiscrepancyModel(probability_of_none=prior)
        found = fit_discrepancy(pairs(z), z, moments, UNIT, model)
        assert found.probability_of_none == expected


def test_people_who_differ_as_simulated_ones_do_not_refute_a_simulator() -> None:
    """Their recordings do, if they are taken for independent."""
    groups = torch.arange(8).repeat_interleave(10)
    noise = 0.09 * torch.eye(WIDTH).double()
    apart, together = [], []
    for seed in range(5):
        torch.manual_seed(seed)
        mean = torch.randn(8, WIDTH).double()[groups]
        person = 0.3 * torch.randn(8, WIDTH)[groups]
        # The people are unusual in some entries, and the recordings differ in others.
        part = torch.tensor([0.99] * 5 + [0.0] * (WIDTH - 5))
        recording = 0.3 * torch.randn(80, WIDTH)
        z = mean + part.sqrt() * person + (1 - part).sqrt() * recording
        moments = Moments(means=mean[:, None], covariance=noise.expand(80, -1, -1))
        for found, kept in ((apart, pairs(z)), (together, pairs(z, groups))):
            fitted = fit_discrepancy(kept, z, moments, UNIT, DiscrepancyModel())
            found.append(fitted.probability_of_none)
    assert max(apart) < 0.1
    assert min(together) > 0.9


def test_copies_of_pairs_change_no_surprise_if_they_are_known_to_be_copies() -> None:
    z, moments = observed(20, error=1.0)
    rows, plain = torch.arange(20).repeat(3), surprise(pairs(z), z, moments)
    copied = z[rows], moments[rows]
    assert abs(surprise(pairs(z[rows], rows), *copied) - plain) < 1e-9
    assert surprise(pairs(z[rows]), *copied) > 1.5 * plain
    # Of several possible means the nearest counts.
    means = moments.means + torch.tensor([0.0, 5.0])[:, None].double()
    several = Moments(means=means, covariance=moments.covariance)
    assert abs(surprise(pairs(z), z, several) - plain) < 1e-9
