"""Fixtures and guards shared by all tests."""

import gc
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

# Small parts of published data, which come with the repository.
TEST_DATA = Path(__file__).resolve().parent / "data"
# The whole data sets, which some machines have beside the repository.
SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def pytest_collection_finish() -> None:
    """Leave what was imported and collected out of later garbage collections."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def _seeded() -> Iterator[None]:
    """Give every test the same random numbers, and restore their state afterwards."""
    with torch.random.fork_rng():
        if torch.cuda.is_available():
            torch.cuda.manual_seed_all(0)
        # `torch.manual_seed` would take longer than most tests.
        torch.default_generator.manual_seed(0)
        yield


@pytest.fixture(autouse=True)
def _no_network(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fail any test that opens a connection, unless it is marked ``network``."""
    if request.node.get_closest_marker("network"):
        return

    def refuse(*args: object, **kwargs: object) -> None:
        raise RuntimeError("This test opened a network connection.")

    monkeypatch.setattr(socket.socket, "connect", refuse)


@pytest.fixture
def terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> pytest.CaptureFixture[str]:
    """Return ``capsys`` for a terminal. Progress is shown on a terminal only."""
    # The class is changed, because pytest makes a new object for each phase of a test.
    monkeypatch.setattr(type(sys.stderr), "isatty", lambda self: True)
    return capsys


@pytest.fixture
def rough_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw pictures without arranging their parts, which takes longer than drawing."""
    monkeypatch.setattr("matplotlib.figure.Figure.get_layout_engine", lambda self: None)


@pytest.fixture
def chamber_extract() -> Path:
    """Return the folder with the first rows of recorded experiments."""
    return TEST_DATA / "causal_chamber"
