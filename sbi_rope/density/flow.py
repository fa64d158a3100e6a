r"""Trained flows behind their embedding nets, as one density."""

import copy
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from sbi_rope.density.base import Density, batches, without_nan
from sbi_rope.npe.sbi import (
    ConditionalEstimator,
    embedding_of,
    has_parameters,
    headless,
    readable,
    with_embedding,
)
from sbi_rope.training.ensemble import Ensemble, drawn, embedded, log_density, loss_of
from sbi_rope.utils.seeds import seeded

# Observations in one call of the embedding nets.
NET_BATCH = 1000


class Flow(Density):
    r"""The average of E flows, each behind an embedding net.

    .. math:: \sum_e w_e\, q_e(\theta \mid h_e(x))

    Flows of one architecture are trained, evaluated and sampled at once. They may share
    one net, or the nets may share one density.

    Args:
        nets: The embedding nets, E or one.
        densities: The densities behind them, E or one.
        input_shape: Shape of the parameters, ``(d,)``.
        condition_shape: Shape of one observation.
        weights: w, which sum to one; equal if None.
    """

    weights: Tensor

    def __init__(
        self,
        nets: Ensemble,
        densities: Ensemble,
        input_shape: Sequence[int],
        condition_shape: Sequence[int],
        weights: Tensor | None = None,
    ) -> None:
        super().__init__(input_shape, condition_shape)
        if len(nets) > 1 and not has_parameters(nets):
            nets = nets[[0]]  # without parameters, all are the same
        self.nets, self.densities = nets, densities
        if weights is None:
            weights = torch.ones(max(len(nets), len(densities)), dtype=torch.double)
            weights = weights / len(weights)
        device = next((one.device for one in self.parameters()), weights.device)
        self.register_buffer("weights", weights.to(device))
        self.eval().requires_grad_(requires_grad=False)

    @classmethod
    def of(
        cls,
        estimators: Sequence[ConditionalEstimator],
        *,
        nets: Sequence[nn.Module] | None = None,
    ) -> "Flow":
        """Return the average of copies of estimators of sbi, or with other ``nets``."""
        first = estimators[0]
        nets = [embedding_of(one) for one in estimators] if nets is None else nets
        densities = [headless(one) for one in estimators]
        with seeded(0), torch.no_grad():
            x = torch.randn(3, *first.condition_shape).to(next(first.parameters()))
            z = embedded(copy.deepcopy(nets[0]).eval(), x)
            # A vector field cannot be drawn from here, but there is one only.
            theta = drawn(densities[0], z) if len(densities) > 1 else z
        return cls(
            Ensemble(nets, embedded, (x,)),
            Ensemble(densities, log_density, (theta, z)),
            first.input_shape,
            first.condition_shape,
        )

    @classmethod
    def joined(cls, flows: "Sequence[Flow]") -> "Flow":
        """Return the average of flows that come from one NPE, with equal weights."""

        def joined(parts: Sequence[Ensemble]) -> Ensemble:
            # Where all have the same net, or density, the average has one, too.
            first, *others = (list(one.parameters()) for one in parts)
            same = all(all(map(torch.equal, first, other)) for other in others)
            if same and all(len(one) == 1 for one in parts):
                return copy.deepcopy(parts[0])
            full = [
                one if len(one) > 1 else one[[0] * flow.num_members]
                for one, flow in zip(parts, flows, strict=True)
            ]
            return Ensemble.joined(full)

        return flows[0]._with(
            joined([one.nets for one in flows]),
            joined([one.densities for one in flows]),
            torch.cat([one.weights / len(flows) for one in flows]),
        )

    @property
    def num_members(self) -> int:
        """The number of flows, E."""
        return len(self.weights)

    def __getitem__(self, numbers: Tensor | Sequence[int]) -> "Flow":
        """Return the average of copies of some of the flows; shared parts stay so."""
        some, nets, densities = torch.as_tensor(numbers), self.nets, self.densities
        nets = nets[some] if len(nets) > 1 else copy.deepcopy(nets)
        own = len(densities) == self.num_members
        densities = densities[some] if own else copy.deepcopy(densities)
        weights = self.weights[some]
        return self._with(nets, densities, weights / weights.sum())

    def made_of(
        self, members: Sequence[tuple[int, int]], nets: Ensemble | None = None
    ) -> "Flow":
        """Return the average of copies of numbered nets (or others) and densities."""
        of_nets, of_densities = zip(*members, strict=True)
        own = self.nets if nets is None else nets
        return self._with(own[of_nets], self.densities[of_densities])

    def _with(
        self, nets: Ensemble, densities: Ensemble, weights: Tensor | None = None
    ) -> "Flow":
        return Flow(nets, densities, self.input_shape, self.condition_shape, weights)

    def estimator(self, like: ConditionalEstimator) -> Any:
        """Return the first flow as an estimator of sbi, of the class of ``like``."""
        copied, density = copy.deepcopy(like), self.densities.member(0)
        headless(copied).load_state_dict(density.state_dict())  # shares its tensors
        return with_embedding(copied, self.nets.member(0)).eval()

    def losses(self, theta: Tensor, x: Tensor) -> Tensor:
        """Return the losses ``(E, B)`` at theta ``(E, B, d)``, x ``(E, B, *event)``."""
        return self.losses_given(theta, self.embeddings(x))

    def embeddings(self, x: Tensor) -> Tensor:
        """Embed the observations of each flow, ``(E, B, *event)`` to ``(E, B, l)``."""
        return self.nets.answer(embedded, x.flatten(0, 1)).unflatten(0, x.shape[:2])

    def losses_given(self, theta: Tensor, z: Tensor) -> Tensor:
        """Return the losses at embedded observations, shape ``(E, B, l)``."""
        losses = self.densities.answer(loss_of, theta.flatten(0, 1), z.flatten(0, 1))
        return losses.reshape(theta.shape[:2])

    @torch.no_grad()
    def embed(self, x: Tensor) -> Tensor:
        """Return the embeddings of observations, ``(B, E, l)`` or ``(B, 1, l)``."""
        count, parts = len(self.nets), []
        for some in x.split(max(1, NET_BATCH // count)):
            z = self.nets.answer(embedded, torch.cat([some] * count))
            parts.append(z.unflatten(0, (count, -1)))
        return torch.cat(parts, dim=1).transpose(0, 1)

    def log_q(self, theta: Tensor, z: Tensor) -> Tensor:
        """Return the log density at theta ``(S, B, d)``, shape ``(S, B)``, float64."""
        log_weights = self.weights.log()[:, None, None]
        return (self.log_probs(theta, z) + log_weights).logsumexp(0)

    def log_probs(self, theta: Tensor, z: Tensor) -> Tensor:
        """Return the log density of each flow at theta, ``(E, S, B)``, float64."""
        shape, count, parts = theta.shape[:2], self.num_members, []
        points = theta.flatten(0, 1).expand(count, -1, -1)
        row = torch.arange(len(z), device=theta.device).repeat(len(theta))
        for some in batches(torch.arange(len(row)).to(row), share=count):
            of_each = z[row[some]].expand(-1, count, -1).transpose(0, 1)
            pairs = points[:, some].flatten(0, 1), of_each.flatten(0, 1)
            log_probs = self.densities.answer(log_density, *pairs)
            parts.append(log_probs.double().reshape(count, -1))
        return without_nan(torch.cat(parts, dim=1)).reshape(count, *shape)

    @torch.no_grad()
    def draw(self, z: Tensor, row: Tensor) -> Tensor:
        """Draw once for each of n numbers of observations, ``(n, d)``."""
        theta = []
        for some in batches(row):
            member = torch.multinomial(self.weights.cpu(), len(some), replacement=True)
            member = member.to(row.device)
            conditions = z[some, member if z.shape[1] > 1 else 0]
            if len(self.densities) == 1:
                theta.append(self.densities.answer(drawn, conditions))
                continue
            # Each member draws for its own rows, padded to the same number for all.
            count = nn.functional.one_hot(member).cumsum(dim=0)
            place = count.gather(1, member[:, None])[:, 0] - 1
            padded = row.new_zeros(self.num_members, int(place.max()) + 1)
            padded[member, place] = torch.arange(len(some), device=row.device)
            of_all = self.densities.answer(drawn, conditions[padded].flatten(0, 1))
            theta.append(of_all.reshape(*padded.shape, -1)[member, place])
        return torch.cat(theta)

    def readable(self, x: Tensor) -> Tensor:
        """Tell which observations all nets can read."""
        return readable(self, x)

    def forward(self, x: Tensor) -> Tensor:
        """Return the embeddings by all nets, side by side, ``(B, E * l)``."""
        return self.embed(x).flatten(1)
