"""Properties that hold for any numbers, however large, small or many."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from sbi_rope import SinkhornCoupler
from sbi_rope.discrepancy import DiscrepancyModel
from sbi_rope.utils.errors import RoPEError

# The same examples every time, and only as many as take a second or two.
brief = settings(derandomize=True, max_examples=60, deadline=None, database=None)


@st.composite
def matrices(
    draw: st.DrawFn, *, rows: tuple[int, int] = (1, 12), width: int = 2, largest: float
) -> Tensor:
    """A matrix whose columns have their own scale and centre, with ties in places."""
    n = draw(st.integers(*rows))
    numbers = st.lists(st.floats(-3, 3, width=32), min_size=width, max_size=width)
    values = torch.tensor([draw(numbers) for _ in range(n)], dtype=torch.double)
    exponents = st.floats(-math.log10(largest), math.log10(largest))
    scale = draw(st.lists(exponents, min_size=width, max_size=width))
    values = values * 10.0 ** torch.tensor(scale, dtype=torch.double)
    return values + draw(st.sampled_from([0.0, 1.0, -1e4]))


@pytest.mark.filterwarnings("ignore:Coupling a batch", "ignore:The coupling has not")
@brief
@given(
    real=matrices(largest=1e4),
    simulated=matrices(largest=1e4),
    gamma=st.floats(1e-3, 1e6),
    tau=st.floats(0, 1),
    solver=st.sampled_from(["own", "pot"]),
)
def test_rows_of_a_coupling_are_probabilities_whatever_the_embeddings(
    real: Tensor, simulated: Tensor, gamma: float, tau: float, solver: str
) -> None:
    coupler = SinkhornCoupler(gamma=gamma, tau=tau, solver=solver, max_iterations=50)
    try:
        coupling = coupler.couple(real, simulated)
    except RoPEError:
        return
    assert (coupling.weights >= 0).all()
    assert torch.allclose(coupling.weights.sum(dim=1), torch.ones(()).double())
    assert coupling.converged == (coupling.marginal_error <= coupler.tolerance)
    sizes = coupling.effective_sample_size
    assert ((sizes > 1 - 1e-9) & (sizes < len(simulated) + 1e-6)).all()


@pytest.mark.medium
@brief
@given(z=matrices(rows=(8, 8), largest=1e3), noise=st.floats(0, 1e3))
def test_a_discrepancy_is_finite_whatever_was_observed(z: Tensor, noise: float) -> None:
    theta = torch.linspace(-2, 2, 16).reshape(8, 2)
    discrepancy = DiscrepancyModel().fit(z, theta, noise * torch.eye(2))
    assert 0 <= discrepancy.probability_of_none <= 1
    assert torch.isfinite(discrepancy.sample(20, seed=0).correct(theta)).all()
