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

import pytest
import torch
from sbi.inference import VIPosterior
from torch import Tensor, nn

from sbi_rope import MixturePosterior, StackedPosterior, load, save
from sbi_rope.density import Flow, PriorPosterior
from sbi_rope.stacking.candidates import DiscrepancyCandidate, FinetunedCandidate
from sbi_rope.tasks.distributions import UniformTriangle
from sbi_rope.tasks.hemodynamics.prior import PopulationPrior
from sbi_rope.utils.errors import DataNotFoundError, FileFormatError
from tests import problems, stacks
from tests.baselines import data_of, trained

pytestmark = pytest.mark.filterwarnings("ignore:.*lie outside the prior support")

QUIET = {"show_progress_bars": False}
ROOT = Path(__file__).resolve().parents[2]


def mixture_of(posterior: Any) -> MixturePosterior:
    """Return a mixture of one part, for any x."""
    estimator = Flow.of([posterior.posterior_estimator])
    return MixturePosterior(estimator, posterior.prior)


def rope_posterior(**options: Any) -> MixturePosterior:
    rope = stacks.rope_of().train(seed=0, **QUIET)
    return rope.build_posterior(stacks.observed(), seed=0, **options, **QUIET)


@functools.cache
def small_stack() -> StackedPosterior:
    """Return a stack of few candidates, for reading only."""
    trained_ones = (DiscrepancyCandidate(space="tuned"), FinetunedCandidate())
    candidates = [stacks.PRIOR, stacks.NPE, *trained_ones, stacks.BOX]
    with torch.random.fork_rng():
        return stacks.stacked(stacks.rope_of(), candidates=candidates, num_folds=3)


def numbers(posterior: Any, x: Tensor, *, truncated: bool = True) -> list[Tensor]:
    """Samples with a seed, and log densities."""
    options: tuple[Any, Any] = ({}, {})
    if not truncated:
        options = {"reject_outside_prior": False}, {"norm_posterior": False}
    with torch.random.fork_rng():
        torch.manual_seed(0)
        samples = posterior.sample_batched((3,), x, **QUIET, **options[0])
    if not hasattr(posterior, "log_prob_batched"):
        return [samples]
    return [samples, posterior.log_prob_batched(samples, x, **options[1]).detach()]


def saved_and_loaded(posterior: Any, folder: Path, **options: Any) -> Any:
    save(posterior, folder / "posterior.pt", overwrite=True)
    return load(folder / "posterior.pt", **options)


def assert_same(posterior: Any, loaded: Any, x: Tensor, **options: Any) -> None:
    assert type(loaded) is type(posterior)
    found, expected = (numbers(one, x, **options) for one in (loaded, posterior))
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


# --- what is loaded is what was saved ---


FRESH = """
import pathlib, sys, torch, sbi_rope
for file in sorted(pathlib.Path(sys.argv[1]).glob("*.pt")):
    posterior = sbi_rope.load(file)
    x, samples, log_prob = torch.load(file.with_suffix(".expected"), weights_only=True)
    torch.manual_seed(0)
    found = posterior.sample_batched((3,), x, show_progress_bars=False)
    assert torch.equal(found, samples), file
    assert torch.equal(posterior.log_prob_batched(found, x).detach(), log_prob), file
    print(type(posterior).__name__, getattr(posterior, "report", "-"))
assert not [name for name in sys.modules if name.split(".")[0] == "tests"]
"""


@pytest.mark.medium
def test_another_process_loads_the_same_posteriors(tmp_path: Path) -> None:
    batch, stack = rope_posterior(), small_stack()
    tuned = trained("finetuned_npe_averaged", "linear_gaussian").build_posterior()
    x_o = stacks.observed()
    cases = [
        (batch, x_o[:5]),
        (batch[3], x_o[3:4]),
        (stack, x_o[:4]),
        (tuned, data_of("linear_gaussian").x_o[:3]),
        (PriorPosterior(problems.box(2)), x_o[:2]),
    ]
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
    for posterior in (npe, mixture_of(npe)):
        # The mass inside the prior takes draws, which some families search for.
        loaded = saved_and_loaded(posterior, tmp_path)
        assert_same(posterior, loaded, x, truncated=False)


@pytest.mark.parametrize(
    "method", ["fmpe", pytest.param("npse", marks=pytest.mark.slow)]
)
def test_posteriors_of_vector_fields_can_be_saved(method: str, tmp_path: Path) -> None:
    posterior = problems.vector_field_posterior(method)
    loaded = saved_and_loaded(posterior, tmp_path)
    assert_same(posterior, loaded, problems.simulate(torch.zeros(1, 2)))


@pytest.mark.parametrize(
    "prior", [UniformTriangle(torch.tensor(0.5)), PopulationPrior()]
)
def test_priors_can_be_saved(prior: Any, tmp_path: Path) -> None:
    posterior = PriorPosterior(prior)
    loaded = saved_and_loaded(posterior, tmp_path)
    assert_same(posterior, loaded, torch.zeros(2, 3))


# --- what is refused ---


class Calls:
    """What a malicious file holds: the loader of pickle calls a function."""

    def __init__(self, function: Any, *args: Any) -> None:
        self.call = (function, args)

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        return self.call


def touch(path: Path) -> Calls:
    return Calls(os.system, f"touch {path}")


@pytest.mark.parametrize("write", [pickle.dump, torch.save])
def test_a_malicious_pickle_is_refused_and_not_executed(
    write: Callable[..., Any], tmp_path: Path
) -> None:
    path, target = tmp_path / "posterior.pt", tmp_path / "executed"
    with path.open("wb") as file:
        write(touch(target), file)
    with pytest.raises(FileFormatError):
        load(path)
    assert not target.exists()


@pytest.mark.parametrize(
    "value",
    [
        Calls(eval, "print()"),
        Calls(functools.partial, eval, "print()"),
        Calls(getattr, nn.Linear(1, 1), "forward"),
        Calls(importlib.import_module, "antigravity"),
        Calls(torch.load, "file"),
        # What is only named may be called by what is known.
        os.system,
        importlib.import_module,
        torch.distributions.kl_divergence,
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


class OwnNet(nn.Module):
    """An embedding net that a user has written."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.full((1,), 2.0))

    def forward(self, x: Tensor) -> Tensor:
        return self.scale * x


def test_classes_of_the_user_have_to_be_trusted(tmp_path: Path) -> None:
    posterior: Any = PriorPosterior(problems.box(2))
    posterior.net, posterior.function = OwnNet(), problems.simulate
    with pytest.raises(FileFormatError, match=r"OwnNet.*trusted=\[simulate, OwnNet\]"):
        saved_and_loaded(posterior, tmp_path)
    trusted = [OwnNet, problems.simulate]
    loaded = saved_and_loaded(posterior, tmp_path, trusted=trusted)
    assert type(loaded.net) is OwnNet
    assert loaded.net(torch.ones(1)).item() == 2
    assert loaded.function is problems.simulate


# --- files ---


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


def test_files_of_other_versions_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("sbi.__version__", "0.1.2")
        save(PriorPosterior(problems.box(2)), tmp_path / "x.pt")
    with pytest.raises(FileFormatError, match=r"0\.1"):
        load(tmp_path / "x.pt")
