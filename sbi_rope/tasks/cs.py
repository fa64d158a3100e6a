r"""Task A: cells of a tissue in which tumours die from the inside."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from sbi.utils import BoxUniform
from torch import Tensor, nn

from sbi_rope.tasks.base import Task
from sbi_rope.tasks.distributions import box
from sbi_rope.tasks.networks import fully_connected
from sbi_rope.tasks.settings import STATISTICS_SETTINGS
from sbi_rope.tasks.splits import DrawnPairs, Part
from sbi_rope.utils.settings import Settings, UnitInterval
from sbi_rope.utils.tensors import as_batch

STATISTICS = ("n_stromal", "n_cancer", "mean_distance", "max_distance")
NUM_DISTANCES = 50  # the first stromal cells enter the two distances, others do not


@dataclass(frozen=True, kw_only=True)
class CancerStromaSimulator(Settings):
    r"""Four statistics of the cells in a square of tissue.

    With rates :math:`(\lambda_c, \lambda_p, \lambda_d)`, the unit square holds

    .. math:: N \sim \mathrm{Poisson}(\lambda_c), \quad
        P - 1 \sim \mathrm{Poisson}(\lambda_p), \quad
        m_j - 1 \sim \mathrm{Poisson}(\lambda_d), \quad j = 1, \dots, P

    cells and cancer parents, all independently uniform. Parents are centres, not
    cells. A cell is cancer if its distance to some parent :math:`j` is at most
    :math:`r_j`, that of the :math:`(m_j + 1)`-th nearest cell of the parent, and
    stromal otherwise. The statistics are the numbers of stromal and of cancer cells,
    and the mean and maximum distance of the first 50 stromal cells to their nearest
    cancer cell. They are all NaN where one is not defined: without a stromal or a
    cancer cell, and with too few cells for a parent.

    In the real process a parent is necrotic with a probability, and the cancer cells
    closer to it than a fraction of :math:`r_j` are gone. The simulator has
    probability 0. Under one seed, both have the same tissues before the necrosis.

    Args:
        necrosis_probability: Probability of a parent to be necrotic.
        necrosis_radius: Radius without cells, as a fraction of :math:`r_j`.

    Example:
        >>> theta = torch.tensor([[400.0, 5.0, 15.0], [1000.0, 10.0, 12.0]])
        >>> CancerStromaSimulator()(theta).shape
        torch.Size([2, 4])
    """

    necrosis_probability: UnitInterval = 0.0
    necrosis_radius: UnitInterval = 0.8

    def __call__(self, theta: Tensor) -> Tensor:
        """Simulate ``theta`` of shape ``(n, 3)``, to shape ``(n, 4)``."""
        theta = as_batch("theta", theta, (3,), empty=True)
        # NumPy's generator, in a state that torch's global generator decides.
        rng = np.random.default_rng(int(torch.randint(2**63 - 1, (), device="cpu")))
        x = np.empty((len(theta), len(STATISTICS)))
        for i, (cell_rate, parent_rate, daughter_rate) in enumerate(theta.tolist()):
            num_parents = rng.poisson(parent_rate) + 1
            x[i] = tissue_statistics(
                cells=rng.random((2, rng.poisson(cell_rate))),
                parents=rng.random((2, num_parents)),
                num_daughters=rng.poisson(daughter_rate, num_parents) + 1,
                necrotic=rng.random(num_parents) < self.necrosis_probability,
                necrosis_radius=self.necrosis_radius,
            )
        return torch.from_numpy(x).to(theta)


def tissue_statistics(
    *,
    cells: np.ndarray,
    parents: np.ndarray,
    num_daughters: np.ndarray,
    necrotic: np.ndarray,
    necrosis_radius: float,
) -> tuple[float, ...]:
    """Return the four statistics of one tissue.

    Positions of cells and parents have shapes ``(2, N)`` and ``(2, P)``, numbers of
    daughters and which parents are necrotic ``(P,)``.
    """
    undefined = (np.nan,) * len(STATISTICS)
    most = int(num_daughters.max())
    if cells.shape[1] <= most:
        return undefined
    squared = _squared_distances(parents, cells)
    nearest = np.sort(np.partition(squared, most, axis=1)[:, : most + 1], axis=1)
    limit = np.take_along_axis(nearest, num_daughters[:, None], axis=1)
    is_cancer = (squared <= limit).any(axis=0)
    stromal = np.flatnonzero(~is_cancer)
    inner = squared[necrotic] < necrosis_radius**2 * limit[necrotic]
    cancer = np.flatnonzero(is_cancer & ~inner.any(axis=0))
    if not stromal.size or not cancer.size:
        return undefined
    first = cells[:, stromal[:NUM_DISTANCES]]
    distance = np.sqrt(_squared_distances(first, cells[:, cancer]).min(axis=1))
    return stromal.size, cancer.size, distance.mean(), distance.max()


class CancerStroma(Task):
    r"""Task A of the paper: rates of cells and tumours from counts and distances.

    The parameters are the rates of cells, of cancer parents and of daughter cells,
    with prior :math:`\mathcal{U}[200, 1500] \times \mathcal{U}[3, 20] \times
    \mathcal{U}[10, 20]`. An observation is four statistics of a tissue (see
    :class:`CancerStromaSimulator`). In the real process three parents in four are
    necrotic, which halves the number of cancer cells; the number of stromal cells is
    untouched and the two distances hardly change.

    References:
        | Robust Neural Posterior Estimation and Statistical Model Criticism
          (Ward et al., 2022), https://github.com/danielward27/rnpe

    Args:
        variant, root, label_noise: See :class:`~sbi_rope.tasks.Task`.
        necrosis_probability: Probability of a real parent to be necrotic. At 0 the
            simulator is exact.
        necrosis_radius: Radius of the necrosis, as a fraction of the tumour's.

    Example:
        >>> theta, x_o = CancerStroma().get_calibration_set(50)
        >>> theta.shape, x_o.shape
        (torch.Size([50, 3]), torch.Size([50, 4]))
    """

    name = "cs"
    parameter_names = ("cell_rate", "parent_rate", "daughter_rate")
    parameter_units = ("1", "1", "1")
    x_shape = (len(STATISTICS),)
    x_names = STATISTICS
    misspecification = "in real tissue the cancer cells near most parents are dead"
    shifted_region = {"cell_rate": (850.0, 1500.0), "parent_rate": (3.0, 11.5)}  # noqa: RUF012
    paper_settings = STATISTICS_SETTINGS

    def __init__(
        self,
        *,
        variant: str | None = None,
        root: str | Path | None = None,
        label_noise: float | None = None,
        necrosis_probability: float = 0.75,
        necrosis_radius: float = 0.8,
    ) -> None:
        super().__init__(variant=variant, root=root, label_noise=label_noise)
        self._real = CancerStromaSimulator(
            necrosis_probability=necrosis_probability, necrosis_radius=necrosis_radius
        )

    def get_prior(self) -> BoxUniform:
        """Return the uniform prior, whose log density is -log 221000."""
        return box((200.0, 3.0, 10.0), (1500.0, 20.0, 20.0))

    def get_simulator(self) -> CancerStromaSimulator:
        """Return the simulator without necrosis."""
        return CancerStromaSimulator()

    def get_embedding_net(self, *, light: bool = False) -> nn.Module:
        """Return the paper's network, which is light already and has nine outputs."""
        return fully_connected(len(STATISTICS), (12, 48, 48, 36, 9))

    def _real_process(self, part: Part) -> DrawnPairs:
        return replace(self._simulated_process(), observe=self._real)


def _squared_distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return squared distances of points ``(2, n)`` and ``(2, m)``."""
    x = a[0, :, None] - b[0]
    y = a[1, :, None] - b[1]
    return x * x + y * y
