"""Cancer and stromal cells."""

import math

import numpy as np
import pytest
import torch

from sbi_rope.tasks.cs import CancerStroma, CancerStromaSimulator, tissue_statistics

# Means and standard deviations of 1500 draws of an independent implementation, under
# the prior: stromal cells, cancer cells, mean and maximum distance.
SIMULATED = ((677.0, 177.0, 0.1351, 0.349), (364.0, 84.0, 0.0590, 0.141))
REAL = ((679.0, 87.0, 0.1405, 0.358), (365.0, 42.0, 0.0590, 0.142))


def random_tissue(seed: int) -> dict:
    rng = np.random.default_rng(seed)
    num_parents = int(rng.integers(1, 8))
    return {
        "cells": rng.random((2, int(rng.integers(30, 300)))),
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


def test_statistics_are_those_of_a_naive_implementation() -> None:
    for seed in range(5):
        tissue = random_tissue(seed)
        for radius in (0.0, 0.8, 1.0):
            x = tissue_statistics(**tissue, necrosis_radius=radius)
            expected = naive_statistics(**tissue, radius=radius)
            assert list(x) == pytest.approx(expected, rel=1e-12)


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


@pytest.mark.medium
def test_means_under_the_prior_are_those_of_an_independent_implementation() -> None:
    for variant, table in (("well_specified", SIMULATED), (None, REAL)):
        _, x = CancerStroma(variant=variant).get_test_set(1500)
        mean, std = torch.tensor(table)
        error = ((std**2 + x.var(dim=0)) / 1500).sqrt()
        assert ((x.mean(dim=0) - mean).abs() < 4 * error).all()


def test_the_number_of_cells_is_poisson_with_the_rate_of_theta() -> None:
    theta = torch.tensor([[500.0, 5.0, 15.0]]).expand(1000, -1)
    num_cells = CancerStromaSimulator()(theta)[:, :2].sum(dim=1)
    assert num_cells.mean() == pytest.approx(500.0, abs=4 * (500 / 1000) ** 0.5)
    assert num_cells.var() == pytest.approx(500.0, rel=0.2)
