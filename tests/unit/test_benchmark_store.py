"""What a run of the benchmark keeps: files, results of cells, caches."""

import hashlib
import io
import multiprocessing
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from sbi.inference.posteriors import DirectPosterior

from benchmarks.cases import Case, Sources, posterior_with, state_of
from benchmarks.cells import Cell
from benchmarks.presets import PRESETS
from benchmarks.store import Cache, Results
from sbi_rope._files import set_aside, write_atomically
from sbi_rope._sbi import embedding_of
from sbi_rope.errors import RoPEWarning
from sbi_rope.tasks import get_task
from tests.results import empty, fill_with_garbage, remove, result_of, truncate

FINISHED = Cell(task="linear_gaussian", method="prior")

# Files ------------------------------------------------------------------------------


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


def test_files_can_be_read_by_whoever_can_read_others(tmp_path: Path) -> None:
    plain, path = tmp_path / "plain.txt", tmp_path / "file.txt"
    plain.write_text("text")
    with write_atomically(path) as temporary:
        temporary.write_text("text")
    assert path.stat().st_mode == plain.stat().st_mode


def test_the_cache_computes_once_and_again_if_the_entry_is_damaged(
    tmp_path: Path,
) -> None:
    cache, calls = Cache(tmp_path), []

    def compute() -> list[int]:
        calls.append(1)
        return [1, 2]

    for _ in range(2):
        assert cache.get("thing", {"seed": 0}, compute) == [1, 2]
    assert len(calls) == 1
    cache.get("thing", {"seed": 1}, compute)
    assert len(calls) == 2
    for path in tmp_path.glob("thing-*"):
        data = bytearray(path.read_bytes())
        data[-10] ^= 1
        path.write_bytes(bytes(data))
    with pytest.warns(UserWarning, match="damaged"):
        assert cache.get("thing", {"seed": 0}, compute) == [1, 2]
    assert len(calls) == 3
    assert cache.get("thing", {"seed": 0}, compute) == [1, 2]
    assert len(calls) == 3


def write_many(folder: Path, number: int) -> None:
    results = Results(folder)
    for _ in range(30):
        for repetition in range(3):
            cell = Cell(task="a", method="prior", repetition=repetition)
            row = {"status": "failed", "error": "no", "value": [number] * 1000}
            results.write(cell, row, {"x": np.full(9, number)})


def test_two_processes_on_one_folder_leave_whole_files(tmp_path: Path) -> None:
    context = multiprocessing.get_context("fork")
    processes = [
        context.Process(target=write_many, args=(tmp_path, number)) for number in (1, 2)
    ]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
        assert process.exitcode == 0
    results = Results(tmp_path)
    for repetition in range(3):
        cell = Cell(task="a", method="prior", repetition=repetition)
        row = results.read(cell)
        assert row is not None
        assert len(set(row["value"])) == 1
        assert len(set(results.read_arrays(cell)["x"])) == 1
    assert len(list(tmp_path.iterdir())) == 6


def replace_by_another(path: Path) -> None:
    """Put the file of another cell in its place."""
    other = replace(FINISHED, repetition=1)
    results = Results(path.parent)
    # Nothing but its cell tells the row from the one it replaces.
    log_probs = [-1.0, -2.0] if path.suffix == ".json" else [-1.0, -1.0]
    results.write(other, *result_of(other, log_probs))
    path.write_bytes((path.parent / f"{other.key}{path.suffix}").read_bytes())


def test_a_damaged_result_counts_as_not_run_and_is_set_aside(tmp_path: Path) -> None:
    damages = (truncate, empty, fill_with_garbage, replace_by_another)
    cases = [(end, damage) for end in ("json", "npz") for damage in damages]
    for number, (end, damage) in enumerate([*cases, ("npz", remove)]):
        results = Results(tmp_path / str(number))
        results.write(FINISHED, *result_of(FINISHED, [-1.0, -2.0]))
        assert results.read(FINISHED) is not None
        path = results.folder / f"{FINISHED.key}.{end}"
        damage(path)
        content = path.read_bytes() if path.exists() else None
        with pytest.warns(RoPEWarning, match="damaged and counts as not run"):
            assert results.read(FINISHED) is None
        with pytest.warns(RoPEWarning, match="damaged and is computed again"):
            results.set_damaged_aside([FINISHED])
        assert not path.exists()
        if content is not None:
            assert path.with_name(f"{path.name}.damaged-1").read_bytes() == content
        # Now it is as if it had never been run.
        with warnings.catch_warnings(action="error"):
            assert results.read(FINISHED) is None
            results.set_damaged_aside([FINISHED])


def test_what_is_set_aside_replaces_nothing(tmp_path: Path) -> None:
    for number in (1, 2):
        path = tmp_path / "cell.json"
        path.write_text(str(number))
        assert set_aside(path) == tmp_path / f"cell.json.damaged-{number}"
    assert (tmp_path / "cell.json.damaged-1").read_text() == "1"
    assert set_aside(path) is None


def test_a_result_with_a_score_that_is_not_its_own_is_damaged(tmp_path: Path) -> None:
    results = Results(tmp_path)
    row, arrays = result_of(FINISHED, [-1.0, -2.0])
    results.write(FINISHED, row | {"lpp_z": row["lpp_z"] + 0.01}, arrays)
    with pytest.warns(RoPEWarning, match="column lpp_z: expected -1.5"):
        assert results.read(FINISHED) is None


# Trained estimators -------------------------------------------------------------------


class Thief:
    """Runs code when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.write_text, (self.path, "code was run")


def put_pickle(path: Path, content: Any) -> None:
    """Write an entry as older versions did: any object, with a right checksum."""
    buffer = io.BytesIO()
    torch.save(content, buffer)
    payload = buffer.getvalue()
    path.write_bytes(hashlib.sha256(payload).digest() + payload)


def test_the_cache_runs_no_code_of_what_it_reads(tmp_path: Path) -> None:
    cache = Cache(tmp_path)
    cache.get("thing", {}, lambda: [1])
    (path,) = tmp_path.glob("thing-*")
    put_pickle(path, Thief(tmp_path / "proof"))
    with pytest.warns(RoPEWarning, match="not opened, because that could run code"):
        assert cache.get("thing", {}, lambda: [2]) == [2]
    assert not (tmp_path / "proof").exists()
    assert path.with_name(f"{path.name}.damaged-1").exists()
    assert cache.get("thing", {}, lambda: [3]) == [2]


def test_a_cached_estimator_of_other_weights_is_computed_anew(tmp_path: Path) -> None:
    cell = Cell(task="linear_gaussian", preset="smoke", method="NPE")

    def npe() -> Any:
        return Case.of(cell, Sources(), Cache(tmp_path), "cpu").npe

    first = npe()
    (path,) = tmp_path.glob("npe-*")
    put_pickle(path, {"state": {"weight": torch.ones(1)}, "seconds": 1.0})
    with pytest.warns(RoPEWarning, match="damaged and is computed anew"):
        again = npe()
    x = torch.zeros(1, *first.posterior_estimator.condition_shape)
    theta = torch.zeros(1, *first.posterior_estimator.input_shape)
    assert torch.equal(first.log_prob(theta, x=x), again.log_prob(theta, x=x))


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
