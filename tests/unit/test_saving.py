"""A saved posterior is loaded by another process, as it was, without running code."""

import functools
import importlib
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
import torch
from sbi.inference import VIPosterior
from torch import Tensor, nn

from sbi_rope import load, save
from sbi_rope.density import PriorPosterior
from sbi_rope.stacking.candidates import DiscrepancyCandidate, FinetunedCandidate
from sbi_rope.tasks.distributions import UniformTriangle
from sbi_rope.tasks.hemodynamics.prior import PopulationPrior
from sbi_rope.utils.errors import DataNotFoundError, FileFormatError
from tests import problems, stacks

pytestmark = pytest.mark.filterwarnings("ignore:.*lie outside the prior support")

QUIET = {"show_progress_bars": False}
ROOT = Path(__file__).resolve().parents[2]


def numbers(posterior: Any, x: Tensor) -> list[Tensor]:
    """Samples with a seed, and log densities."""
    # The mass inside the prior takes draws, which some families search for.
    torch.manual_seed(0)
    samples = posterior.sample_batched((3,), x, reject_outside_prior=False, **QUIET)
    if not hasattr(posterior, "log_prob_batched"):
        return [samples]
    options = {"norm_posterior": False}
    return [samples, posterior.log_prob_batched(samples, x, **options).detach()]


def saved_and_loaded(posterior: Any, folder: Path, **options: Any) -> Any:
    save(posterior, folder / "posterior.pt", overwrite=True)
    return load(folder / "posterior.pt", **options)


def assert_same_again(posterior: Any, x: Tensor, folder: Path) -> None:
    loaded = saved_and_loaded(posterior, folder)
    assert type(loaded) is type(posterior)
    assert all(map(torch.equal, numbers(loaded, x), numbers(posterior, x)))


FRESH = """
import pathlib, sys, torch, sbi_rope
for file in sorted(pathlib.Path(sys.argv[1]).glob("*.pt")):
    posterior = sbi_rope.load(file)
    x, samples, log_prob = torch.load(file.with_suffix(".expected"), weights_only=True)
    torch.manual_seed(0)
    found = posterior.sample_batched((3,), x, reject_outside_prior=False)
    assert torch.equal(found, samples), file
    found = posterior.log_prob_batched(samples, x, norm_posterior=False)
    assert torch.equal(found.detach(), log_prob), file
    print(type(posterior).__name__, getattr(posterior, "report", "-"))
assert not [name for name in sys.modules if name.split(".")[0] == "tests"]
"""


@pytest.mark.medium
def test_another_process_loads_the_same_posteriors(tmp_path: Path) -> None:
    x_o, rope = stacks.observed(), stacks.rope_of().train(seed=0, **QUIET)
    batch = rope.build_posterior(x_o, seed=0, **QUIET)
    candidates = [stacks.PRIOR, stacks.NPE, stacks.BOX]
    candidates += [DiscrepancyCandidate(space="tuned"), FinetunedCandidate()]
    stack = stacks.stacked(rope, candidates=candidates, num_folds=3)
    cases = [(batch, x_o[:5]), (batch[3], x_o[3:4]), (stack, x_o[:4])]
    for number, (posterior, x) in enumerate(cases):
        save(posterior, tmp_path / f"{number}.pt")
        torch.save((x, *numbers(posterior, x)), tmp_path / f"{number}.expected")
    result = subprocess.run(
        [sys.executable, "-c", FRESH, str(tmp_path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert result.returncode == 0, result.stderr
    assert str(stack.report) in result.stdout


@pytest.mark.medium
@pytest.mark.parametrize("family", [*problems.FAMILIES, "mnpe"])
def test_every_family_can_be_saved(family: str, tmp_path: Path) -> None:
    npe = problems.npe_posterior(family)
    x = problems.simulate(npe.prior.sample((3,)))
    assert_same_again(npe, x, tmp_path)


@pytest.mark.parametrize(
    "method", ["fmpe", pytest.param("npse", marks=pytest.mark.slow)]
)
def test_posteriors_of_vector_fields_can_be_saved(method: str, tmp_path: Path) -> None:
    posterior = problems.vector_field_posterior(method)
    assert_same_again(posterior, problems.simulate(torch.zeros(1, 2)), tmp_path)


def test_priors_can_be_saved(tmp_path: Path) -> None:
    for prior in (UniformTriangle(torch.tensor(0.5)), PopulationPrior()):
        assert_same_again(PriorPosterior(prior), torch.zeros(2, 3), tmp_path)


class Calls:
    """What a malicious file holds: the loader of pickle calls a function."""

    def __init__(self, function: Any, *args: Any) -> None:
        self.call = (function, args)

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        return self.call


@pytest.mark.parametrize("write", [pickle.dump, torch.save])
def test_a_malicious_pickle_is_refused_and_not_executed(
    write: Callable[..., Any], tmp_path: Path
) -> None:
    path, target = tmp_path / "posterior.pt", tmp_path / "executed"
    with path.open("wb") as file:
        write(Calls(os.system, f"touch {target}"), file)
    with pytest.raises(FileFormatError):
        load(path)
    assert not target.exists()


@pytest.mark.parametrize(
    "value",
    [
        Calls(eval, "print()"),
        Calls(functools.partial, eval, "print()"),
        Calls(getattr, nn.Linear(1, 1), "forward"),
        Calls(torch.load, "file"),
        # What is only named may be called by what is known.
        os.system,
        importlib.import_module,
        VIPosterior,
        save,
    ],
    ids=lambda value: getattr(value, "__name__", "a call"),
)
def test_calls_in_a_file_are_refused(value: Any, tmp_path: Path) -> None:
    posterior: Any = PriorPosterior(problems.box(2))
    posterior.value = value
    with pytest.raises(FileFormatError):
        saved_and_loaded(posterior, tmp_path)


def test_classes_of_the_user_have_to_be_trusted(tmp_path: Path) -> None:
    posterior: Any = PriorPosterior(problems.box(2))
    posterior.net, posterior.function = problems.SmallCNN(), problems.simulate
    with pytest.raises(FileFormatError, match=r"trusted=\[SmallCNN, simulate\]"):
        saved_and_loaded(posterior, tmp_path)
    trusted = [problems.SmallCNN, problems.simulate]
    loaded = saved_and_loaded(posterior, tmp_path, trusted=trusted)
    assert type(loaded.net) is problems.SmallCNN
    assert loaded.function is problems.simulate


def test_a_file_is_replaced_only_when_asked_to(tmp_path: Path) -> None:
    path = tmp_path / "new" / "x.pt"
    posterior: Any = PriorPosterior(problems.box(2))
    save(posterior, path)
    before = path.read_bytes()
    with pytest.raises(FileExistsError, match="overwrite=True"):
        save(PriorPosterior(problems.box(1)), path)
    posterior.function = lambda x: x
    with pytest.raises((pickle.PicklingError, AttributeError)):
        save(posterior, path, overwrite=True)
    assert path.read_bytes() == before
    save(PriorPosterior(problems.box(1)), path, overwrite=True)
    assert load(path).sample((2,)).shape == (2, 1)
    assert [file.name for file in path.parent.iterdir()] == ["x.pt"]
    with pytest.raises(DataNotFoundError):
        load(tmp_path / "nothing.pt")


def test_damaged_and_foreign_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.pt"
    save(PriorPosterior(problems.box(2)), path)
    whole = path.read_bytes()
    for damaged in (b"", whole[:-20], whole[20:]):
        path.write_bytes(damaged)
        with pytest.raises(FileFormatError):
            load(path)
    for foreign in ({"a": torch.zeros(2)}, nn.Linear(2, 2), {"posterior": 3}):
        torch.save(foreign, path)
        with pytest.raises(FileFormatError):
            load(path)
    with patch("sbi.__version__", "0.1.2"):
        save(PriorPosterior(problems.box(2)), path, overwrite=True)
    with pytest.raises(FileFormatError, match=r"0\.1"):
        load(path)
