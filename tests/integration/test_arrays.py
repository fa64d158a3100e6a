"""Arrays, lists and tables of numbers are taken wherever users pass data."""

from typing import Any

import pandas as pd
import pytest
import torch
from torch import Tensor

from sbi_rope import RoPE
from sbi_rope.methods import FinetunedNPE
from sbi_rope.metrics import evaluate
from tests import gaussian, problems
from tests.stacks import NPE, PRIOR, QUICK, QUIET, problem, stacked

PAIRS, OBSERVED = problem(12, seed=1), problem(25, seed=2)
QUICKLY: dict[str, Any] = {"num_simulations": 60, "seed": 0, **QUIET}


@pytest.mark.medium
@pytest.mark.parametrize("convert", [Tensor.tolist, lambda x: x.double().numpy()])
def test_pairs_and_observations_are_those_of_tensors(convert: Any) -> None:
    theta_o, x_o = map(convert, OBSERVED)
    npe = problems.npe_posterior("mdn")
    given = RoPE(npe, simulator=problems.simulate, finetuner=QUICK)
    given.append_calibration(*map(convert, PAIRS))
    for ours, tensor in zip((given.pairs.mean, given.pairs.x), PAIRS, strict=True):
        assert ours.dtype == torch.float32
        assert torch.equal(ours, tensor)
    given.train(seed=0, **QUIET)
    posterior = given.build_posterior(x_o, **QUICKLY)
    assert torch.equal(posterior.x_o, OBSERVED[1])
    # The posterior knows an observation again, in whatever form it comes.
    log_prob = posterior.log_prob_batched(theta_o, x=x_o)
    assert torch.allclose(log_prob.float(), posterior.log_prob_batched(*OBSERVED))
    assert posterior.sample((3,), x=x_o[1]).shape == (3, 2)
    scores = evaluate(npe, theta_o, x_o, num_samples=20, seed=0, **QUIET)
    expected = evaluate(npe, *OBSERVED, num_samples=20, seed=0, **QUIET)
    torch.testing.assert_close(scores.log_prob, expected.log_prob)
    torch.testing.assert_close(scores.ranks, expected.ranks)


@pytest.mark.medium
def test_a_table_is_put_in_the_order_of_the_first_one() -> None:
    def table(numbers: Tensor, names: str) -> Any:
        return pd.DataFrame(numbers.numpy(), columns=list(names))

    theta, x = gaussian.labelled(12)
    first, x_first = table(theta, "ab"), table(x, "cd")
    second, x_second = first[["b", "a"]], x_first[["d", "c"]]
    rope = RoPE(gaussian.posterior(), simulator=gaussian.simulator, finetuner=QUICK)
    noise = first.assign(a=0.1, b=0.2)[["b", "a"]]
    rope.append_calibration(first, x_first, theta_std=noise)
    rope.append_calibration(second, x_second, theta_std=noise.iloc[0])
    assert torch.equal(rope.pairs.y, torch.cat([theta, theta]))
    assert torch.equal(rope.pairs.x, torch.cat([x, x]))
    assert torch.allclose(rope.pairs.std.float(), torch.tensor([0.1, 0.2]))
    method = FinetunedNPE.from_posterior(gaussian.posterior())
    method.append_calibration(first, x_first).append_calibration(second, x_second)
    assert torch.equal(method._data.pairs.x, rope.pairs.x)
    posterior = stacked(rope, candidates=[PRIOR, NPE], num_folds=2)
    expected = posterior.log_prob_batched(theta, x)
    assert torch.equal(posterior.log_prob_batched(second, x_second), expected)
    found = posterior.log_prob(second, x_second.iloc[0])  # a row is a series
    assert torch.equal(found, posterior.log_prob(theta, x[0]))
    found_set = posterior.credible_set(0.5, x_second.iloc[0], seed=0)
    assert torch.equal(found_set.contains(second), found_set.contains(theta))
