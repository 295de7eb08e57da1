"""Options that say where rollouts run and where they are kept, for every command that drives."""

from __future__ import annotations

from typing import Annotated

import typer

ExecutorText = Annotated[
    str, typer.Option("--executor", help="Where rollouts run: `local`, `ray`, `ray:HOST:PORT`, `slurm` or `slurm:PARTITION`.")
]
Cores = Annotated[int | None, typer.Option("--cores", min=1, help="Cores of each worker on a cluster; by default 1.")]
Gpus = Annotated[float | None, typer.Option("--gpus", min=0.0, help="Share of a GPU of each worker on a cluster.")]
MemoryGib = Annotated[float | None, typer.Option("--memory", min=0.001, help="Memory of each worker on a cluster, in GiB.")]
StoreUrl = Annotated[
    str | None, typer.Option("--store", metavar="URL", help="Also keep every rollout in a store: a folder, or `s3://BUCKET/PREFIX`.")
]
