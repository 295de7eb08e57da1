"""Work on several processes whose results are all needed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.runs.local_executor import J, Lost, R, run_jobs


def map_jobs(work: Callable[[J], R], jobs: Sequence[J], workers: int) -> Iterator[tuple[J, R]]:
    """Yield every job with its result, as they finish; see `run_jobs`.

    Raises:
        InfrastructureError: The worker of a job died twice.
        The first exception of ``work``.
    """
    for job, got in run_jobs(work, jobs, workers):
        if isinstance(got, Lost):
            raise InfrastructureError(f"{job}: {got.reason}", got.hint)
        yield job, got
