"""Importing the package has no side effects, and imports run from above to below."""

import ast
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import sbi_rope

PACKAGE = Path(sbi_rope.__file__).parent

# The rooms by layer, the lowest first. A room imports from lower layers only.
LAYERS = [
    "utils",
    "npe training coupling",
    "data density saving tasks",
    "metrics discrepancy",
    "rope",
    "stacking methods diagnosis",
    "baselines plots",
    "report",
]
LAYER = {room: k for k, rooms in enumerate(LAYERS) for room in rooms.split()}
# sbi keeps its promises for what these export. One room reaches deeper.
PUBLIC_OF_SBI = {"", "inference", "neural_nets", "utils", "diagnostics", "analysis"}

IMPORT = """
import importlib, json, pkgutil, socket, sys, warnings

# Using one raises an error.
socket.socket.connect = socket.getaddrinfo = socket.create_connection = None

# What the package needs; these may import what they like.
import ot, numpy, torch, tqdm.auto, sbi.inference, sbi.utils

def state():
    return [
        str(torch.get_default_dtype()),
        torch.get_rng_state().tolist(),
        numpy.random.get_state()[1].tolist(),
        torch.distributions.Distribution._validate_args,
        torch.get_num_threads(),
        [str(one) for one in warnings.filters],
    ]

before, theirs = state(), set(sys.modules)
import sbi_rope
for module in pkgutil.iter_modules(sbi_rope.__path__, "sbi_rope."):
    importlib.import_module(module.name)
new = sorted(set(sys.modules) - theirs)
print(json.dumps(dict(new=new, before=before, after=state())))
"""


@pytest.mark.medium
def test_importing_prints_nothing_loads_nothing_heavy_and_changes_no_state() -> None:
    # One test, because a fresh interpreter takes seconds to import torch and sbi.
    command = [sys.executable, "-c", IMPORT]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""
    (report,) = result.stdout.splitlines()
    fresh = json.loads(report)
    # So neither matplotlib nor pandas, numba or a library of data.
    packages = {name.split(".")[0] for name in fresh["new"]}
    assert packages - set(sys.stdlib_module_names) <= {"sbi_rope", "sbi"}
    assert "sbi.analysis" not in fresh["new"]
    assert fresh["after"] == fresh["before"]


def imports() -> Iterator[tuple[Path, str, list[str]]]:
    """Each import of a module, with the room of the importing file, as dotted names."""
    for path in sorted(PACKAGE.rglob("*.py")):
        room = path.relative_to(PACKAGE).with_suffix("").parts[0]
        if path.name == "__main__.py" or room == "__init__":
            continue  # commands and the package's own exports may import all
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                for alias in node.names:
                    yield path, room, alias.name.split(".")
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{path} has a relative import"
                yield path, room, str(node.module).split(".")


def test_rooms_import_from_lower_layers_and_one_reaches_into_sbi() -> None:
    for path, room, names in imports():
        assert room in LAYER, f"give {room} a place"
        if names[0] == "sbi" and room != "npe":
            assert ".".join(names[1:]) in PUBLIC_OF_SBI, f"{path}: {'.'.join(names)}"
        if names[0] != "sbi_rope":
            continue
        assert len(names) > 1, f"{path} imports the package as a whole"
        if (other := names[1]) != room:
            assert LAYER[other] < LAYER[room], f"{path}: {room} imports {other}"
        # Tasks are problems for any method.
        assert room != "tasks" or other in {"tasks", "utils", "npe"}, f"{path}: {other}"
