"""The workers for the diagnoses of a fleet: an existing scheduler, or processes on this machine."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from armlink.errors import BusFault

CONNECT_SECONDS = 10.0
KILLED = 3
"""A case at which this number of workers died is given up."""


def open_to_all(scheduler: str | None) -> str:
    """What to say of a scheduler whose address is not one of TLS; empty where there is nothing to say."""
    if scheduler is None or scheduler.startswith("tls://"):
        return ""
    return f"{scheduler}: without TLS whoever reaches this scheduler can run code on its workers: use tls:// and keys"


@contextmanager
def cluster(scheduler: str | None, workers: int) -> Iterator[Any]:
    """A `distributed.Client` of a scheduler's address, or of `workers` processes on this machine, one thread each.

    Whoever reaches a scheduler can run code on its workers. Those made here speak TLS, with keys that are made for this
    run and that nobody else has; at an address tls:// the keys are those of dask's configuration.
    Raises BusFault (exit status 3) if no scheduler answers at the address.
    """
    import dask
    from distributed import Client, LocalCluster
    from distributed.security import Security

    logging.getLogger("distributed").setLevel(logging.ERROR)
    dask.config.set({"distributed.scheduler.allowed-failures": KILLED})
    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=CONNECT_SECONDS)
        except (OSError, ValueError) as error:
            raise BusFault(f"no dask scheduler at {scheduler}: {error}: start one, or omit --scheduler") from None
        with client:
            yield client
        return
    local = LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        dashboard_address=None,
        host="tls://127.0.0.1",
        security=Security.temporary(),
        silence_logs=logging.ERROR,
    )
    with local, Client(local) as client:
        yield client
