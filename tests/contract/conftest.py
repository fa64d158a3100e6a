"""Fixtures shared by the tests of contracts."""

from pathlib import Path

import pytest

from tests.tasks import root_fixture


@pytest.fixture
def root(request: pytest.FixtureRequest, name: str) -> Path | None:
    """Folder with the recorded data of the task called ``name``, if it has any."""
    fixture = root_fixture(name)
    return None if fixture is None else request.getfixturevalue(fixture)
