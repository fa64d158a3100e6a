"""The one loop keeps the best network of each member and stops each by itself."""

import math
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from sbi_rope.training.ensemble import Ensemble, embedded
from sbi_rope.training.fit import Courses, History, Training, fit
from sbi_rope.utils.errors import RoPEWarning

QUIET: Any = {"label": "Numbers", "show_progress_bars": False}


class Number(nn.Module):
    """A number to be trained, from 0 on."""

    def __init__(self) -> None:
        super().__init__()
        self.value = nn.Parameter(torch.zeros(()))


def no_data(step: int) -> Iterator[tuple[()]]:
    yield ()


def run(
    module: nn.Module,
    loss: Callable[..., Tensor],
    validation_loss: Callable[..., Tensor] | None,
    batches: Callable[[int], Any] = no_data,
    **options: Any,
) -> History:
    settings = {"learning_rate": 0.1, "max_num_epochs": 30, "stop_after_epochs": 100}
    training = Training(**{**settings, **options})
    [history] = fit(
        module, batches, loss, training, validation_loss=validation_loss, **QUIET
    )
    return history


def towards(module: Number, target: float) -> Callable[[], Tensor]:
    return lambda: (module.value - target).square()


def test_the_best_on_the_held_out_data_is_kept_and_not_the_last() -> None:
    module = Number()
    history = run(module, towards(module, 2.0), towards(module, 1.0))
    assert len(history.training_loss) + 1 == len(history.validation_loss) == 31
    assert 0 < history.best_epoch < 30
    assert history.kept_validation_loss == min(history.validation_loss)
    assert towards(module, 1.0)().item() == history.kept_validation_loss


@pytest.mark.parametrize("clip_max_norm", [None, 0.5])
def test_the_steps_are_those_of_adam_with_clipped_gradients(
    clip_max_norm: float | None,
) -> None:
    """Adam remembers a gradient of 100 for long unless it is clipped."""
    slopes = [100.0, 0.3, 0.2, 0.1]
    module, twin = Number(), Number()
    history = run(
        module,
        lambda slope: slope * module.value,
        None,
        batches=lambda step: [(slope,) for slope in slopes],
        clip_max_norm=clip_max_norm,
        max_num_epochs=1,
    )
    optimizer = torch.optim.Adam(twin.parameters(), lr=0.1)
    for slope in slopes:
        bound = math.inf if clip_max_norm is None else clip_max_norm
        twin.value.grad = torch.tensor(min(slope, bound))
        optimizer.step()
    assert module.value.item() == pytest.approx(twin.value.item(), rel=1e-5)
    # Without a hold-out the last is kept.
    assert history.best_epoch == 1
    assert history.validation_loss == []


def test_buffers_are_kept_with_the_best() -> None:
    module = nn.BatchNorm1d(1, affine=True)
    values = iter([3.0, 1.0, 2.0, 2.0])
    run(
        module,
        lambda x: module(x).mean(),
        lambda: torch.tensor(next(values)),
        batches=lambda step: [(torch.full((4, 1), 10.0 * (step + 1)),)],
        max_num_epochs=3,
    )
    # Kept after one step: a tenth of the way from 0 to 10.
    assert module.running_mean is not None
    assert float(module.running_mean) == pytest.approx(1.0)


TARGETS = torch.tensor([0.1, 1.0, 5.0])


def three() -> Ensemble:
    one = nn.Linear(1, 1, bias=False)
    nn.init.zeros_(one.weight)
    return Ensemble([one] * 3, embedded, (torch.ones(2, 1),))


def distances(ensemble: Ensemble, targets: Tensor = TARGETS) -> Tensor:
    values = ensemble.answer(embedded, torch.ones(len(targets), 1))[:, 0]
    return (values - targets).square()


def fitted(ensemble: Ensemble, loss: Callable[..., Tensor], **options: Any) -> Any:
    training = {"learning_rate": 0.1, "max_num_epochs": 40, "stop_after_epochs": 3}
    own = {name: options.pop(name) for name in training if name in options}
    return fit(
        ensemble,
        lambda step: [(TARGETS,)],
        loss,
        Training(**{**training, **own}),
        held_out=(TARGETS,),
        in_training_mode=False,
        **options,
        **QUIET,
    )


def test_each_member_has_its_own_rate_and_stops_by_itself() -> None:
    ensemble, sizes = three(), []

    def loss(targets: Tensor) -> Tensor:
        sizes.append(len(targets))
        return distances(ensemble, targets)

    rates = [0.1, 0.1, 0.01]
    histories = fitted(ensemble, loss, validation_loss=loss, learning_rates=rates)
    best = [history.best_epoch for history in histories]
    assert best[0] < best[1] < best[2] == 40
    # One that has stopped is out of the network, and back at its best in the end.
    assert sizes[0] == 3
    assert sizes[-1] == 1
    after = distances(ensemble)
    for number, history in enumerate(histories):
        assert len(history.training_loss) == min(40, best[number] + 3)
        kept = float(after[number])
        assert kept == pytest.approx(min(history.validation_loss), abs=1e-5)


def test_a_member_without_a_finite_loss_does_not_touch_the_others() -> None:
    ensemble, alone = three(), three()
    fitted(alone, lambda targets: distances(alone, targets))

    def loss(targets: Tensor) -> Tensor:
        factor = torch.ones_like(targets).masked_fill(targets == 1.0, torch.nan)
        return distances(ensemble, targets) * factor

    with pytest.warns(RoPEWarning, match="the loss of 1 of 3 networks"):
        fitted(ensemble, loss)
    found, expected = (
        net.answer(embedded, torch.ones(3, 1))[:, 0] for net in (ensemble, alone)
    )
    assert torch.equal(found[[0, 2]], expected[[0, 2]])
    assert found[1] == 0.0


def settled(rate: float, min_gain: float) -> tuple[Ensemble, list[History]]:
    ensemble = three()
    histories = fitted(
        ensemble,
        lambda targets: distances(ensemble, targets),
        validation_loss=lambda targets: distances(ensemble, targets),
        learning_rate=rate,
        max_num_epochs=5,
        courses=Courses(min_gain),
    )
    return ensemble, histories


def test_courses_go_on_while_they_gain_enough() -> None:
    ensemble, histories = settled(0.1, min_gain=math.inf)
    assert len(histories[2].training_loss) == 5
    assert float(distances(ensemble)[2].detach()) > 15
    ensemble, histories = settled(0.1, min_gain=0.5)
    assert len(histories[2].training_loss) > 25


def test_a_course_that_made_the_loss_worse_is_not_kept() -> None:
    """The first member starts at .01, which steps of 2 overshoot by far."""
    ensemble, histories = settled(2.0, min_gain=math.inf)
    assert float(distances(ensemble)[0].detach()) == pytest.approx(0.01)
    assert len(histories[0].training_loss) == 5
