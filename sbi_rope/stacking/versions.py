"""A candidate of a stack in all its versions."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_rope.density import Density, Flow, Mixture, MixturePosterior

__all__ = ["Versions", "fold_posterior", "mixture_of"]


@dataclass(frozen=True, eq=False)
class Versions:
    """The densities of a candidate, one for each version, and their average.

    A stack is made of the models that were scored: the candidate is deployed as the
    average of its versions. Flows are averaged in one network, from which each version
    can be taken out.

    Attributes:
        average: The average of all versions with equal weights.
        place: The number of each version among those that differ.
        sizes: How many flows of the average belong to each that differs.
    """

    average: Density
    place: list[int]
    sizes: list[int]

    @classmethod
    def of(cls, densities: Sequence[Density]) -> "Versions":
        """Return the versions of a candidate; equal ones are one object."""
        different = list({id(one): one for one in densities}.values())
        place = [[one is other for other in different].index(True) for one in densities]
        sizes = [1] * len(different)
        if len(different) == 1:
            return cls(different[0], place, sizes)
        flows = [one for one in different if isinstance(one, Flow)]
        if len(flows) == len(different):
            sizes = [one.num_members for one in flows]
            return cls(Flow.joined(flows), place, sizes)
        return cls(Mixture(different, [1 / len(sizes)] * len(sizes)), place, sizes)

    def __len__(self) -> int:
        return len(self.place)

    def __getitem__(self, version: int) -> Density:
        """Return the density of one version."""
        number, average = self.place[version], self.average
        if len(self.sizes) == 1:
            return average
        if isinstance(average, Flow):
            start = sum(self.sizes[:number])
            return average[torch.arange(start, start + self.sizes[number])]
        assert isinstance(average, Mixture)
        return average.parts[number]


def mixture_of(
    candidates: Sequence[Versions], weights: Tensor, version: int | None = None
) -> Mixture:
    """Return the mixture of candidates in one version, or in the average of all."""
    parts = [one.average if version is None else one[version] for one in candidates]
    return Mixture(parts, weights)


def fold_posterior(mixture: Mixture, prior: Distribution) -> MixturePosterior:
    """Return the posterior of a stack that has not seen a fold.

    It does not warn of observations that are far from simulations, because RoPE has.
    """
    posterior = MixturePosterior(mixture, prior, enable_transform=False)
    posterior.warns = False
    return posterior
