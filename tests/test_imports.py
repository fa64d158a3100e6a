"""Importing the package has no side effects, and imports run one way."""

import ast
import functools
import importlib
import inspect
import json
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import pytest
import sbi
from sbi.inference import DirectPosterior

import sbi_rope

PACKAGE = Path(sbi_rope.__file__).parent

# What `import sbi_rope` uses of others; these may import what they like.
DEPENDENCIES = "import ot, numpy, torch, tqdm.auto, sbi.inference, sbi.utils"

# A module imports from layers below its own, and from its own package. Those of one
# layer do not know each other.
LAYERS = [
    # They know nothing of inference: errors, means, results in notebooks and tables,
    # progress, processes, slices.
    {
        "errors",
        "_means",
        "_notebooks",
        "_permutation",
        "_progress",
        "_processes",
        "_slices",
        "_tables",
    },
    # They raise errors: of seeds, of files and of functions that cannot be pickled.
    {"_random", "_files", "_pickling"},
    # Groups are held out at random, with a seed.
    {"_groups"},
    # They raise errors and warn: of arguments, and of a training that goes wrong. Units
    # and bounds of parameters are found by draws of the prior with a seed.
    {"_validation", "_training", "_units", "_bounds"},
    # sbi's trainer is told by `_groups` which simulations to hold out together.
    {"_sbi"},
    # Each works on embeddings or posteriors, which `_sbi` takes out of an estimator.
    # Posteriors are saved, whatever they are made of.
    {
        "saving",
        "coupling",
        "finetuning",
        "metrics",
        "_focus",
        "_npe",
        "_simulations",
        "_standardisation",
        "_two_sample",
        "sets",
    },
    # A mixture has the couplings of a batch as weights. A simulator is a source of
    # simulations like stored ones.
    {"mixture", "_simulator"},
    # A batch is coupled, and its couplings make a mixture. Trainers train networks, and
    # average them in a mixture. Tasks have simulators. Labels have a density under a
    # posterior and its prior.
    {"_labels", "batch", "trainers", "tasks"},
    # The NPE that knows the discrepancy is a trainer.
    {"discrepancy"},
    # RoPE conducts fine-tuning, coupling and mixture. The discrepancy tells what labels
    # that are not exact are tuned to.
    {"rope"},
    # Baselines are trainers, two of which are stages of RoPE. The diagnosis looks at
    # the parts of RoPE.
    {"baselines", "diagnosis"},
    # Stacks weigh posteriors of RoPE, of the discrepancy, and of a baseline.
    {"stacking"},
    # Plots know what they draw.
    {"plots"},
    # Reports are pages with plots.
    {"reports"},
]
# A method belongs where users look for it. When it is called, it may import from above.
CALLS_UPWARDS = {("sbi_rope.stacking.report", "reports")}
NEVER_IMPORT_EACH_OTHER = [
    ("tasks", "rope"),
    ("tasks", "mixture"),
    ("tasks", "coupling"),
]
# sbi keeps its promises for what a package's __init__ exports.
PUBLIC_OF_SBI = {
    "sbi.inference",
    "sbi.neural_nets",
    "sbi.utils",
    "sbi.diagnostics",
    "sbi.analysis",
}


IMPORT = f"""
import hashlib, json, random, socket, sys, warnings

def refuse(*args, **kwargs):
    raise RuntimeError("a socket was used")

for name in ("connect", "connect_ex", "bind", "sendto"):
    setattr(socket.socket, name, refuse)
socket.getaddrinfo = socket.create_connection = refuse

import numpy, torch

def state():
    generators = torch.get_rng_state(), numpy.random.get_state(), random.getstate()
    return dict(
        dtype=str(torch.get_default_dtype()),
        rng=hashlib.sha256(generators[0].numpy().tobytes()).hexdigest(),
        numpy=repr(generators[1][2:]) + str(generators[1][1].tolist()),
        random=repr(generators[2]),
        validate=torch.distributions.Distribution._validate_args,
        grad=torch.is_grad_enabled(),
        threads=torch.get_num_threads(),
        deterministic=torch.are_deterministic_algorithms_enabled(),
        filters=[str(f) for f in warnings.filters],
    )

{DEPENDENCIES}
torch.manual_seed(0); numpy.random.seed(0); random.seed(0)
theirs, before = state(), set(sys.modules)
import sbi_rope
alone = sorted(set(sys.modules) - before)
import sbi_rope.metrics, sbi_rope.baselines, sbi_rope.tasks
new, ours = sorted(set(sys.modules) - before), state()
everything = sorted(sys.modules)
print(json.dumps(dict(alone=alone, new=new, all=everything, theirs=theirs, ours=ours)))
"""


@pytest.mark.medium
def test_importing_prints_nothing_loads_nothing_heavy_and_changes_no_state() -> None:
    # One test, because a fresh interpreter takes seconds to import torch and sbi.
    result = subprocess.run(
        [sys.executable, "-c", IMPORT],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    # Using a socket would have raised an error.
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""
    *printed, report = result.stdout.splitlines()
    assert printed == []

    fresh = json.loads(report)
    packages = {name.split(".")[0] for name in fresh["new"]}
    assert packages.isdisjoint({"pandas", "matplotlib", "causalchamber", "six", "PIL"})
    for name in ("sbi.analysis", "causalchamber"):
        assert name not in fresh["all"]
    # Whatever the list above forgets.
    assert packages - set(sys.stdlib_module_names) <= {"sbi_rope", "sbi"}

    assert {part_of(name) for name in fresh["alone"]} >= {"trainers", "stacking"}
    assert not [name for name in fresh["alone"] if part_of(name) == "baselines"]

    # torch's state is as after importing sbi alone.
    assert fresh["ours"] == fresh["theirs"]


def test_what_is_promised_is_there() -> None:
    for name in sbi_rope.__all__:
        assert getattr(sbi_rope, name).__name__ == name
    assert sbi_rope.__version__.count(".") == 2


# --- layers ---


def modules() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def module_name(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@functools.cache
def imports_of(path: Path, *, top_level: bool = False) -> frozenset[str]:
    """Absolute names of all that a file imports, ``from a import b`` as a and a.b."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    found: set[str] = set()
    for node in tree.body if top_level else ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name} has a relative import"
            assert node.module is not None
            found.add(node.module)
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return frozenset(found)


def part_of(module: str) -> str | None:
    """The part of the package a module belongs to: sbi_rope.mixture.x to mixture."""
    names = module.split(".")
    return names[1] if names[0] == "sbi_rope" and len(names) > 1 else None


def parts_imported(path: Path) -> set[str]:
    known = set().union(*LAYERS)
    return {part for name in imports_of(path) if (part := part_of(name)) in known}


def layer(part: str) -> int:
    return next(i for i, parts in enumerate(LAYERS) if part in parts)


def test_every_module_has_a_layer() -> None:
    for path in modules():
        part = part_of(module_name(path))
        assert part is None or part in set().union(*LAYERS), f"give {part} a place"


def test_every_room_is_described() -> None:
    rooms = (PACKAGE.parent / "CONTRIBUTING.md").read_text()
    for part in set().union(*LAYERS):
        named = f"`{part}/`" in rooms or f"`{part}.py`" in rooms
        assert named, f"CONTRIBUTING.md says nothing about {part}"


@pytest.mark.medium
def test_no_module_imports_the_package_as_a_whole() -> None:
    # It would hide which layer is meant, and close a circle.
    for path in modules():
        names = {name for name in imports_of(path) if name.startswith("sbi_rope.")}
        parts = {part_of(name) for name in names}
        assert parts <= set().union(*LAYERS), path


def test_imports_run_from_upper_to_lower_layers() -> None:
    for path in modules():
        part = part_of(module_name(path))
        if part is None or path.name == "__main__.py":
            continue  # the package's own __init__ and commands may import all
        for other in parts_imported(path) - {part}:
            if (module_name(path), other) in CALLS_UPWARDS:
                assert other not in map(part_of, imports_of(path, top_level=True))
                continue
            # Plots, for one, are above all they draw; equals do not know each other.
            assert layer(other) < layer(part), f"{path}: {part} imports {other}"


@pytest.mark.parametrize(("one", "other"), NEVER_IMPORT_EACH_OTHER)
def test_tasks_and_methods_do_not_know_each_other(one: str, other: str) -> None:
    for path in modules():
        part = part_of(module_name(path))
        if part in (one, other):
            assert parts_imported(path).isdisjoint({one, other} - {part}), path


def names_beyond_public(names: set[str]) -> set[str]:
    """Paths into sbi deeper than its public packages, as ``sbi.utils.x`` modules."""
    root = Path(sbi.__file__).parent.parent
    beyond = set()
    for name in names:
        if name.split(".")[0] != "sbi" or name in PUBLIC_OF_SBI | {"sbi"}:
            continue
        # A name exported by a public package is no module of its own.
        path = root.joinpath(*name.split("."))
        if path.is_dir() or path.with_suffix(".py").is_file():
            beyond.add(name)
    return beyond


def test_only_one_module_reaches_into_sbi() -> None:
    for path in modules():
        if part_of(module_name(path)) == "_sbi":
            continue
        beyond = names_beyond_public(imports_of(path))
        assert not beyond, f"{path}: take {sorted(beyond)} from sbi_rope._sbi"


def test_the_check_for_reaching_into_sbi_tells_modules_from_names() -> None:
    public = {"sbi.utils", "sbi.utils.BoxUniform", "sbi.inference.NPE", "torch.nn"}
    assert names_beyond_public(public) == set()
    deep = {"sbi.inference.posteriors.base_posterior", "sbi.utils.torchutils"}
    assert names_beyond_public(deep) == deep


# Without an underscore, but as much inside sbi's trainers as the names that have one.
INSIDE_TRAINERS = {"get_dataloaders", "train_indices", "val_indices"}


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__")


def is_of_oneself(node: ast.Attribute) -> bool:
    """Whether it is an attribute of self, cls or super()."""
    value = node.value.func if isinstance(node.value, ast.Call) else node.value
    return isinstance(value, ast.Name) and value.id in ("self", "cls", "super")


def private_names(tree: ast.AST) -> set[str]:
    """Private names that classes define, or use of themselves."""
    names = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and is_of_oneself(node)
    }
    names |= {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
    return {name for name in names if is_private(name)} | names & INSIDE_TRAINERS


@functools.cache
def private_names_of(kind: type) -> frozenset[str]:
    source = textwrap.dedent(inspect.getsource(kind))
    return frozenset(private_names(ast.parse(source)))


@functools.cache
def private_names_of_sbi() -> frozenset[str]:
    """Those of all classes of sbi, from its source."""
    found: set[str] = set()
    for path in Path(sbi.__file__).parent.rglob("*.py"):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef):
                found |= private_names(node)
    return frozenset(found | INSIDE_TRAINERS)


def inherited_insides(kind: type) -> set[str]:
    """What a class uses or overrides of the insides of its bases in sbi."""
    bases = [base for base in kind.__mro__ if base.__module__.startswith("sbi.")]
    if not bases:
        return set()
    return set(private_names_of(kind)) & set().union(*map(private_names_of, bases))


def foreign_insides(tree: ast.AST) -> set[str]:
    """What a file uses of the insides of objects that may be sbi's.

    A private name that the classes of the same file have is taken for theirs.
    """
    used = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and not is_of_oneself(node)
    }
    return used & private_names_of_sbi() - private_names(tree)


@pytest.mark.medium
def test_only_one_module_uses_what_is_private_to_sbi() -> None:
    for path in modules():
        name = module_name(path)
        if part_of(name) == "_sbi" or path.name == "__main__.py":
            continue
        insides = foreign_insides(ast.parse(path.read_text(encoding="utf-8")))
        for kind in vars(importlib.import_module(name)).values():
            if inspect.isclass(kind) and kind.__module__ == name:
                insides |= inherited_insides(kind)
        assert not insides, f"{path}: {sorted(insides)} belong into sbi_rope._sbi"


@pytest.mark.medium
def test_the_check_for_what_is_private_to_sbi_finds_it() -> None:
    class Planted(DirectPosterior):
        def map(self) -> Any:  # type: ignore[override]
            return self._x, self._of_our_own, super()._map  # type: ignore[misc]

        def _calculate_map(self) -> Any:  # type: ignore[override]
            return None

    assert inherited_insides(Planted) == {"_x", "_map", "_calculate_map"}
    known = {"_neural_net", "_condition_shape", "_loss", "_x", "_purpose", "_mean"}
    assert known | INSIDE_TRAINERS <= private_names_of_sbi()
    planted = "def f(npe, ours): return npe._neural_net, npe.val_indices, ours._of_ours"
    assert foreign_insides(ast.parse(planted)) == {"_neural_net", "val_indices"}
    assert foreign_insides(ast.parse("class A:\n def f(self): self._x = 1")) == set()


def test_plots_and_data_libraries_are_imported_where_they_are_used() -> None:
    for path in modules():
        names = imports_of(path, top_level=True)
        packages = {name.split(".")[0] for name in names}
        assert packages.isdisjoint({"matplotlib", "pandas", "causalchamber", "six"})
        assert "sbi.analysis" not in names, path
