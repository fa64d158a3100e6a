r"""Where this package touches the inside of sbi, and nowhere else.

An NPE estimator is :math:`q(\theta \mid h(x))`. sbi keeps the embedding :math:`h` (its
standardising layer followed by the user's network) as one submodule of the estimator,
under a name that depends on the family. Everything here finds that submodule by
identity with the public property ``embedding_net``, so that it holds for every family;
the mixed estimator of MNPE, which has no such property, is the exception.
"""

import copy
import warnings
from collections.abc import Iterator, Sequence
from typing import Any, Literal

import torch
from sbi.inference.posteriors.base_posterior import NeuralPosterior
from sbi.inference.posteriors.direct_posterior import DirectPosterior
from sbi.inference.posteriors.filtered_direct_posterior import FilteredDirectPosterior
from sbi.inference.posteriors.npe_a_posterior import NPE_A_Posterior
from sbi.inference.posteriors.vector_field_posterior import VectorFieldPosterior
from sbi.inference.potentials.base_potential import BasePotential
from sbi.neural_nets.estimators.base import (
    ConditionalDensityEstimator,
    ConditionalEstimator,
    ConditionalVectorFieldEstimator,
    UnconditionalDensityEstimator,
)
from sbi.neural_nets.estimators.mixed_density_estimator import MixedDensityEstimator
from sbi.neural_nets.estimators.tabpfn_flow import TabPFNFlow
from sbi.neural_nets.net_builders.flow import build_zuko_unconditional_flow
from sbi.samplers.mcmc import SliceSamplerVectorized
from sbi.utils.sbiutils import Standardize
from sbi.utils.user_input_checks_utils import move_distribution_to_device
from torch import Tensor, nn
from torch.distributions import Distribution

from sbi_rope._random import seeded
from sbi_rope.errors import (
    InvalidInputError,
    LogProbUnavailableError,
    UnsupportedPosteriorError,
)

__all__ = [
    "BasePotential",
    "ConditionalDensityEstimator",
    "ConditionalEstimator",
    "DirectPosterior",
    "MixedDensity",
    "MixtureDensity",
    "NeuralPosterior",
    "SliceSamplerVectorized",
    "Standardize",
    "UnconditionalDensityEstimator",
    "VectorFieldDensity",
    "build_zuko_unconditional_flow",
    "copy_of_prior",
    "device_of",
    "direct_posterior",
    "dtype_of",
    "embed",
    "embedding_of",
    "estimator_of",
    "headless",
    "is_bounded",
    "move_distribution_to_device",
    "posterior_from",
    "with_embedding",
]


def estimator_of(posterior: Any) -> ConditionalEstimator:
    """Return the trained estimator inside an sbi posterior.

    Raises:
        UnsupportedPosteriorError: If the posterior is not a plain amortised posterior
            of NPE, FMPE or NPSE.
    """
    if isinstance(posterior, VectorFieldPosterior):
        return posterior.vector_field_estimator
    plain = isinstance(posterior, DirectPosterior) and not isinstance(
        posterior, FilteredDirectPosterior | NPE_A_Posterior
    )
    if plain and isinstance(posterior.posterior_estimator, MixtureDensity):
        raise UnsupportedPosteriorError(
            "Expected `posterior` to be what `NPE(...).build_posterior()` returns; got "
            f"{type(posterior).__name__} around a mixture of such posteriors, which "
            "has no single embedding of x. What RoPE, a stack or a baseline has "
            "repaired cannot be repaired again: pass the posterior it was built from."
        )
    if not plain and hasattr(posterior, "build_posterior"):
        raise UnsupportedPosteriorError(
            "Expected `posterior` to be what `NPE(...).build_posterior()` returns; got "
            f"{type(posterior).__name__}, which has still to build it."
        )
    if not plain:
        raise UnsupportedPosteriorError(
            "Expected `posterior` to be what `NPE(...).build_posterior()` returns "
            "with sample_with='direct' (a DirectPosterior), or the posterior of FMPE "
            f"or NPSE; got {type(posterior).__name__}. RoPE needs an amortised "
            "posterior whose estimator has an embedding of x."
        )
    return posterior.posterior_estimator


def is_bounded(posterior: DirectPosterior) -> bool:
    """Tell whether a posterior normalises by other means than sbi's own rejection.

    That goes on until enough draws are inside the prior, which may be for ever.
    """
    # NPE_A_Posterior of sbi has a method of its own, but of the same kind.
    return type(posterior).leakage_correction.__module__.split(".")[0] != "sbi"


def embedding_of(estimator: ConditionalEstimator) -> nn.Module:
    r"""Return :math:`h`, the embedding of x, of a trained estimator.

    It includes sbi's standardising layer. Without a user-given network it is that
    layer alone; with ``z_score_x="none"`` as well it is the identity.

    Raises:
        UnsupportedPosteriorError: If the estimator does not expose its embedding.
    """
    if isinstance(estimator, TabPFNFlow):
        raise UnsupportedPosteriorError(
            "Expected an estimator whose embedding of x was trained; got TabPFNFlow "
            "(NPE-PFN), which compares x with stored simulations instead and has "
            "nothing to tune. Train NPE on the same simulations and pass its posterior."
        )
    if isinstance(estimator, MixedDensityEstimator):
        return _embedding_of_mixed(estimator)
    embedding = getattr(estimator, "embedding_net", None)
    if not isinstance(embedding, nn.Module) or not _paths_to(estimator, embedding):
        raise UnsupportedPosteriorError(
            f"Cannot separate the embedding net of a {type(estimator).__name__} from "
            "its density. Supported: the mixture density networks, nflows and zuko "
            "flows, mixed estimators (MNPE), and vector fields of sbi."
        )
    return embedding


def _embedding_of_mixed(estimator: MixedDensityEstimator) -> nn.Module:
    # Its two halves see x through one net. Tuning a net that only one of them uses
    # would leave the other with the embedding of the simulations.
    embedding = estimator.condition_embedding
    if estimator.discrete_net.net.embedding_net is not embedding:
        raise UnsupportedPosteriorError(
            "Expected a MixedDensityEstimator whose discrete and continuous parts "
            "share one embedding net; got two. Build it with "
            "`posterior_nn('mnpe', embedding_net=...)`."
        )
    return embedding


def headless(estimator: ConditionalEstimator) -> Any:
    r"""Return :math:`q(\theta \mid s)`: the estimator without its embedding.

    The parameters are shared with ``estimator``, which is left as it was.
    """
    embedding = embedding_of(estimator)
    blank = torch.zeros(
        1,
        *estimator.condition_shape,
        dtype=dtype_of(estimator),
        device=device_of(estimator),
    )
    statistic_shape = embed(embedding, blank).shape[1:]
    if len(statistic_shape) != 1:
        raise UnsupportedPosteriorError(
            "Expected the embedding net to return one vector per observation, shape "
            f"(n, l); got {('n', *statistic_shape)}."
        )
    clone = with_embedding(estimator, nn.Identity(), condition_shape=statistic_shape)
    return MixedDensity(clone) if isinstance(clone, MixedDensityEstimator) else clone


def with_embedding(
    estimator: ConditionalEstimator,
    embedding: nn.Module,
    *,
    condition_shape: Sequence[int] | None = None,
) -> Any:
    r"""Return the estimator with another embedding in the place of :math:`h`.

    The other parameters are shared with ``estimator``, which is left as it was.

    Args:
        estimator: A trained estimator, or a headless one.
        embedding: What takes the place of its embedding.
        condition_shape: Shape of what that embeds; as before if None.
    """
    clone: nn.Module = estimator
    paths = _paths_to(estimator, embedding_of(estimator))
    for path in paths:
        clone = _replace(clone, path.split("."), embedding)
    if condition_shape is None:
        return clone
    for path in paths:
        for module in _modules_along(clone, path):
            if isinstance(module, ConditionalEstimator):
                module._condition_shape = torch.Size(condition_shape)
    return clone


def posterior_from(
    posterior: Any, estimator: ConditionalEstimator
) -> DirectPosterior | VectorFieldPosterior:
    """Return an sbi posterior of the same kind as ``posterior`` around an estimator."""
    if not isinstance(estimator, ConditionalVectorFieldEstimator):
        assert isinstance(estimator, ConditionalDensityEstimator)
        return direct_posterior(
            estimator, posterior.prior, enable_transform=posterior.enable_transform
        )
    with seeded(0):  # sbi draws from the prior to look at it
        return VectorFieldPosterior(
            estimator,
            copy_of_prior(posterior.prior),
            device=device_of(estimator),
            enable_transform=posterior.enable_transform,
            sample_with=posterior.sample_with,
        )


def copy_of_prior(prior: Any) -> Any:
    """Copy a prior, which sbi moves to devices in place.

    Raises:
        InvalidInputError: If it cannot be copied.
    """
    try:
        return copy.deepcopy(prior)
    except Exception as error:  # of whatever it holds
        raise InvalidInputError(
            f"Expected a prior that can be copied; `copy.deepcopy` of this "
            f"{type(prior).__name__} raised {type(error).__name__}: {error}. Detach "
            "its tensors from their graph, and leave out what cannot be copied."
        ) from error


def direct_posterior(
    estimator: ConditionalDensityEstimator,
    prior: Distribution,
    *,
    enable_transform: bool = True,
) -> DirectPosterior:
    """Return an sbi posterior around an estimator and a copy of the prior."""
    with seeded(0):  # sbi draws from the prior to look at it
        return DirectPosterior(
            estimator,
            copy_of_prior(prior),
            device=device_of(estimator),
            enable_transform=enable_transform,
        )


class MixtureDensity(ConditionalDensityEstimator):
    """A density that mixes others given several contexts of an observation.

    So it has no single embedding of x, which could be tuned or taken off.
    """


class MixedDensity(ConditionalDensityEstimator):
    """The mixed estimator of MNPE, as a density over all of the prior's support.

    Where sbi's own has no density it is zero: at a category that was not trained on,
    which sbi gives the mass of the next larger one or refuses, and with
    ``log_transform_x`` at zero and below, where sbi returns NaN.
    """

    def __init__(self, estimator: MixedDensityEstimator) -> None:
        super().__init__(estimator, estimator.input_shape, estimator.condition_shape)
        self.mixed = estimator

    @property
    def embedding_net(self) -> nn.Module:
        """The embedding net of both parts."""
        return self.mixed.condition_embedding

    def log_prob(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        """Return the log of density times mass, ``(S, B)``."""
        categories = self.mixed.discrete_net.net.categorical_values_per_var
        continuous = input[..., : -len(categories)]
        # Detached, so that gradient ascent does not move between categories.
        discrete = input[..., -len(categories) :].detach()
        trained = torch.stack(
            [
                torch.isin(column, values.to(column))
                for column, values in zip(discrete.unbind(-1), categories, strict=True)
            ],
            dim=-1,
        )
        inside = torch.ones_like(continuous, dtype=torch.bool)
        if self.mixed.log_transform_input:
            inside = continuous > 0
        # Anything that can be evaluated stands in for what cannot.
        some = torch.stack([values[0] for values in categories]).to(discrete)
        valid = torch.cat(
            [continuous.where(inside, 1.0), discrete.where(trained, some)], dim=-1
        )
        log_prob = self.mixed.log_prob(valid, condition)
        possible = trained.all(dim=-1) & inside.all(dim=-1)
        return log_prob.where(possible, -torch.inf)

    def sample(
        self, sample_shape: torch.Size, condition: Tensor, **kwargs: Any
    ) -> Tensor:
        """Draw the discrete parameters, then the continuous ones given these."""
        return self.mixed.sample(sample_shape, condition, **kwargs)

    def loss(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        """Return the negative log-probability, shape ``(B,)``."""
        return -self.log_prob(input[None], condition)[0]


class VectorFieldDensity(ConditionalDensityEstimator):
    """A vector field (FMPE, NPSE) in the shape of a density that can only be sampled.

    Its density would need one ODE solve per component and parameter, so ``log_prob``
    raises instead of starting hours of work.
    """

    def __init__(
        self,
        estimator: ConditionalVectorFieldEstimator,
        prior: Distribution,
        sample_with: Literal["ode", "sde"],
    ) -> None:
        super().__init__(estimator, estimator.input_shape, estimator.condition_shape)
        self.vector_field = estimator
        self.prior = prior
        self.sample_with: Literal["ode", "sde"] = sample_with

    def sample(
        self, sample_shape: torch.Size, condition: Tensor, **kwargs: Any
    ) -> Tensor:
        """Solve the ODE or SDE for every condition; no prior support is enforced."""
        with seeded(0):  # sbi draws from the prior to look at it
            posterior = VectorFieldPosterior(
                self.vector_field,
                self.prior,
                device=condition.device,
                sample_with=self.sample_with,
            )
        with warnings.catch_warnings():
            # Draws outside the prior are rejected by the mixture; the batch is ours.
            warnings.filterwarnings("ignore", message=".*outside the prior support")
            warnings.filterwarnings("ignore", message="Capping max_sampling_batch")
            warnings.filterwarnings("ignore", message="Note that for batched sampling")
            return posterior.sample_batched(
                sample_shape,
                condition,
                show_progress_bars=False,
                reject_outside_prior=False,
            )

    def log_prob(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        """Raise: the density of a vector field is not evaluated."""
        raise LogProbUnavailableError(
            "log_prob is not available for posteriors of FMPE and NPSE: every mixture "
            "component would need its own ODE solve. Use samples, or train NPE."
        )

    def loss(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        """Return the loss of the vector field."""
        return self.vector_field.loss(input, condition, **kwargs)


def embed(net: nn.Module, x: Tensor, *, batch_size: int = 1000) -> Tensor:
    """Apply an embedding net without gradients, in batches: ``(n, *)`` to ``(n, l)``.

    The net runs in evaluation mode: no dropout, and batch normalisation with its
    trained statistics, so that the result does not depend on the batch.
    """
    modes = {module: module.training for module in net.modules()}
    net.eval()
    try:
        with torch.no_grad():
            # A net may change its argument, as activations in place do.
            return torch.cat([net(part.clone()) for part in x.split(batch_size)])
    finally:
        for module, training in modes.items():
            module.training = training


def dtype_of(module: nn.Module) -> torch.dtype:
    """Return the floating dtype of a module's parameters."""
    return next(p.dtype for p in module.parameters() if p.is_floating_point())


def device_of(module: nn.Module) -> torch.device:
    """Return the device of a module's parameters."""
    return next(p.device for p in module.parameters())


def _paths_to(root: nn.Module, target: nn.Module) -> list[str]:
    named = root.named_modules(remove_duplicate=False)
    return [name for name, module in named if module is target and name]


def _modules_along(root: nn.Module, path: str) -> Iterator[nn.Module]:
    """Yield the modules from the root to the parent of a path's end."""
    yield root
    for name in path.split(".")[:-1]:
        root = root.get_submodule(name)
        yield root


def _replace(root: nn.Module, path: list[str], new: nn.Module) -> nn.Module:
    # Only the modules along the path are copied, and those without their tensors.
    clone = copy.copy(root)
    clone._modules = dict(root._modules)
    child = root._modules[path[0]]
    if len(path) > 1:
        assert child is not None
        new = _replace(child, path[1:], new)
    clone._modules[path[0]] = new
    return clone
