"""Posteriors in files."""

import tempfile
from pathlib import Path
from typing import Any

from sbi_rope import load, save
from sbi_rope.mixture import PriorPosterior
from tests.faults.outcomes import Call
from tests.faults.problem import PRIOR


def written(
    posterior: Any = None, path: Any = None, *, method: bool = False, **options: Any
) -> int:
    """Save a posterior, the prior unless another one is given; return its size."""
    posterior = PriorPosterior(PRIOR) if posterior is None else posterior
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "posterior.pt"
        arguments = [target if path is None else path]
        if method:
            posterior.save(*arguments, **options)
        else:
            save(posterior, *arguments, **options)
        return target.stat().st_size


def read(path: Any = None, **options: Any) -> Any:
    """Load the prior, and draw from it."""
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "posterior.pt"
        save(PriorPosterior(PRIOR), target)
        loaded = load(target if path is None else path, **options)
    return loaded.sample((3,))


CALLS = [
    Call(
        name="save",
        run=written,
        options={"posterior": "instance", "path": "path", "overwrite": "instance"},
    ),
    Call(
        name="PriorPosterior.save",
        run=lambda **options: written(method=True, **options),
        options={"path": "path", "overwrite": "instance"},
    ),
    Call(
        name="load",
        run=read,
        options={"path": "path", "trusted": "names"},
        is_random=True,
    ),
]
