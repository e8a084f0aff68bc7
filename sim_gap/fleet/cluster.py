"""The workers that a fleet's diagnoses run on: a scheduler that is there, or processes of this machine."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from armlink.errors import BusFault

CONNECT_SECONDS = 10.0
KILLED = 3
"""A case that this many workers died of is given up."""


@contextmanager
def cluster(scheduler: str | None, workers: int) -> Iterator[Any]:
    """A `distributed.Client` on a scheduler's address, else on `workers` processes of this machine, one thread each.

    Raises BusFault (exit status 3) where nobody answers at the address.
    """
    import dask
    from distributed import Client, LocalCluster

    logging.getLogger("distributed").setLevel(logging.ERROR)
    dask.config.set({"distributed.scheduler.allowed-failures": KILLED})
    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=CONNECT_SECONDS)
        except (OSError, ValueError) as error:
            raise BusFault(f"no dask scheduler at {scheduler}: {error}: start one, or leave --scheduler out") from None
        with client:
            yield client
        return
    local = LocalCluster(
        n_workers=workers, threads_per_worker=1, dashboard_address=None, host="127.0.0.1", silence_logs=logging.ERROR
    )
    with local, Client(local) as client:
        yield client
