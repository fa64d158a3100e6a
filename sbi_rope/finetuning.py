"""Fine-tuning the embedding net on real observations with known parameters."""

import copy
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor, nn

from sbi_rope._groups import split_pairs
from sbi_rope._progress import is_shown
from sbi_rope._random import seeded
from sbi_rope._sbi import embed
from sbi_rope._training import History, best_of_learning_rates, epochs_on_pairs, fit
from sbi_rope.errors import InvalidInputError
from sbi_rope.settings import Count, NotNegative, Positive, Range, Settings, check
from sbi_rope.tensors import as_batch, rows_with

__all__ = ["CalibrationFinetuner", "FinetuneResult", "History"]

# The number of simulations to rehearse with, and how many of them each epoch uses.
NUM_REHEARSED = 2000
REHEARSED_IN_EPOCH = 50


@dataclass(frozen=True, eq=False)
class FinetuneResult:
    """The fine-tuned embedding net and the course of its training.

    Attributes:
        embedding_net: :math:`g`, in evaluation mode.
        history: The losses, and the epoch that was kept.
    """

    embedding_net: nn.Module
    history: History


@dataclass(frozen=True, kw_only=True)
class CalibrationFinetuner(Settings):
    r"""Tunes a copy g of the embedding net h on calibration pairs.

    It minimises, with the norm not squared,

    .. math::
        \mathcal{L}(g) = \sum_{i=1}^{n_c} \Bigl\lVert g(x_{o,i})
        - \mathbb{E}_{\varepsilon}\bigl[h(S(\theta_i, \varepsilon))\bigr]
        \Bigr\rVert_2,

    starting from g = h, with Adam on all training pairs at once. A fifth of the pairs
    is held out; pairs of the same group are held out together. Of all epochs,
    including the start, the g with the smallest loss on the held-out pairs is kept. On
    these pairs, tuning therefore never makes g worse than h.

    With ``rehearsal`` :math:`\lambda > 0` it also minimises, over simulations from the
    prior, :math:`\lambda\, \mathbb{E} \lVert g(x_s) - h(x_s) \rVert_2`, which is not in
    the paper. In continual learning this is called rehearsal with feature distillation:
    g learns from h on simulations, so that it does not forget how h embeds them. It
    helps if a large net is tuned on few pairs; ``docs/background/benchmark.md`` says
    where it helps and where it does harm. The loss on the held-out pairs does not
    contain it.

    The net is tuned in evaluation mode (no dropout, fixed batch statistics). If h has
    no trainable parameters, because NPE was trained without an embedding net, g is h
    followed by an affine map that starts as the identity.

    References:
        | Addressing Misspecification in Simulation-based Inference through Data-driven
          Calibration (Wehenkel et al., 2025), eq. 6 and Algorithm 1, step 2
        | https://arxiv.org/abs/2405.08719
        | Learning without Forgetting (Li and Hoiem, 2016), for the distillation
        | https://arxiv.org/abs/1606.09282

    Args:
        learning_rate: The step size of Adam. If there are several, a net is tuned with
            each of them, and the one with the smallest loss on the held-out pairs is
            kept. With too few pairs for a hold-out, an embedding net is tuned with the
            smallest rate and an affine map with the largest, which suits them best.
        max_num_epochs: The largest number of epochs. Each is one gradient step over all
            training pairs.
        stop_after_epochs: Training stops after this many epochs without a smaller loss
            on the held-out pairs.
        simulations_per_target: The number of simulations in the mean that estimates
            each expectation. With 1, as in the paper, g is pulled towards the noise of
            single simulations.
        resample_targets: Whether to draw new simulations in every epoch, as the paper
            does, instead of once before the first. This takes ``max_num_epochs`` times
            as many simulations.
        num_neighbors: With stored simulations instead of a simulator, the expectation
            is estimated by the mean over this many simulations with the nearest
            parameters.
        validation_fraction: The share of the pairs that is held out, at most 0.5.
        rehearsal: :math:`\lambda`, not negative. The default is 0, as in the paper.

    Raises:
        InvalidInputError: If an argument is outside its range.
    """

    learning_rate: Positive | tuple[Positive, ...] = (1e-4, 1e-3)
    max_num_epochs: Count = 1000
    stop_after_epochs: Count = 200
    simulations_per_target: Count = 100
    resample_targets: bool = False
    num_neighbors: Count = 1
    validation_fraction: Annotated[float, Range(0, 0.5)] = 0.2
    rehearsal: NotNegative = 0.0

    @property
    def _learning_rates(self) -> tuple[float, ...]:
        rates = self.learning_rate
        return rates if isinstance(rates, tuple) else (rates,)

    def finetune(
        self,
        embedding_net: nn.Module,
        x: Tensor,
        draw_targets: Callable[[int], Tensor],
        *,
        draw_simulations: Callable[[int], Tensor] | None = None,
        groups: Tensor | None = None,
        weights: Tensor | None = None,
        seed: int | None = None,
        show_progress_bars: bool | None = None,
    ) -> FinetuneResult:
        """Tune a copy of the embedding net; the net itself does not change.

        Args:
            embedding_net: h, a module from ``(n, *event)`` to ``(n, l)``.
            x: Real observations of the calibration set, shape ``(n_c, *event)``.
            draw_targets: A function of a number k that returns the mean embedding of k
                simulations for each pair, shape ``(n_c, l)``.
            draw_simulations: A function of a number k that returns up to k simulations
                from the prior, shape ``(k, *event)``. It is only called for
                ``rehearsal``.
            groups: A number for each pair, shape ``(n_c,)``. Pairs with the same
                number, such as recordings of one person, are held out together. None
                if all pairs have different parameters.
            weights: How many pairs each pair counts as, shape ``(n_c,)``; one if None.
            seed: Seed of the split and of the simulations; None uses torch's state.
            show_progress_bars: Whether to show the losses during training. None does so
                in a terminal or a notebook, but not in a file.

        Returns:
            The tuned net and its history.

        Raises:
            InvalidInputError: If shapes do not fit or a value is not finite.
        """
        check("embedding_net", embedding_net, nn.Module)
        x = as_batch("x", x, finite=False).to(_dtype_of(embedding_net))
        if groups is None:
            groups = torch.arange(len(x))
        groups = as_batch("groups", groups, (), rows=len(x))
        if weights is not None:
            weights = as_batch("weights", weights, (), rows=len(x)).to(x)
        show = is_shown(show_progress_bars)
        with seeded(seed):
            embedded = _embedded("x", x, embedding_net)

            def new_targets() -> Tensor:
                targets = draw_targets(self.simulations_per_target)
                width = embedded.shape[1:]
                return as_batch("targets", targets, width, rows=len(x))

            targets = new_targets()
            keep = self._rehearsed(embedding_net, draw_simulations)
            train, held_out = split_pairs(groups, self.validation_fraction)
            max_num_epochs = epochs_on_pairs(groups, held_out, self.max_num_epochs)

            def tuned(learning_rate: float) -> tuple[nn.Module, History]:
                return self._optimise(
                    trainable_copy(embedding_net, targets),
                    x,
                    targets,
                    train.to(x.device),
                    held_out.to(x.device),
                    weights=weights,
                    learning_rate=learning_rate,
                    max_num_epochs=max_num_epochs,
                    keep=keep,
                    draw_targets=new_targets if self.resample_targets else None,
                    show_progress_bars=show,
                )

            # The careful rate for a net, the larger for an affine map.
            is_net = any(True for _ in embedding_net.parameters())
            net, history = best_of_learning_rates(
                tuned,
                self._learning_rates,
                num_held_out=len(held_out),
                otherwise=(min if is_net else max)(self._learning_rates),
            )
        return FinetuneResult(net, history)

    def _rehearsed(
        self, h: nn.Module, draw_simulations: Callable[[int], Tensor] | None
    ) -> tuple[Tensor, Tensor] | None:
        """Return simulations and their embeddings by h; None without rehearsal."""
        if not self.rehearsal:
            return None
        if draw_simulations is None:
            raise InvalidInputError(
                f"Expected `draw_simulations` with rehearsal={self.rehearsal}; got "
                "None."
            )
        simulations = draw_simulations(NUM_REHEARSED).to(_dtype_of(h))
        return simulations, _embedded("simulations", simulations, h)

    def _optimise(
        self,
        net: nn.Module,
        x: Tensor,
        targets: Tensor,
        train: Tensor,
        held_out: Tensor,
        *,
        weights: Tensor | None,
        learning_rate: float,
        max_num_epochs: int,
        keep: tuple[Tensor, Tensor] | None,
        draw_targets: Callable[[], Tensor] | None,
        show_progress_bars: bool,
    ) -> tuple[nn.Module, History]:
        has_holdout = held_out.numel() > 0
        newest = targets

        def all_pairs(epoch: int) -> list[tuple[Tensor]]:
            nonlocal newest
            if draw_targets is not None and 0 < epoch < max_num_epochs:
                newest = draw_targets()
            return [(train,)]

        def distance(rows: Tensor, targets: Tensor) -> Tensor:
            of_rows = None if weights is None else weights[rows]
            return _mean_distance(net(x[rows]), targets[rows], of_rows)

        def loss(rows: Tensor) -> Tensor:
            if keep is None:
                return distance(rows, newest)
            some = torch.randint(len(keep[0]), (REHEARSED_IN_EPOCH,)).to(x.device)
            kept = _mean_distance(net(keep[0][some]), keep[1][some])
            return distance(rows, newest) + self.rehearsal * kept

        history = fit(
            net,
            all_pairs,
            loss,
            validation_loss=(
                (lambda: distance(held_out, targets)) if has_holdout else None
            ),
            learning_rate=learning_rate,
            max_num_epochs=max_num_epochs,
            stop_after_epochs=self.stop_after_epochs,
            in_training_mode=False,
            label="Fine-tuning",
            show_progress_bars=show_progress_bars,
        )
        return net.requires_grad_(requires_grad=False), history


def trainable_copy(embedding_net: nn.Module, embeddings: Tensor) -> nn.Module:
    """Copy a net so that all of it can be trained, in evaluation mode.

    Args:
        embedding_net: The net to copy.
        embeddings: Any batch of its outputs, shape ``(n, l)``.
    """
    net = copy.deepcopy(embedding_net).requires_grad_()
    if not any(True for _ in net.parameters()):
        width = embeddings.shape[1]
        affine = nn.Linear(width, width).to(embeddings)
        with torch.no_grad():
            affine.weight.copy_(torch.eye(width))
            affine.bias.zero_()
        net = nn.Sequential(net, affine)
    return net.eval()


def _dtype_of(net: nn.Module) -> torch.dtype:
    """Return the dtype of the parameters and buffers of a net."""
    known = itertools.chain(net.parameters(), net.buffers())
    dtypes = (values.dtype for values in known if values.is_floating_point())
    return next(dtypes, torch.float32)


def _embedded(name: str, x: Tensor, net: nn.Module) -> Tensor:
    embedded = embed(net, x)
    if (bad := ~torch.isfinite(embedded)).any():
        raise InvalidInputError(
            f"Expected `{name}` with finite embeddings; got NaN or Inf in "
            f"{rows_with(bad)}."
        )
    return embedded


def _mean_distance(
    embeddings: Tensor, targets: Tensor, weights: Tensor | None = None
) -> Tensor:
    distances = torch.linalg.vector_norm(embeddings - targets, dim=1)
    if weights is None:
        return distances.mean()
    return (weights * distances).sum() / weights.sum()
