"""A saved posterior is loaded by another process, as it was, without running code."""

import functools
import importlib
import inspect
import json
import math
import os
import pickle
import pkgutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from sbi.neural_nets.embedding_nets import CNNEmbedding, PermutationInvariantEmbedding
from sbi.utils import BoxUniform, MultipleIndependent
from sbi.utils.user_input_checks_utils import PytorchReturnTypeWrapper
from torch import Tensor, nn
from torch.distributions import (
    Exponential,
    Gamma,
    Independent,
    LogNormal,
    MultivariateNormal,
    Normal,
)

import sbi_rope
from sbi_rope import MixturePosterior, StackedPosterior, load, save
from sbi_rope.errors import (
    DataNotFoundError,
    FileFormatError,
    InvalidInputError,
    NotWritableError,
    UntrustedError,
)
from sbi_rope.mixture import MixtureEstimator, PriorPosterior, part_of
from sbi_rope.saving.description import Description
from sbi_rope.saving.memory import unpacked
from sbi_rope.saving.names import ROOMS, find_class, find_value
from sbi_rope.stacking import DiscrepancyCandidate, FinetunedCandidate
from sbi_rope.tasks.hemodynamics.prior import PopulationPrior
from sbi_rope.tasks.triangle import UniformTriangle
from tests import problems, stacks
from tests.baselines import data_of, trained

pytestmark = pytest.mark.filterwarnings("ignore:.*lie outside the prior support")

QUIET = {"show_progress_bars": False}
ROOT = Path(__file__).resolve().parents[2]


def mixture_of(posterior: Any) -> MixturePosterior:
    """Return a mixture of one part, for any x."""
    estimator = MixtureEstimator([part_of(posterior.posterior_estimator)], [1.0])
    return MixturePosterior(estimator, posterior.prior)


def rope_posterior(embedding: str = "linear", **options: Any) -> MixturePosterior:
    rope = stacks.rope_of(embedding=embedding).train(seed=0, **QUIET)
    return rope.build_posterior(stacks.observed(), seed=0, **options, **QUIET)


@functools.cache
def stack_of() -> StackedPosterior:
    """Return a stack of few candidates, for reading only."""
    trained_ones = (
        DiscrepancyCandidate(space="tuned"),
        FinetunedCandidate(),
        stacks.FITTED,
    )
    candidates = [stacks.PRIOR, stacks.NPE, *trained_ones]
    with torch.random.fork_rng():
        return stacks.stacked(stacks.rope_of(), candidates=candidates)


def numbers(posterior: Any, x: Tensor, *, truncated: bool = True) -> list[Tensor]:
    """Samples with a seed, and log densities."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        options = {} if truncated else {"reject_outside_prior": False}
        samples = posterior.sample_batched((3,), x, **QUIET, **options)
    found = [samples]
    if hasattr(posterior, "log_prob_batched"):
        options = {} if truncated else {"norm_posterior": False}
        found.append(posterior.log_prob_batched(samples, x, **options).detach())
    return found


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
before = set(sys.modules)
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
    batch, stack = rope_posterior(), stack_of()
    tuned = trained("discrepancy_tuned", "linear_gaussian").build_posterior()
    prior = PriorPosterior(problems.box(2))
    x_o = stacks.observed()
    cases = [
        (batch, x_o[:5]),
        (batch[3], x_o[3:4]),
        (stack, x_o[:4]),
        (tuned, data_of("linear_gaussian").x_o[:3]),
        (prior, x_o[:2]),
    ]
    for number, (posterior, x) in enumerate(cases):
        posterior.save(tmp_path / f"{number}.pt")
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


@pytest.mark.medium
@pytest.mark.parametrize(
    "prior",
    [
        BoxUniform(-torch.ones(2), torch.ones(2)),
        MultivariateNormal(torch.zeros(2), torch.eye(2)),
        Independent(LogNormal(torch.zeros(2), torch.ones(2)), 1),
        MultipleIndependent([BoxUniform(torch.zeros(1), torch.ones(1))] * 2),
        MultipleIndependent(
            [Gamma(torch.ones(1), torch.ones(1)), Exponential(torch.ones(1))]
        ),
        PytorchReturnTypeWrapper(
            MultivariateNormal(torch.zeros(2).double(), torch.eye(2).double()),
            event_shape=torch.Size([2]),
        ),
    ],
    ids=lambda prior: type(prior).__name__,
)
def test_priors_can_be_saved(prior: Any, tmp_path: Path) -> None:
    estimator = problems.npe_posterior().posterior_estimator
    for posterior in (
        MixturePosterior(MixtureEstimator([part_of(estimator)], [1.0]), prior),
        PriorPosterior(prior),
    ):
        loaded = saved_and_loaded(posterior, tmp_path)
        assert_same(posterior, loaded, torch.zeros(2, 3))
        loaded.set_default_x(torch.zeros(1, 3))
        found = loaded.map(num_iter=2, num_init_samples=5, num_to_optimize=2)
        assert found.isfinite().all()


@pytest.mark.parametrize(
    "prior", [UniformTriangle(torch.tensor(0.5)), PopulationPrior()]
)
def test_priors_of_the_tasks_can_be_saved(prior: Any, tmp_path: Path) -> None:
    loaded = saved_and_loaded(PriorPosterior(prior), tmp_path)
    theta = loaded.prior.sample((20,))
    assert torch.equal(loaded.prior.log_prob(theta), prior.log_prob(theta))
    assert loaded.set_default_x(torch.zeros(1, 3)).map(num_iter=2).isfinite().all()


@pytest.mark.parametrize(
    ("net", "shape"),
    [
        (nn.GRU(3, 4, batch_first=True), (5, 3)),
        (nn.TransformerEncoderLayer(4, 2, 8, batch_first=True), (5, 4)),
        (CNNEmbedding((16, 16), num_linear_units=4), (16, 16)),
        (PermutationInvariantEmbedding(nn.Linear(3, 4), 4, output_dim=4), (6, 3)),
    ],
    ids=lambda value: type(value).__name__,
)
def test_networks_of_torch_and_sbi_can_be_saved(
    net: nn.Module, shape: tuple[int, ...], tmp_path: Path
) -> None:
    posterior = PriorPosterior(problems.box(2))
    posterior.net = net.eval()  # type: ignore[attr-defined]
    x = torch.randn(2, *shape)
    loaded = saved_and_loaded(posterior, tmp_path).net
    found, expected = loaded(x), net(x)
    if isinstance(found, tuple):
        found, expected = found[0], expected[0]
    assert torch.equal(found, expected)


@pytest.mark.medium
def test_settings_may_be_numbers_of_numpy(tmp_path: Path) -> None:
    posterior = rope_posterior(tail_mass=np.float64(1e-2))
    assert_same(posterior, saved_and_loaded(posterior, tmp_path), stacks.observed()[:3])


def test_a_description_does_not_depend_on_the_order_of_a_set() -> None:
    # They have the same hash in a small set, as texts may have in another process.
    one, other = set((0, 8)), set((8, 0))
    assert list(one) != list(other)
    posterior: Any = PriorPosterior(problems.box(2))
    posterior.numbers = one
    objects = Description(posterior).objects
    posterior.numbers = other
    assert Description(posterior).objects == objects


@pytest.mark.medium
def test_a_stack_keeps_its_report_and_its_candidates(tmp_path: Path) -> None:
    stack, x = stack_of(), stacks.observed()[:4]
    loaded = saved_and_loaded(stack, tmp_path)
    assert str(loaded.report) == str(stack.report)
    assert loaded.report.as_rows() == stack.report.as_rows()
    assert loaded.candidate_weights == stack.candidate_weights
    theta = problems.box(2).sample((4,))
    found = loaded.candidate_log_probs(theta, x)
    assert torch.equal(found, stack.candidate_log_probs(theta, x))


@pytest.mark.medium
def test_a_loaded_batch_can_be_extended_and_indexed(tmp_path: Path) -> None:
    posterior = rope_posterior(unseen="extend")
    loaded = saved_and_loaded(posterior, tmp_path)
    new = stacks.problem(2, seed=9)[1]
    with pytest.warns(sbi_rope.errors.RoPEWarning, match="Extended"):
        found, expected = (
            one.log_prob_batched(torch.zeros(2, 2), new) for one in (loaded, posterior)
        )
    assert torch.equal(found, expected)
    assert torch.equal(loaded[4].default_x, posterior.x_o[4:5])
    assert torch.equal(loaded.weights, posterior.weights)


def test_what_is_trained_keeps_its_gradients_and_dtypes(tmp_path: Path) -> None:
    posterior = PriorPosterior(problems.box(2))
    values = {
        "free": nn.Parameter(torch.ones(2)),
        "fixed": nn.Parameter(torch.ones(2), requires_grad=False),
        "half": torch.ones(3, dtype=torch.bfloat16),
        "none": torch.empty(0, 4),
        "flags": torch.tensor([True, False]),
        "turned": torch.randn(3, 2).mT,
        "array": np.arange(3),
        "others": (math.inf, 1j, b"\0a", {1, 2}, range(3), torch.float64, {2: None}),
    }
    posterior.values = values  # type: ignore[attr-defined]
    loaded = saved_and_loaded(posterior, tmp_path).values
    for name in ("free", "fixed", "half", "none", "flags", "turned"):
        assert torch.equal(loaded[name], values[name])
        assert loaded[name].dtype == values[name].dtype
        assert loaded[name].stride() == values[name].stride()
        assert loaded[name].requires_grad == values[name].requires_grad
        assert type(loaded[name]) is type(values[name])
    assert (loaded["array"] == values["array"]).all()
    assert loaded["others"] == values["others"]


def test_equal_tensors_are_stored_once_and_loaded_apart(tmp_path: Path) -> None:
    posterior: Any = PriorPosterior(problems.box(2))
    one = torch.randn(1000, 100)
    posterior.tensors = [one, one, one.clone(), one.clone()[:500], torch.randn(9)]
    loaded = saved_and_loaded(posterior, tmp_path).tensors
    size = (tmp_path / "posterior.pt").stat().st_size
    assert size < 1.6 * one.numel() * 4  # that of one, and of the half of it
    first, again, equal, half, _ = loaded
    assert all(
        torch.equal(a, b) for a, b in zip(loaded, posterior.tensors, strict=True)
    )
    assert first is again
    first.zero_()
    assert equal.any()
    assert half.any()


@pytest.mark.medium
def test_a_posterior_of_a_gpu_is_loaded_on_the_cpu(tmp_path: Path) -> None:
    posterior = rope_posterior()
    expected = numbers(posterior, posterior.x_o[:2])
    # What sbi keeps of the device of a posterior.
    posterior.device, posterior._device = torch.device("cuda:0"), "cuda:0"
    posterior.potential_fn.device = "cuda:0"
    loaded = saved_and_loaded(posterior, tmp_path)
    found = numbers(loaded, posterior.x_o[:2])
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))
    devices = (loaded.device, loaded._device, loaded.potential_fn.device)
    assert {str(device) for device in devices} == {"cpu"}


@pytest.mark.gpu
def test_a_posterior_on_a_gpu_is_saved_and_loaded_on_the_cpu(tmp_path: Path) -> None:
    posterior = rope_posterior()
    expected = posterior.log_prob(torch.zeros(2, 2), x=posterior.x_o[0])
    posterior.to("cuda")
    loaded = saved_and_loaded(posterior, tmp_path)
    found = loaded.log_prob(torch.zeros(2, 2), x=loaded.x_o[0])
    assert torch.allclose(found, expected, atol=1e-5)


# --- one observation ---


@pytest.mark.medium
def test_the_file_of_one_observation_holds_no_other(tmp_path: Path) -> None:
    # Whatever was asked for before.
    posterior, x_o = rope_posterior(), stacks.observed()
    posterior.log_prob_batched(torch.zeros(1, len(x_o), 2), x_o)
    posterior.potential(torch.zeros(1, 2), x_o[7])
    posterior[3].save(tmp_path / "one.pt")
    held = [t for t in tensors_in(tmp_path / "one.pt") if t.shape[-1:] == x_o.shape[1:]]
    assert any(torch.equal(x_o[3:4], t) for t in held)
    assert not any((t == x).all(dim=-1).any() for x in x_o[4:] for t in held)
    whole = tmp_path / "whole.pt"
    posterior.save(whole)
    assert (tmp_path / "one.pt").stat().st_size < whole.stat().st_size


def tensors_in(path: Path) -> list[Tensor]:
    with np.load(path) as arrays:
        rows = json.loads(arrays["description"].tobytes())["tensors"]
        return list(unpacked(arrays["memory"], rows))


# --- what is refused ---


class Attack:
    """What a malicious file holds: the loader of pickle calls ``os.system``."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[str]]:
        return os.system, (f"touch {self.target}",)


@pytest.mark.parametrize("write", [pickle.dump, torch.save, np.save])
def test_a_malicious_pickle_is_refused_and_not_executed(
    write: Callable[..., Any], tmp_path: Path
) -> None:
    path, target = tmp_path / "posterior.pt", tmp_path / "executed"
    with path.open("wb") as file:
        if write is np.save:
            np.save(file, np.array([Attack(target)]), allow_pickle=True)
        else:
            write(Attack(target), file)
    with pytest.raises(FileFormatError, match="Nothing in it was executed"):
        load(path)
    assert not target.exists()


def rewritten(path: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """Write a prior to a file, and change what it describes."""
    save(PriorPosterior(problems.box(2)), path, overwrite=True)
    with np.load(path) as arrays:
        memory = arrays["memory"]
        description = json.loads(arrays["description"].tobytes())
    change(description)
    text = np.frombuffer(json.dumps(description).encode(), np.uint8)
    with path.open("wb") as file:
        np.savez(file, description=text, memory=memory)
    return path


@pytest.mark.parametrize(
    "name",
    [
        "os.system",
        "subprocess.Popen",
        "torch.fx.graph_module.GraphModule",
        "torch.nn.modules.module.os",
        "torch.jit._script.ScriptModule",
        "sbi.inference.posteriors.vi_posterior.VIPosterior",
        "scipy.stats._distn_infrastructure.rv_frozen",
        "sbi_rope.saving.files.save",
        "sbi_rope.rope.RoPE",
        "sbi_rope.tasks.hemodynamics.openbf.OpenBFCase",
        "this_module_is.nowhere.Net",
        "zuko.nowhere.Net",
    ],
)
def test_other_classes_and_functions_are_refused_wherever_they_are_named(
    name: str, tmp_path: Path
) -> None:
    path = rewritten(
        tmp_path / "x.pt", lambda found: found["objects"].append([name, ["dict"]])
    )
    with pytest.raises(UntrustedError, match=r"trusted=\["):
        load(path)
    path = rewritten(
        tmp_path / "x.pt",
        lambda found: found["objects"][0][1].append(["a", ["name", name]]),
    )
    with pytest.raises(UntrustedError, match=r"trusted=\["):
        load(path)


def test_a_file_can_name_no_method_that_writes_files(tmp_path: Path) -> None:
    path = rewritten(
        tmp_path / "x.pt",
        lambda found: found["objects"][0][1].append(["a", ["method", 0, "save"]]),
    )
    with pytest.raises(FileFormatError, match="damaged"):
        load(path)


def test_a_value_may_only_be_a_class_that_makes_distributions() -> None:
    name = "torch.distributions.normal.Normal"
    assert find_value(name, {}) is Normal
    assert find_value("torch.tanh", {}) is torch.tanh
    others = ("torch.nn.modules.linear.Linear", "torch.load", "builtins.eval")
    of_the_same_rooms = ("torch.distributions.kl.kl_divergence", "zuko.nn.MLP")
    for other in (*others, *of_the_same_rooms):
        assert find_value(other, {}) is None


def test_classes_that_run_code_when_loaded_are_the_ones_that_were_read() -> None:
    """Only torch's own networks and sbi's posteriors do, and they set attributes.

    A new one has to be read before this test is changed.
    """
    known: list[type] = []
    for room in ROOMS:
        package = importlib.import_module(room)
        modules = [room]
        if hasattr(package, "__path__"):
            modules += [
                found.name
                for found in pkgutil.walk_packages(package.__path__, f"{room}.")
                if not found.name.endswith("__main__")
            ]
        for module in modules:
            try:
                members = vars(importlib.import_module(module))
            except ImportError:  # of what is not installed
                continue
            for kind in members.values():
                if inspect.isclass(kind) and kind.__module__ == module:
                    known += [kind] * (
                        find_class(f"{module}.{kind.__name__}", {}) is kind
                    )
    assert len(known) > 200
    running = {kind.__module__.rpartition(".")[0] for kind in known if loads(kind)}
    assert running <= {"torch.nn.modules"}
    inherited = {owner for kind in known for owner in kind.__mro__ if loads(owner)}
    others = {kind for kind in inherited if not kind.__module__.startswith("torch.nn.")}
    assert {kind.__name__ for kind in others} <= {"NeuralPosterior"}


def loads(kind: type) -> bool:
    return "__setstate__" in vars(kind)


class OwnNet(nn.Module):
    """An embedding net that a user has written."""

    def forward(self, x: Tensor) -> Tensor:
        return 2 * x


def test_classes_of_the_user_have_to_be_trusted(tmp_path: Path) -> None:
    posterior: Any = PriorPosterior(problems.box(2))
    posterior.net, posterior.function = OwnNet(), problems.simulate
    with pytest.raises(UntrustedError, match=r"OwnNet.*trusted=\[OwnNet\]"):
        saved_and_loaded(posterior, tmp_path)
    with pytest.raises(UntrustedError, match=r"trusted=\[simulate\]"):
        saved_and_loaded(posterior, tmp_path, trusted=[OwnNet])
    trusted = [OwnNet, problems.simulate]
    loaded = saved_and_loaded(posterior, tmp_path, trusted=trusted)
    assert type(loaded.net) is OwnNet
    assert loaded.function is problems.simulate


def test_a_class_of_a_notebook_is_found_in_the_module_it_moved_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    posterior: Any = PriorPosterior(problems.box(2))
    posterior.net = OwnNet()
    with monkeypatch.context() as patch:
        patch.setattr(OwnNet, "__module__", "__main__")
        save(posterior, tmp_path / "x.pt")
    with pytest.raises(UntrustedError, match=r"__main__\.OwnNet"):
        load(tmp_path / "x.pt")
    assert type(load(tmp_path / "x.pt", trusted=[OwnNet]).net) is OwnNet


@pytest.mark.parametrize(
    ("value", "what"),
    [
        (lambda x: x, "<lambda>"),
        (OwnNet().forward, "the method OwnNet.forward"),
        (torch.eye(2).to_sparse(), "sparse"),
        (open(os.devnull), "TextIOWrapper"),  # noqa: SIM115
        (np.array([None]), "ndarray"),
        (torch.Generator(), "Generator"),
    ],
    ids=["lambda", "method", "sparse", "file", "objects", "generator"],
)
def test_what_cannot_be_described_is_refused_by_its_place(
    value: Any, what: str, tmp_path: Path
) -> None:
    posterior: Any = PriorPosterior(problems.box(2))
    posterior.things = {"first": [value]}
    with pytest.raises(InvalidInputError, match=r"posterior\.things\.first\[0\]") as e:
        save(posterior, tmp_path / "x.pt")
    assert what in str(e.value)
    assert not list(tmp_path.iterdir())


def test_only_posteriors_are_saved(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="Save what its `build_posterior`"):
        save(stacks.rope_of(), tmp_path / "x.pt")
    with pytest.raises(InvalidInputError, match="got int"):
        save(3, tmp_path / "x.pt")


def test_the_trusted_are_classes(tmp_path: Path) -> None:
    save(PriorPosterior(problems.box(2)), tmp_path / "x.pt")
    for trusted in (OwnNet, "OwnNet", ["tests.OwnNet"], [OwnNet()]):
        with pytest.raises(InvalidInputError, match=r"\[MyNet\]"):
            load(tmp_path / "x.pt", trusted=trusted)  # type: ignore[arg-type]


# --- files ---


def test_a_file_is_replaced_only_when_asked_to(tmp_path: Path) -> None:
    path = tmp_path / "new" / "x.pt"
    posterior = PriorPosterior(problems.box(2))
    posterior.save(path)
    before = path.read_bytes()
    with pytest.raises(NotWritableError, match="overwrite=True"):
        PriorPosterior(problems.box(1)).save(path)
    assert path.read_bytes() == before
    PriorPosterior(problems.box(1)).save(path, overwrite=True)
    assert load(path).sample((2,)).shape == (2, 1)
    assert [file.name for file in path.parent.iterdir()] == ["x.pt"]
    with pytest.raises(NotWritableError, match="the folder"):
        posterior.save(tmp_path, overwrite=True)
    link = tmp_path / "link.pt"
    link.symlink_to(path)
    PriorPosterior(problems.box(3)).save(link, overwrite=True)
    assert link.is_symlink()
    assert load(path).sample((2,)).shape == (2, 3)
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(NotWritableError, match="a device"):
        posterior.save(pipe, overwrite=True)
    assert pipe.is_fifo()
    with pytest.raises(DataNotFoundError, match="Check `path`"):
        load(tmp_path / "nothing.pt")


def test_damaged_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.pt"
    PriorPosterior(problems.box(2)).save(path)
    whole = path.read_bytes()
    middle = len(whole) // 2
    flipped = whole[:middle] + bytes([whole[middle] ^ 255]) + whole[middle + 1 :]
    for damaged in (b"", b"text", whole[:-20], whole[:200], flipped):
        path.write_bytes(damaged)
        with pytest.raises(FileFormatError):
            load(path)
    np.savez(path.with_suffix(".npz"), a=np.zeros(2))
    with pytest.raises(FileFormatError, match="file of `save`"):
        load(path.with_suffix(".npz"))


@pytest.mark.parametrize(
    "change",
    [
        lambda found: found.update(objects=[]),
        lambda found: found.update(tensors=[]),
        lambda found: found["objects"][0].__setitem__(
            0, "torch.nn.modules.linear.Linear"
        ),
        lambda found: found["objects"][0].__setitem__(1, ["unknown"]),
        lambda found: found["tensors"][0].__setitem__(1, [10**6]),
        lambda found: found["tensors"][0].__setitem__(0, "load"),
        lambda found: found.pop("versions"),
        lambda found: found["versions"].update(sbi=3),
        lambda found: found.pop("format_version"),
    ],
)
def test_descriptions_that_make_no_sense_are_refused(
    change: Callable[[dict[str, Any]], object], tmp_path: Path
) -> None:
    with pytest.raises(FileFormatError, match="damaged"):
        load(rewritten(tmp_path / "x.pt", change))


@pytest.mark.parametrize(
    ("package", "version", "is_read"),
    [
        ("sbi", "0.26.1", False),
        ("sbi", sbi_rope.saving.files._installed("sbi") + ".post1", True),
        ("torch", "1.13.0", False),
        ("torch", "2.999.0+cu126", True),
        ("sbi_rope", "0.0.9", False),
    ],
)
def test_files_of_other_versions_are_refused_with_a_remedy(
    package: str, version: str, is_read: bool, tmp_path: Path
) -> None:
    path = rewritten(
        tmp_path / "x.pt", lambda found: found["versions"].update({package: version})
    )
    if is_read:
        assert load(path).sample((2,)).shape == (2, 2)
        return
    with pytest.raises(FileFormatError, match="pip install") as caught:
        load(path)
    assert f"{package} {version}" in str(caught.value)


def test_files_of_another_format_name_the_version_that_reads_them(
    tmp_path: Path,
) -> None:
    path = rewritten(
        tmp_path / "x.pt",
        lambda found: (
            found.update(format_version=2),
            found["versions"].update(sbi_rope="7.1.0"),
        ),
    )
    with pytest.raises(FileFormatError, match=r"format 2. Use sbi_rope 7.1.0"):
        load(path)
