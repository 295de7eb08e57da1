"""``simrun bench roofline``: lower bounds of a fixer's time per block on a device, and measured
times.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Annotated, Any, Literal

import numpy as np
import typer

from alpasim_plugin.block_fixers.settings import OneFixerSettings
from alpasim_plugin.cli.options import fixer_overrides
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.lab.bench.block_speed import BlockTimes, measure_blocks
from alpasim_plugin.lab.bench.roofline import TEXT_TOKENS, BlockWork, Device, block_work, device_of
from alpasim_plugin.lab.cli.image_sizes import parse_size

SIDE = 16  # pixels of a token

EPILOG = """
Examples:

- `simrun bench roofline --fixer onefixer-2b --size 960x544 --set fixer.window=12 --on h200`

- `simrun bench roofline --fixer onefixer-2b --size 960x544 --on h200 --measure --device cuda`

- `simrun bench roofline --fixer onefixer-dit-tiny --size 256x144 --on 3:0.15:20:8 --measure --device cpu`
"""


def roofline(
    name: Annotated[
        str, typer.Option("--fixer", help="A fixer of the onefixer family, or NAME@STEPS.")
    ] = "onefixer-2b",
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", help="Override a setting: fixer.key=value. Repeatable."),
    ] = None,
    size: Annotated[
        str, typer.Option("--size", help="Width x height, multiples of 16.")
    ] = "960x544",
    views: Annotated[int, typer.Option("--views", min=1, help="Cameras in the batch.")] = 1,
    text_tokens: Annotated[
        int, typer.Option("--text-tokens", min=1, help="Length of the prompt.")
    ] = TEXT_TOKENS,
    on: Annotated[
        str,
        typer.Option(
            "--on",
            help="h200, h100, a100, rtx4090, or half:float32:bandwidth:memory in TFLOP/s, GB/s, GB.",
        ),
    ] = "h200",
    measure: Annotated[
        bool, typer.Option("--measure", help="Also run it, with random weights, on --device.")
    ] = False,
    device: Annotated[
        Literal["cpu", "cuda"], typer.Option("--device", help="Where to measure.")
    ] = "cuda",
    blocks: Annotated[int, typer.Option("--blocks", min=1, help="Steady blocks to time.")] = 30,
    attention: Annotated[
        Literal["auto", "flash", "cudnn", "efficient", "math"],
        typer.Option("--attention", help="Attention kernel to measure with."),
    ] = "auto",
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON document on stdout.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Count a fixer's work per block without running it, and print lower bounds of its time on a
    device.

    The compute floor counts products and convolutions alone; the eager floor adds up all
    operations, each at its own arithmetic or memory traffic. Needs neither weights nor a GPU,
    except to measure.
    """
    del debug
    settings = fixer_settings(name, fixer_overrides(overrides or []))
    if not isinstance(settings, OneFixerSettings):
        raise InputError(
            f"--fixer {name}: it has no networks to count",
            "take one of the onefixer family",
        )
    width, height = parse_size(size, multiple=SIDE)
    limits = device_of(on)
    work = block_work(settings, height, width, views, text_tokens)
    times = (
        measure_blocks(settings, work, height, width, device, blocks, text_tokens, attention)
        if measure
        else None
    )
    if as_json:
        print(json.dumps(as_document(settings, work, limits, times)))
        return
    print(
        f"{settings.name}, {width}x{height}, {views} view(s), {work.frames} frames a block; {limits.name} ({limits.source})\n"
    )
    print("\n".join(table(work, limits, times)))
    print(
        f"\nmemory: weights {work.weight_bytes / 1e9:.2f} GB, cache {work.cache_bytes / 1e9:.2f} GB, "
        f"codec states {work.state_bytes / 1e9:.2f} GB; at least {work.memory_bytes / 1e9:.1f} GB to run"
    )
    if times is not None:
        peak = "" if times.peak_mb is None else f", peak {times.peak_mb / 1e3:.2f} GB"
        print(
            f"measured on {times.device}: first block {times.first:.1f} ms{peak}; calls {times.calls or 'not recorded'}"
        )


def table(work: BlockWork, limits: Device, times: BlockTimes | None = None) -> list[str]:
    """Return lines of a Markdown table: a row per stage, milliseconds per block."""
    head = [
        "stage",
        "TFLOP",
        "GB moved",
        "operations",
        "compute floor ms",
        "eager floor ms",
        *(["measured ms p50 / p95"] if times else []),
    ]
    lines = ["| " + " | ".join(head) + " |", "|---" + "|---:" * (len(head) - 1) + "|"]
    for row in work.rows(limits):
        cells = [
            row.stage,
            f"{row.tflop:.3g}",
            f"{row.gigabytes:.3g}",
            str(row.operations),
            f"{row.compute_ms:.3g}",
            f"{row.eager_ms:.3g}",
        ]
        if times:
            measured = times.all_in if row.stage == "all" else times.stages.get(row.stage)
            cells.append(
                "-"
                if measured is None
                else " / ".join(f"{np.percentile(measured, p):.1f}" for p in (50, 95))
            )
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def as_document(
    settings: OneFixerSettings, work: BlockWork, limits: Device, times: BlockTimes | None
) -> dict[str, Any]:
    """Return everything for JSON."""
    return {
        "fixer": settings.model_dump(mode="json"),
        "device": asdict(limits),
        "frames": work.frames,
        "views": work.views,
        "rows": [asdict(row) for row in work.rows(limits)],
        "bytes": {
            "weights": work.weight_bytes,
            "cache": work.cache_bytes,
            "states": work.state_bytes,
            "needed": work.memory_bytes,
        },
        "measured": None if times is None else asdict(times),
    }
