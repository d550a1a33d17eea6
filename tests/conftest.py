"""What all tests share."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

# Before torch is imported anywhere: threads that spin while they wait starve their neighbours on a busy machine.
os.environ.setdefault("GOMP_SPINCOUNT", "2000")

import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def root() -> Path:
    """The repository."""
    return ROOT


@pytest.fixture(scope="session")
def shared() -> Path:
    """Evaluation data beside the repository; tests that need it skip where it is not."""
    folder = ROOT.parent / "shared"
    if not (folder / "data").is_dir():
        pytest.skip("no evaluation data beside the repository (../shared/data)")
    return folder


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """One thread while a module's tests run: its problems are small, and sums then have one order."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
