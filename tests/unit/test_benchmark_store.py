"""What a run of the benchmark keeps: rows, arrays, and what cells share."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from sbi.inference.posteriors import DirectPosterior

from benchmarks.cases import cached, posterior_with, state_of
from benchmarks.cells import Cell
from benchmarks.presets import PRESETS
from benchmarks.store import Result, Results
from sbi_rope.npe.sbi import embedding_of
from sbi_rope.tasks import get_task
from sbi_rope.utils.files import write_atomically
from tests.results import result_of

CELLS = [
    Cell(task="cs", method="prior"),
    Cell(
        task="cs",
        method="RoPE",
        n_calibration=10,
        gamma=0.1,
        tau=1.0,
        cost_scale="simulated",
    ),
    Cell(task="cs", method="MLP", n_calibration=50, options='{"label_noise": 0.1}'),
]
COMMITTED = Path(__file__).parents[2] / "benchmarks" / "results"


def test_an_interrupted_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    path.write_text("old")

    def interrupted() -> None:
        with write_atomically(path) as temporary:
            temporary.write_text("ne")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_results_survive_being_written_and_read(tmp_path: Path) -> None:
    results = Results(tmp_path / "tiny")
    assert len(results.rows) == 0
    made = [
        result_of(cell, score)
        for cell, score in zip(CELLS, (-math.inf, 1 / 3, "failed"), strict=True)
    ]
    results.add(made[1:])
    results.add(made[:1])
    rows = results.rows
    assert [*rows.index] == [CELLS[1], CELLS[2], CELLS[0]]
    assert rows["lpp_z"][CELLS[0]] == -math.inf
    assert rows["lpp_z"][CELLS[1]] == 1 / 3
    assert rows["error"].to_dict() == {
        CELLS[0]: "",
        CELLS[1]: "",
        CELLS[2]: "ValueError: no",
    }
    before = results.path.read_text().splitlines()
    results.tidy(CELLS)
    after = results.path.read_text().splitlines()
    assert [*results.rows.index] == CELLS
    # To the letter, in another order.
    assert sorted(before) == sorted(after)
    assert sorted(path.name for path in results.folder.iterdir()) == [
        "arrays.npz",
        "results.csv",
    ]
    for cell, (_, arrays) in zip(CELLS, made, strict=True):
        read = results.arrays()[cell]
        assert read.keys() == arrays.keys()
        assert all(np.array_equal(read[name], arrays[name]) for name in arrays)


def test_a_later_result_of_a_cell_takes_the_place_of_the_earlier_one(
    tmp_path: Path,
) -> None:
    results = Results(tmp_path / "tiny")
    results.add([result_of(CELLS[0], "failed"), result_of(CELLS[1], -2.0)])
    results.tidy(CELLS)
    row, arrays = result_of(CELLS[1], -1.0)
    new = {name: values + 1.0 for name, values in arrays.items()}
    results.add([result_of(CELLS[0], -1.0), Result(row, new)])
    assert results.rows["lpp_z"].to_dict() == dict.fromkeys(CELLS[:2], -1.0)
    assert len(results.arrays()[CELLS[0]]) > 1
    assert np.array_equal(results.arrays()[CELLS[1]]["theta"], new["theta"])
    results.add([result_of(CELLS[1], "failed")])
    results.tidy(CELLS)
    assert results.arrays()[CELLS[1]] == {}


def test_results_of_another_suite_are_taken_over(tmp_path: Path) -> None:
    first, second = Results(tmp_path / "first"), Results(tmp_path / "second")
    first.add(result_of(cell, -1.0) for cell in CELLS)
    first.tidy(CELLS)
    second.add([result_of(CELLS[1], -2.0)])
    second.take_over(CELLS[:2])
    assert second.rows["lpp_z"].to_dict() == {CELLS[1]: -2.0, CELLS[0]: -1.0}
    assert {*second.rows["suite"]} == {"second"}
    assert second.arrays()[CELLS[0]].keys() == first.arrays()[CELLS[0]].keys()


def test_every_finished_committed_cell_has_its_arrays() -> None:
    results = Results(COMMITTED / "failures")
    arrays = results.arrays()
    rows = results.rows
    assert len(rows) > 100
    for cell, status in rows["status"].items():
        log_probs = arrays[cell].get("log_probs")
        assert (log_probs is not None) == (status == "finished")
        if log_probs is not None:
            average = log_probs.astype(float).mean()
            assert rows["lpp"][cell] == pytest.approx(average, rel=1e-5)


# What cells share ---------------------------------------------------------------------


class Thief:
    """Runs code when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.write_text, (self.path, "code was run")


def test_what_is_shared_is_computed_once_and_runs_no_code(tmp_path: Path) -> None:
    calls: list[int] = []

    def compute() -> dict[str, torch.Tensor]:
        calls.append(1)
        return {"x": torch.ones(2)}

    for _ in range(2):
        found = cached(tmp_path, "thing", {"seed": 0}, compute)
        assert torch.equal(found["x"], torch.ones(2))
    assert len(calls) == 1
    cached(tmp_path, "thing", {"seed": 1}, compute)
    assert len(calls) == 2
    for path in tmp_path.glob("thing-*"):
        torch.save(Thief(tmp_path / "proof"), path)
    with pytest.raises(Exception, match="Weights only load failed"):
        cached(tmp_path, "thing", {"seed": 0}, compute)
    assert not (tmp_path / "proof").exists()


@pytest.mark.parametrize(
    ("task", "preset"),
    [("linear_gaussian", "smoke"), ("pendulum", "standard"), ("pendulum", "paper")],
)
def test_a_rebuilt_estimator_is_the_trained_one(task: str, preset: str) -> None:
    chosen = get_task(task)
    prior, builder = chosen.get_prior(), PRESETS[preset](chosen).builder(chosen)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        theta = prior.sample((20,))
        x = chosen.get_simulator()(theta)
        trained = builder(theta, 3.0 * x + 1.0)
        for weights in trained.parameters():
            weights.data += 0.01 * torch.randn_like(weights)
    posterior = DirectPosterior(trained.eval(), prior)
    state = state_of(posterior)
    before = {name: values.clone() for name, values in state.items()}
    rebuilt = posterior_with(state, prior=prior, build=builder, simulations=(theta, x))
    options = {"norm_posterior": False}
    ours, theirs = (
        one.log_prob_batched(theta[None], x=x, **options)
        for one in (rebuilt, posterior)
    )
    assert torch.equal(ours, theirs)
    # What is done to it later changes neither the state nor what is built next.
    for weights in rebuilt.posterior_estimator.parameters():
        weights.data.zero_()
    assert all(torch.equal(state[name], values) for name, values in before.items())
    assert any(
        weights.any() for weights in embedding_of(builder(theta, x)).parameters()
    )


def test_cells_that_differ_have_different_names() -> None:
    cells = [*CELLS, replace(CELLS[0], repetition=1), replace(CELLS[1], gamma=0.2)]
    assert len({cell.key for cell in cells}) == len(cells)
