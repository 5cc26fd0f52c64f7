"""One Dask cluster of a single thread of this process, for what does not need processes of its own."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from distributed import Client, LocalCluster


@pytest.fixture(scope="session")
def here() -> Iterator[Any]:
    """A client of it."""
    own = {"processes": False, "n_workers": 1, "threads_per_worker": 1, "dashboard_address": "127.0.0.1:0"}
    with LocalCluster(**own) as cluster, Client(cluster, set_as_default=False) as client:
        yield client


@pytest.fixture(scope="session")
def pair() -> Iterator[Any]:
    """A client of two workers that are processes."""
    own = {"n_workers": 2, "threads_per_worker": 1, "memory_limit": 0, "dashboard_address": "127.0.0.1:0"}
    with LocalCluster(**own, silence_logs=50) as cluster, Client(cluster, set_as_default=False) as client:
        yield client
