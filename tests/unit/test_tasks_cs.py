"""Cancer and stromal cells."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from sbi_rope.tasks.cs import (
    CancerStroma,
    CancerStromaSimulator,
    tissue_statistics,
)

NECROSIS = CancerStromaSimulator(necrosis_probability=0.75)
# Means and standard deviations of 1500 draws of an independent implementation, under
# the prior: stromal cells, cancer cells, mean and maximum distance.
SIMULATED = ((677.0, 177.0, 0.1351, 0.349), (364.0, 84.0, 0.0590, 0.141))
REAL = ((679.0, 87.0, 0.1405, 0.358), (365.0, 42.0, 0.0590, 0.142))


def random_tissue(seed: int, *, num_cells: int | None = None) -> dict:
    rng = np.random.default_rng(seed)
    num_parents = int(rng.integers(1, 8))
    num_cells = int(rng.integers(30, 300)) if num_cells is None else num_cells
    return {
        "cells": rng.random((2, num_cells)),
        "parents": rng.random((2, num_parents)),
        "num_daughters": rng.poisson(12.0, num_parents) + 1,
        "necrotic": rng.random(num_parents) < 0.75,
    }


def naive_statistics(
    cells: np.ndarray,
    parents: np.ndarray,
    num_daughters: np.ndarray,
    necrotic: np.ndarray,
    radius: float,
) -> list[float]:
    """Follow the description cell by cell, with full sorting."""

    def squared(a: np.ndarray, b: np.ndarray) -> float:
        return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2

    cancer, lost = set(), set()
    for j, parent in enumerate(parents.T):
        distances = [squared(parent, cell) for cell in cells.T]
        limit = sorted(distances)[num_daughters[j]]
        for i, distance in enumerate(distances):
            if distance <= limit:
                cancer.add(i)
            if necrotic[j] and distance < radius**2 * limit:
                lost.add(i)
    stromal = [i for i in range(cells.shape[1]) if i not in cancer]
    nearest = [
        math.sqrt(min(squared(cells[:, i], cells[:, k]) for k in cancer - lost))
        for i in stromal[:50]
    ]
    return [len(stromal), len(cancer - lost), np.mean(nearest), max(nearest)]


# The statistics ----------------------------------------------------------------------


def test_statistics_are_those_of_a_naive_implementation() -> None:
    for seed in range(5):
        tissue = random_tissue(seed)
        for radius in (0.0, 0.8, 1.0):
            x = tissue_statistics(**tissue, necrosis_radius=radius)
            expected = naive_statistics(**tissue, radius=radius)
            assert list(x) == pytest.approx(expected, rel=1e-12)


def test_a_parent_owns_one_cell_more_than_its_daughters() -> None:
    rng = np.random.default_rng(0)
    x = tissue_statistics(
        cells=rng.random((2, 100)),
        parents=rng.random((2, 1)),
        num_daughters=np.array([7]),
        necrotic=np.array([False]),
        necrosis_radius=0.8,
    )
    assert x[:2] == (92, 8)


def test_a_cell_on_the_edge_of_the_necrosis_is_alive() -> None:
    # Distances 0.25, 0.5, 0.5 and 1 from the parent, whose disc has radius 0.5.
    tissue = {
        "cells": np.array([[0.25, 0.5, 0.0, 1.0], [0.0, 0.0, 0.5, 0.0]]),
        "parents": np.zeros((2, 1)),
        "num_daughters": np.array([1]),
        "necrotic": np.array([True]),
    }
    for radius, num_cancer in ((0.5, 3), (0.75, 2), (1.0, 2)):
        expected = (1, num_cancer, 0.5, 0.5)
        assert tissue_statistics(**tissue, necrosis_radius=radius) == expected


def test_a_tissue_without_a_stromal_cell_has_no_statistics() -> None:
    # Without a cell, with too few for the parent, without and with a stromal one.
    for num_cells, defined in ((0, False), (7, False), (8, False), (9, True)):
        tissue = random_tissue(0, num_cells=num_cells) | {
            "parents": np.full((2, 1), 0.5),
            "num_daughters": np.array([7]),
            "necrotic": np.array([False]),
        }
        x = np.array(tissue_statistics(**tissue, necrosis_radius=0.8))
        assert np.isfinite(x).tolist() == [defined] * 4


def test_a_tissue_without_a_cancer_cell_has_no_statistics() -> None:
    # Each of the two cancer cells is inside of the necrosis of one parent.
    tissue = {
        "cells": np.array([[0.4, 0.6, 0.5], [0.0, 0.0, 0.9]]),
        "parents": np.array([[0.0, 1.0], [0.0, 0.0]]),
        "num_daughters": np.array([1, 1]),
        "necrotic": np.array([True, True]),
    }
    assert np.isnan(tissue_statistics(**tissue, necrosis_radius=0.8)).all()
    tissue["necrotic"][0] = False
    assert tissue_statistics(**tissue, necrosis_radius=0.8)[:2] == (1, 1)


# The simulator -----------------------------------------------------------------------


@pytest.mark.medium
@pytest.mark.parametrize(
    ("table", "task"),
    [
        pytest.param(SIMULATED, CancerStroma(variant="well_specified"), id="simulated"),
        pytest.param(REAL, CancerStroma(), id="real"),
    ],
)
def test_means_under_the_prior_are_those_of_an_independent_implementation(
    table: tuple[tuple[float, ...], tuple[float, ...]], task: CancerStroma
) -> None:
    _, x = task.get_test_set(1500)
    mean, std = torch.tensor(table)
    error = ((std**2 + x.var(dim=0)) / 1500).sqrt()
    assert ((x.mean(dim=0) - mean).abs() < 4 * error).all()


def test_the_number_of_cells_is_poisson_with_the_rate_of_theta() -> None:
    theta = torch.tensor([[500.0, 5.0, 15.0]]).expand(1000, -1)
    num_cells = CancerStromaSimulator()(theta)[:, :2].sum(dim=1)
    assert num_cells.mean() == pytest.approx(500.0, abs=4 * (500 / 1000) ** 0.5)
    assert num_cells.var() == pytest.approx(500.0, rel=0.2)


def test_necrosis_takes_half_of_the_cancer_cells_and_no_stromal_cell() -> None:
    theta = CancerStroma().get_prior().sample((500,))
    simulated, real = seeded(CancerStromaSimulator(), theta), seeded(NECROSIS, theta)
    assert torch.equal(simulated[:, 0], real[:, 0])
    assert (real[:, 1] <= simulated[:, 1]).all()
    # Without overlaps, 0.75 * 0.8**2 = 0.48 of them die.
    ratio = real[:, 1].sum() / simulated[:, 1].sum()
    assert ratio == pytest.approx(0.49, abs=0.02)
    assert (real[:, 2:] >= simulated[:, 2:]).all()


def test_without_necrosis_the_simulator_is_exact() -> None:
    theta = CancerStroma().get_prior().sample((50,))
    simulated = seeded(CancerStromaSimulator(), theta)
    for without in ({"necrosis_probability": 0.0}, {"necrosis_radius": 0.0}):
        assert torch.equal(seeded(replace(NECROSIS, **without), theta), simulated)
    assert not torch.equal(seeded(NECROSIS, theta), simulated)


def test_statistics_that_are_not_defined_are_nan() -> None:
    theta = torch.tensor([[0.0, 5.0, 15.0], [3.0, 5.0, 15.0], [1000.0, 5.0, 15.0]])
    x = CancerStromaSimulator()(theta)
    assert x.isnan().all(dim=1).tolist() == [True, True, False]
    assert x[2].isfinite().all()


# The task ----------------------------------------------------------------------------


def test_density_and_quantiles_of_the_prior_are_analytic() -> None:
    theta, _ = CancerStroma().get_test_set(20)
    log_prob = CancerStroma().get_prior().log_prob(theta)
    torch.testing.assert_close(log_prob, torch.full((20,), -math.log(1300 * 17 * 10)))
    theta = torch.tensor([[200.0, 20.0, 12.5], [850.0, 11.5, 20.0]])
    expected = torch.tensor([[0.0, 1.0, 0.25], [0.5, 0.5, 1.0]])
    torch.testing.assert_close(CancerStroma().prior_quantiles(theta), expected)


def test_options_reach_the_real_process_only() -> None:
    strong = CancerStroma(necrosis_probability=1.0, necrosis_radius=1.0)
    _, x = strong.get_test_set(200)
    _, default = CancerStroma().get_test_set(200)
    assert x[:, 1].mean() < 0.5 * default[:, 1].mean()
    assert strong.get_simulator() == CancerStroma().get_simulator()


def test_network_has_the_widths_of_the_paper() -> None:
    for light in (False, True):
        net = CancerStroma().get_embedding_net(light=light)
        widths = [layer.out_features for layer in net if hasattr(layer, "out_features")]
        assert widths == [12, 48, 48, 36, 9]


def seeded(simulator: CancerStromaSimulator, theta: Tensor) -> Tensor:
    torch.manual_seed(0)
    return simulator(theta)
