"""Fine-tuned NPE with several hold-outs, and from a corrected start."""

import copy
import functools
from typing import Any

import pytest
import torch
from sbi.neural_nets import posterior_nn
from torch import Tensor, nn

from sbi_rope.baselines import PlainNPE
from sbi_rope.baselines.networks import shuffled
from sbi_rope.data.pairs import Pairs, epochs_on_pairs, split_pairs
from sbi_rope.methods import DiscrepancyNPE, FinetunedNPE, Training
from sbi_rope.tasks import get_task
from sbi_rope.training.fit import fit
from sbi_rope.utils.seeds import seeded

pytestmark = pytest.mark.filterwarnings("ignore:Maximum number of epochs")

TASK: Any = get_task("linear_gaussian")
SHORT = Training(learning_rate=3e-3, max_num_epochs=4, validation_fraction=0.2)
QUIET: dict[str, Any] = {"seed": 0, "show_progress_bars": False}
PAIRS = TASK.get_calibration_set(20)
TEST = TASK.get_test_set(30)


@functools.cache
def npe() -> Any:
    """The posterior of a short training, for reading only."""
    net = nn.Sequential(nn.Linear(2, 8), nn.ReLU(), nn.Linear(8, 4))
    method = PlainNPE(
        TASK.get_prior(),
        posterior_nn("maf", embedding_net=net, num_transforms=1, hidden_features=10),
        npe_training=Training(learning_rate=3e-3, max_num_epochs=5),
    )
    method.append_simulations(*TASK.get_simulations(500)).train(**QUIET)
    return method.build_posterior()


def finetuned(
    posterior: Any, pairs: tuple[Tensor, Tensor] = PAIRS, **options: Any
) -> FinetunedNPE:
    options = {"training": SHORT, "learning_rates": (3e-3,)} | options
    method = FinetunedNPE.from_posterior(posterior, **options)
    return method.append_calibration(*pairs).train(**QUIET)


def log_probs(posterior: Any, theta: Tensor = TEST[0], x: Tensor = TEST[1]) -> Tensor:
    return posterior.log_prob_batched(theta[None], x, norm_posterior=False)[0]


def networks(method: FinetunedNPE, pairs: tuple[Tensor, Tensor] = TEST) -> Tensor:
    """The log density of each network at pairs, ``(n, K)``."""
    flow = method.build_posterior().posterior_estimator
    return flow.log_probs(pairs[0][None], flow.embed(pairs[1]))[:, 0].T


def test_with_one_holdout_it_is_one_network_tuned_on_the_rest() -> None:
    method = finetuned(npe())
    estimator = copy.deepcopy(npe().posterior_estimator).requires_grad_()
    theta, x = PAIRS

    def loss(rows: Tensor) -> Tensor:
        return estimator.loss(theta[rows], condition=x[rows]).mean()

    with seeded(0):
        train, held_out = split_pairs(theta, 0.2)
        [history] = fit(
            estimator,
            lambda _: zip(shuffled(train, SHORT.training_batch_size), strict=True),
            loss,
            SHORT,
            validation_loss=lambda: loss(held_out),
            max_num_epochs=epochs_on_pairs(theta, held_out, SHORT.max_num_epochs),
            in_training_mode=False,
            label="",
            show_progress_bars=False,
        )
    expected = estimator.log_prob(TEST[0][None], TEST[1])[0]
    assert torch.allclose(log_probs(method.build_posterior()), expected, atol=1e-4)
    assert method.histories == (method.history,)
    assert method.history.validation_loss == pytest.approx(history.validation_loss)


def test_of_several_learning_rates_and_the_start_the_best_is_kept() -> None:
    kept = {}
    for rates in [(1e-6,), (1e-2,), (1e-6, 1e-2), (1e-2, 1e-6)]:
        history = finetuned(npe(), learning_rates=rates).history
        kept[rates] = history.kept_validation_loss
        if 1e-2 in rates:
            assert history.learning_rate == 1e-2
    assert kept[1e-2,] < kept[1e-6,]


@pytest.mark.medium
@pytest.mark.parametrize("space", [None, "embedding", "input"])
def test_a_start_is_kept_if_nothing_is_better_corrected_or_not(space: Any) -> None:
    start = npe()
    if space:
        options = {"space": space, "num_simulations": 500, "num_steps": 40}
        corrected = DiscrepancyNPE.from_posterior(start, **options)
        corrected.append_simulations(*TASK.get_simulations(500))
        corrected.append_calibration(*PAIRS).train(**QUIET)
        start = corrected.build_posterior()
    method = finetuned(start, learning_rates=(100.0,))
    assert method.history.best_epoch == 0
    assert torch.equal(log_probs(method.build_posterior()), log_probs(start))


def test_every_pair_is_held_out_by_one_network() -> None:
    method = finetuned(npe(), num_holdouts=5)
    with seeded(0):
        folds = Pairs.exact(*PAIRS).folds(5)
    held_out, at_start = networks(method, PAIRS), log_probs(npe(), *PAIRS)
    for k, (rows, history) in enumerate(zip(folds, method.histories, strict=True)):
        kept = -float(held_out[rows, k].mean())
        assert history.kept_validation_loss == pytest.approx(kept, rel=1e-4)
        others = torch.cat([fold for fold in folds if fold is not rows])
        first = -float(at_start[others].mean())
        assert history.training_loss[0] == pytest.approx(first, rel=1e-4)


def test_people_are_held_out_as_a_whole() -> None:
    """Six of them, four recordings each, by as many networks as there are people."""
    pairs = PAIRS[0][:6].repeat(4, 1), TASK.get_simulator()(PAIRS[0][:6].repeat(4, 1))
    method = finetuned(npe(), pairs, num_holdouts=10)
    assert len(method.histories) == 6
    losses = -networks(method, pairs).reshape(4, 6, 6).mean(dim=0)
    kept = losses.new_tensor([h.kept_validation_loss for h in method.histories])
    difference = (losses - kept).abs()
    assert difference.amin(dim=0).max() < 1e-4
    assert sorted(difference.argmin(dim=0).tolist()) == list(range(6))
