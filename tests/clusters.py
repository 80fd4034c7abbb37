"""Clusters of dask that stand in for several machines."""

import warnings
from contextlib import contextmanager

import pytest


@contextmanager
def client_of(workers, *, processes=False):
    """Yield a client of so many new workers, threads of this process unless they are to be others."""
    distributed = pytest.importorskip("distributed")
    ways = {"threads_per_worker": 1, "processes": processes, "dashboard_address": "127.0.0.1:0"}
    with warnings.catch_warnings():  # of slow disks and busy ports
        warnings.simplefilter("ignore")
        local = distributed.LocalCluster(n_workers=workers, protocol="tcp://", **ways)
    with local, distributed.Client(local, set_as_default=False) as client:
        yield client
