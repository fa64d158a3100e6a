"""The list of mutations fits the code as it is, and files are broken one at a time."""

from pathlib import Path

import pytest

from tests.mutations.catalogue import Mutation, faults_of, read_mutations
from tests.mutations.trials import broken


@pytest.mark.medium
def test_every_mutation_of_the_list_can_be_made() -> None:
    mutations = read_mutations()
    assert len({mutation.name for mutation in mutations}) == len(mutations)
    faults = faults_of(mutations)
    assert not faults, "Repair tests/mutations/mutations.toml:\n" + "\n".join(faults)


def test_a_mutation_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    mutation = Mutation(
        name="One is two", file="a.py", before="1", after="2", tests=("test_a.py",)
    )
    assert mutation.faults(tmp_path) == [
        "there is no file a.py",
        "there is no file test_a.py",
    ]
    path, _ = tmp_path / "a.py", (tmp_path / "test_a.py").touch()
    for text in ("x = 0", "x = 1 + 1"):
        path.write_text(text)
        assert "not once" in mutation.faults(tmp_path)[0]
    path.write_text("x = 0  # not 1")
    assert "the same" in mutation.faults(tmp_path)[0]
    path.write_text("x = 1")
    assert mutation.faults(tmp_path) == []


def test_a_file_is_broken_for_the_time_of_a_block_only(tmp_path: Path) -> None:
    path = tmp_path / "a.py"
    path.write_text("x = 1\n")
    mutation = Mutation(name="", file="a.py", before="x = 1", after="x = 2", tests=())
    with broken(tmp_path, mutation):
        assert path.read_text() == "x = 2\n"
    assert path.read_text() == "x = 1\n"
