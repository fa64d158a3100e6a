"""Where this package touches the inside of sbi, and nowhere else.

sbi keeps the embedding h (its standardising layer followed by the user's network) as
one submodule of an estimator, under a name that depends on the family. It is found by
identity with the public property ``embedding_net``, which only the mixed estimator of
MNPE does not have.
"""

import copy
import warnings
from collections.abc import Sequence
from typing import Any, Literal

import torch
from sbi.inference import DirectPosterior, VectorFieldPosterior
from sbi.inference.posteriors.base_posterior import NeuralPosterior as NeuralPosterior
from sbi.inference.posteriors.filtered_direct_posterior import FilteredDirectPosterior
from sbi.inference.posteriors.npe_a_posterior import NPE_A_Posterior
from sbi.inference.potentials.base_potential import BasePotential as BasePotential
from sbi.neural_nets.estimators.base import (
    ConditionalDensityEstimator,
    ConditionalEstimator,
    ConditionalVectorFieldEstimator,
)
from sbi.neural_nets.estimators.base import (
    UnconditionalDensityEstimator as UnconditionalDensityEstimator,
)
from sbi.neural_nets.estimators.mixed_density_estimator import MixedDensityEstimator
from sbi.neural_nets.net_builders.flow import (
    build_zuko_unconditional_flow as build_zuko_unconditional_flow,
)
from sbi.samplers.mcmc import SliceSamplerVectorized as SliceSamplerVectorized
from sbi.utils.sbiutils import ImproperEmpirical, Standardize
from torch import Tensor, nn
from torch.distributions import Distribution

from sbi_rope.npe.prior import PriorDistribution
from sbi_rope.utils.errors import (
    InvalidInputError,
    LogProbUnavailableError,
    UnsupportedPosteriorError,
)
from sbi_rope.utils.seeds import seeded
from sbi_rope.utils.settings import names_of
from sbi_rope.utils.tensors import as_batch, rows_with

# A row may differ by this share of the largest embedding when it is alone.
ROUNDING = 0.01
# An entry does not vary if its standard deviation is less than this share of its mean,
# or what sbi divides it by then.
CONSTANT, SMALLEST_STD = 1e-6, 1e-7


def embedding_of(estimator: ConditionalEstimator) -> nn.Module:
    r"""Return :math:`h`, the embedding of x, of a trained estimator.

    It includes sbi's standardising layer. Without a user-given network it is that
    layer alone; with ``z_score_x="none"`` as well it is the identity.
    """
    is_mixed = isinstance(estimator, MixedDensityEstimator)
    name = "condition_embedding" if is_mixed else "embedding_net"
    embedding: Any = getattr(estimator, name, None)
    if not _paths_to(estimator, embedding):
        raise UnsupportedPosteriorError(
            "Expected an estimator of sbi's posterior_nn with a trained embedding net; "
            f"got {type(estimator).__name__}."
        )
    return embedding


def headless(estimator: ConditionalEstimator) -> Any:
    r"""Return :math:`q(\theta \mid h)`, which shares the parameters of an estimator."""
    blank = parameter_of(estimator).new_zeros(1, *estimator.condition_shape)
    shape = embed(embedding_of(estimator), blank).shape[1:]
    clone = with_embedding(estimator, nn.Identity(), condition_shape=shape)
    return MixedDensity(clone) if isinstance(clone, MixedDensityEstimator) else clone


def with_embedding(
    estimator: ConditionalEstimator,
    embedding: nn.Module,
    *,
    condition_shape: Sequence[int] | None = None,
) -> Any:
    r"""Return the estimator with another embedding in the place of :math:`h`.

    The other parameters are shared with ``estimator``, which is left as it was. The
    ``condition_shape`` is that of what the new net embeds; as before if None.
    """
    clone: Any = estimator
    for path in _paths_to(estimator, embedding_of(estimator)):
        clone = _replaced(clone, path.split("."), embedding, condition_shape)
    return clone


def _paths_to(root: nn.Module, target: nn.Module) -> list[str]:
    named = root.named_modules(remove_duplicate=False)
    return [name for name, module in named if module is target and name]


def _replaced(
    root: Any, path: list[str], new: nn.Module, shape: Sequence[int] | None
) -> nn.Module:
    """Put a module at the end of a path, along which modules are copied."""
    if not path:
        return new
    clone = copy.copy(root)  # without its tensors
    clone._modules = dict(root._modules)
    clone._modules[path[0]] = _replaced(root._modules[path[0]], path[1:], new, shape)
    if shape is not None and isinstance(clone, ConditionalEstimator):
        clone._condition_shape = torch.Size(shape)
    return clone


def embed(net: nn.Module, x: Tensor, *, batch_size: int = 1000) -> Tensor:
    """Apply a net in evaluation mode, in batches, without gradients, to ``(n, l)``."""
    was_training = net.training
    try:
        with torch.no_grad():
            net.eval()
            # A net may change its argument, as activations in place do.
            return torch.cat([net(part.clone()) for part in x.split(batch_size)])
    finally:
        net.train(was_training)


def standardisation_of(embedding_net: nn.Module) -> tuple[Tensor, Tensor] | None:
    """Return mean and standard deviation of sbi's standardising layer, if any."""
    layers = (part for part in embedding_net.modules() if isinstance(part, Standardize))
    layer: Any = next(layers, None)
    return None if layer is None else (layer._mean, layer._std)


@torch.no_grad()
def leave_out_constants(embedding_net: nn.Module) -> None:
    """Make a net ignore the entries of x that were the same in all of its training.

    sbi divides them by 1e-7, so that one that does vary in an observation would be much
    larger than all other entries.
    """
    if (mean_and_std := standardisation_of(embedding_net)) is not None:
        mean, std = mean_and_std
        is_constant = std <= (CONSTANT * mean.abs()).clamp_min(SMALLEST_STD)
        std.masked_fill_(is_constant, torch.inf)


def has_parameters(net: nn.Module) -> bool:
    """Tell whether a net can learn, and lose information about x."""
    return any(True for _ in net.parameters())


def parameter_of(module: nn.Module) -> Tensor:
    """Return a parameter of a module, which has its dtype and device."""
    return next(p for p in module.parameters() if p.is_floating_point())


def readable(net: nn.Module, x: Tensor) -> Tensor:
    """Tell which observations an embedding net can read, ``(n, *event)`` to ``(n,)``.

    It can read what is finite. Some nets also read observations with missing entries
    (NaN), such as sbi's ``PermutationInvariantEmbedding``; none reads Inf, or NaN only.
    """
    rows = x.flatten(1)
    finite = torch.isfinite(rows)
    can_read = finite.all(dim=1)
    partial = ~can_read & finite.any(dim=1) & ~torch.isinf(rows).any(dim=1)
    if not partial.any():
        return can_read
    try:
        embedded = embed(net, x[partial])
    except Exception:  # nets refuse NaN with errors of any kind
        return can_read
    can_read[partial] = torch.isfinite(embedded).flatten(1).all(dim=1)
    if not (partial & can_read).any():
        return can_read
    # sbi 0.27 takes the number of trials from another row if trials have several
    # columns. Sets with some, no and most trials missing stand side by side here.
    some = x[partial & can_read][:2]
    full = some.nan_to_num(0.0)
    sparse = full.clone()
    if x.ndim > 2:
        sparse[:, 1:] = torch.nan
    sets = torch.stack([some, full, sparse], dim=1).flatten(0, 1)
    together = embed(net, sets).nan_to_num(0.0)
    alone = torch.cat([embed(net, row) for row in sets.split(1)]).nan_to_num(0.0)
    if ((together - alone).abs() > ROUNDING * together.abs().max()).any():
        raise UnsupportedPosteriorError(
            "Expected an embedding net that reads each observation by itself; got "
            "another embedding of a row alone than in a batch."
        )
    return can_read


class MixedDensity(ConditionalDensityEstimator):
    """The mixed estimator of MNPE, as a density over all of the prior's support.

    It is zero at a category that was not trained on, which sbi gives the mass of the
    next larger one or refuses.
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
        count = len(categories)
        # Detached, so that gradient ascent does not move between categories.
        discrete = input[..., -count:].detach()
        columns = zip(discrete.unbind(-1), categories, strict=True)
        trained = torch.stack([torch.isin(c, v.to(c)) for c, v in columns], dim=-1)
        # Any category that can be evaluated stands in for what cannot be.
        some = torch.stack([values[0] for values in categories]).to(discrete)
        valid = [input[..., :-count], discrete.where(trained, some)]
        log_prob = self.mixed.log_prob(torch.cat(valid, dim=-1), condition)
        return log_prob.where(trained.all(dim=-1), -torch.inf)

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

    Its density would need one ODE solve per component and parameter.
    """

    def __init__(
        self,
        estimator: ConditionalVectorFieldEstimator,
        prior: Distribution,
        sample_with: Literal["ode", "sde"],
    ) -> None:
        super().__init__(estimator, estimator.input_shape, estimator.condition_shape)
        self.vector_field, self.prior, self.sample_with = estimator, prior, sample_with

    def sample(
        self, sample_shape: torch.Size, condition: Tensor, **kwargs: Any
    ) -> Tensor:
        """Solve the ODE or SDE for every condition; no prior support is enforced."""
        how: Any = {"show_progress_bars": False, "reject_outside_prior": False}
        with warnings.catch_warnings():
            # Draws outside the prior are rejected by the mixture; the batch is ours.
            warnings.simplefilter("ignore")
            return _built(
                VectorFieldPosterior,
                self.vector_field,
                self.prior,
                sample_with=self.sample_with,
            ).sample_batched(sample_shape, condition, **how)

    def log_prob(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        """Raise: the density of a vector field is not evaluated."""
        raise LogProbUnavailableError(
            "log_prob is not available for posteriors of FMPE and NPSE: every mixture "
            "component would need its own ODE solve. Use samples, or train NPE."
        )

    def loss(self, input: Tensor, condition: Tensor, **kwargs: Any) -> Tensor:
        """Return the loss of the vector field."""
        return self.vector_field.loss(input, condition, **kwargs)


def estimator_of(posterior: Any) -> ConditionalEstimator:
    """Return the trained estimator inside an sbi posterior, if it can be split."""
    prior = getattr(posterior, "prior", None)
    if isinstance(prior, ImproperEmpirical):
        raise UnsupportedPosteriorError(
            "Expected a posterior that knows its prior; got none. Use "
            "`npe.build_posterior(prior=prior)`."
        )
    if isinstance(posterior, VectorFieldPosterior):
        return posterior.vector_field_estimator
    estimator: Any = getattr(posterior, "posterior_estimator", None)
    if (
        not isinstance(posterior, DirectPosterior)
        or isinstance(posterior, FilteredDirectPosterior | NPE_A_Posterior)
        or hasattr(estimator, "log_q")  # a density of this package
    ):
        raise UnsupportedPosteriorError(
            "Expected `posterior` to be what `NPE(...).build_posterior()` returns, or "
            f"the posterior of MNPE, FMPE or NPSE; got {type(posterior).__name__}."
        )
    return estimator


def check_density(
    estimator: Any, *, what: str = "an estimator"
) -> ConditionalDensityEstimator:
    """Return an estimator if it has a density; say what needs one otherwise."""
    if not isinstance(estimator, ConditionalDensityEstimator):
        raise UnsupportedPosteriorError(
            f"Expected {what} with a density, such as that of NPE; got "
            f"{type(estimator).__name__}. Train NPE instead of FMPE or NPSE."
        )
    return estimator


def posterior_from(
    posterior: Any, estimator: Any
) -> DirectPosterior | VectorFieldPosterior:
    """Return an sbi posterior of the same kind as ``posterior`` around an estimator."""
    kind, options = DirectPosterior, {"enable_transform": posterior.enable_transform}
    if not isinstance(estimator, ConditionalDensityEstimator):
        kind, options["sample_with"] = VectorFieldPosterior, posterior.sample_with
    return _built(kind, estimator, posterior.prior, **options)


def direct_posterior(estimator: Any, prior: Distribution) -> DirectPosterior:
    """Return an sbi posterior around a density and a copy of the prior."""
    return _built(DirectPosterior, estimator, prior)


def _built(kind: type, estimator: Any, prior: Distribution, **options: Any) -> Any:
    device = parameter_of(estimator).device
    with seeded(0):  # sbi draws from the prior to look at it
        return kind(estimator, copy.deepcopy(prior), device=device, **options)


class TrainedNPE:
    r"""A copy of a trained estimator :math:`q(\theta \mid h(x))`, in its two parts.

    Attributes:
        estimator: The copy of the estimator, in evaluation mode.
        prior: The copy of the prior, with one set of shapes.
        h: The embedding net of the copy, with sbi's standardising layer.
        like: An empty tensor ``(0, d)`` with the dtype and device of the estimator.
        event_shape: The shape of one observation.
        is_mixed: Whether some parameters are discrete.
        enable_transform: Whether sbi's ``map`` searches in an unbounded space.
        parameter_names: The names of the parameters; None if there are none.
        x_names: The names of the columns of tables of x; None if they are not known.
    """

    def __init__(self, posterior: Any, parameter_names: Any = None) -> None:
        estimator = copy.deepcopy(estimator_of(posterior)).eval()
        self.estimator = estimator.requires_grad_(requires_grad=False)
        self.h, self._q = embedding_of(estimator), headless(estimator)
        self._posterior: Any = posterior_from(posterior, estimator)
        self.prior = PriorDistribution(posterior.prior)
        self.like = parameter_of(estimator).new_empty(0, *estimator.input_shape)
        self.event_shape: torch.Size = estimator.condition_shape
        self.is_mixed = isinstance(self._q, MixedDensity)
        self.enable_transform: bool = posterior.enable_transform
        self.parameter_names: tuple[str, ...] | None = None
        if parameter_names is not None:
            self.parameter_names = names_of(parameter_names, self.like.shape[1])
        self.x_names: tuple[str, ...] | None = None
        leave_out_constants(self.h)

    def posterior(self, embedding_net: nn.Module | None = None) -> Any:
        """Return a copy of the sbi posterior, with another net in the place of h."""
        estimator = self.estimator
        if embedding_net is not None:
            estimator = with_embedding(estimator, embedding_net)
        return posterior_from(self._posterior, copy.deepcopy(estimator))

    def density(self) -> ConditionalDensityEstimator:
        r"""Return a copy of :math:`q(\theta \mid s)`, given an embedding s."""
        density = self._q
        if not isinstance(density, ConditionalDensityEstimator):
            sample_with = self._posterior.sample_with
            density = VectorFieldDensity(density, self.prior, sample_with)
        return copy.deepcopy(density)

    def embed(self, name: str, x: Tensor, embedding_net: nn.Module) -> Tensor:
        """Return the finite embeddings of a user's observations, shape ``(n, l)``."""
        return as_batch(f"embeddings of {name}", embed(embedding_net, x))

    def as_x(self, name: str, x: Any, *, rows: int | None = None) -> Tensor:
        """Return a copy of a user's observations, if h can read them."""
        options: dict[str, Any] = {"device": self.like.device, "names": self.x_names}
        x = as_batch(name, x, self.event_shape, rows=rows, finite=False, **options)
        x = x.to(self.like.dtype, copy=True)
        if not (can_read := self.readable(x)).all():
            raise InvalidInputError(
                f"Expected `{name}` without NaN or Inf that the embedding net of NPE "
                f"cannot read; got {rows_with(~can_read)}."
            )
        return x

    def readable(self, x: Tensor) -> Tensor:
        """Tell which observations h can read, ``(n,)``; some nets can read NaN."""
        return readable(self.h, x)
