r"""An NPE estimator :math:`q(\theta \mid h(x))`, split into h and q.

sbi keeps the embedding :math:`h` (its standardising layer followed by the user's
network) as one submodule of the estimator, under a name that depends on the family.
Everything here finds that submodule by identity with the public property
``embedding_net``, so that it holds for every family; the mixed estimator of MNPE, which
has no such property, is the exception.
"""

import copy
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from sbi.neural_nets.estimators.base import ConditionalEstimator
from sbi.neural_nets.estimators.mixed_density_estimator import MixedDensityEstimator
from sbi.neural_nets.estimators.tabpfn_flow import TabPFNFlow
from sbi.utils.sbiutils import Standardize
from torch import Tensor, nn

from sbi_rope._sbi.densities import MixedDensity
from sbi_rope.errors import UnsupportedPosteriorError

__all__ = [
    "device_of",
    "dtype_of",
    "embed",
    "embedding_of",
    "headless",
    "standardisation_of",
    "with_embedding",
]


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
            "(NPE-PFN)."
        )
    if isinstance(estimator, MixedDensityEstimator):
        return _embedding_of_mixed(estimator)
    embedding = getattr(estimator, "embedding_net", None)
    if not isinstance(embedding, nn.Module) or not _paths_to(estimator, embedding):
        raise UnsupportedPosteriorError(
            "Expected an estimator of sbi's posterior_nn with an embedding net; got "
            f"{type(estimator).__name__}."
        )
    return embedding


def _embedding_of_mixed(estimator: MixedDensityEstimator) -> nn.Module:
    # Its two halves see x through one net. Tuning a net that only one of them uses
    # would leave the other with the embedding of the simulations.
    embedding = estimator.condition_embedding
    if estimator.discrete_net.net.embedding_net is not embedding:
        raise UnsupportedPosteriorError(
            "Expected a MixedDensityEstimator whose two parts share one embedding net; "
            "got two. Use `posterior_nn('mnpe', embedding_net=...)`."
        )
    return embedding


def headless(estimator: ConditionalEstimator) -> Any:
    r"""Return :math:`q(\theta \mid h)`: the estimator without its embedding.

    The parameters are shared with ``estimator``, which is left as it was.
    """
    embedding = embedding_of(estimator)
    blank = torch.zeros(
        1,
        *estimator.condition_shape,
        dtype=dtype_of(estimator),
        device=device_of(estimator),
    )
    embedded_shape = embed(embedding, blank).shape[1:]
    if len(embedded_shape) != 1:
        raise UnsupportedPosteriorError(
            "Expected the embedding net to return one vector per observation, shape "
            f"(n, l); got {('n', *embedded_shape)}."
        )
    clone = with_embedding(estimator, nn.Identity(), condition_shape=embedded_shape)
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


def standardisation_of(embedding_net: nn.Module) -> tuple[Tensor, Tensor] | None:
    """Return the mean and standard deviation by which sbi standardises x.

    Args:
        embedding_net: That of a trained estimator, as :func:`embedding_of` returns it.

    Returns:
        The tensors that sbi's layer uses, each of the shape of one observation or
        scalar; None if the net has no such layer.
    """
    layers = (part for part in embedding_net.modules() if isinstance(part, Standardize))
    layer: Any = next(layers, None)
    return None if layer is None else (layer._mean, layer._std)


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
