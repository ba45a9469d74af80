"""Where the runs of a campaign are flown: in processes of this machine, or on a Dask cluster elsewhere."""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from typing import Any, Final, TypeVar

from groundstation.campaign_file import Job

R = TypeVar("R")
#: Jobs that wait at each worker beside the one it flies.
_AHEAD: Final = 2
_PATIENCE: Final = 30.0


class PoolError(Exception):
    """No worker can be had."""


class Pool:
    """Workers that fly jobs. Made by ``pool``."""

    def __init__(self, client: Any) -> None:
        self._client = client

    @property
    def workers(self) -> int:
        """How many there are now."""
        return len(self._client.scheduler_info(n_workers=-1)["workers"])

    def each(
        self, function: Callable[[Job], R], jobs: Iterable[Job], lost: Callable[[Job, str], R]
    ) -> Generator[R, None, None]:
        """What ``function`` makes of each job, as it is done; ``lost`` makes it of a job whose process has died.

        Only a few jobs are under way, and nothing is kept of those that are done.
        """
        from distributed import as_completed

        waiting = iter(jobs)
        under_way: dict[str, tuple[Any, Job]] = {}
        ahead = max(1, _AHEAD * self.workers)

        def submit(job: Job) -> Any:
            future = self._client.submit(function, job, pure=False, retries=0)
            under_way[future.key] = (future, job)
            return future

        done = as_completed([submit(job) for job in islice(waiting, ahead)], loop=self._client.loop)
        try:
            for future in done:
                _, job = under_way.pop(future.key)
                error = future.exception()
                yield future.result() if error is None else lost(job, f"{type(error).__name__}: {error}")
                future.release()
                for following in islice(waiting, 1):
                    done.add(submit(following))
        finally:
            self._client.cancel([future for future, _ in under_way.values()])


@contextmanager
def pool(workers: int, scheduler: str | None) -> Iterator[Pool]:
    """Workers for a while: ``workers`` processes of this machine on loopback, or those of a scheduler elsewhere.

    Raises PoolError when the scheduler does not answer.
    """
    import dask
    from distributed import Client, LocalCluster

    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    with dask.config.set({"distributed.comm.timeouts.connect": _PATIENCE}):
        if scheduler is not None:
            try:
                client = Client(scheduler, timeout=_PATIENCE, set_as_default=False)
            except (OSError, TimeoutError, ValueError) as error:
                raise PoolError(f"--scheduler {scheduler}: no Dask scheduler answers there: {error}") from error
            with client:
                if not client.scheduler_info(n_workers=-1)["workers"]:
                    raise PoolError(
                        f"--scheduler {scheduler}: has no workers; start some with: dask worker {scheduler}"
                    )
                yield Pool(client)
            return
        with _deaf_children():
            cluster = LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                host="127.0.0.1",
                dashboard_address="127.0.0.1:0",
                silence_logs=logging.CRITICAL,
            )
        with cluster, Client(cluster, set_as_default=False) as client:
            yield Pool(client)


@contextmanager
def _deaf_children() -> Iterator[None]:
    """Processes begun here do not hear the interrupt that a terminal sends to all: they are ended by their parent."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    former = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, former)
