"""Statistics of a folder of training pairs, and a contact sheet."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from alpasim_plugin.core.atomic import write_text
from alpasim_plugin.core.image_metrics import psnr_db, ssim
from alpasim_plugin.core.types import U8
from alpasim_plugin.lab.training.pair_store import PairClip, PairSequence

EVERY = 5  # every 5th frame is measured, since consecutive frames are similar
PSNR_EDGES_DB = (0, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30, 100)
HOLE_BELOW = 128  # of 255: pixels with less opacity count as holes
ROWS, THUMB_WIDTH = 24, 192


@dataclass(frozen=True)
class SequenceFacts:
    """Statistics of one sequence; means over the measured frames.

    Attributes:
        split, name, family, degradation: From its folder and sequence.json; ``imported`` without an
            entry.
        frames: Frames that every channel has.
        moving_actors: Number of moving actors; None if unknown.
        psnr_db: Of rgb_input against rgb_gt, every measured frame.
        ssim: Structural similarity (`alpasim_plugin.core.image_metrics.ssim`).
        hole_share: Share of pixels with opacity below one half.
        luminance: Mean of rgb_gt, 0..1.
        map_share: Share of non-black pixels of the semantic map.
        travel_m: Length of the camera path; None where poses are unknown.
    """

    split: str
    name: str
    family: str
    degradation: str
    frames: int
    moving_actors: int | None
    psnr_db: tuple[float, ...]
    ssim: float
    hole_share: float
    luminance: float
    map_share: float
    travel_m: float | None


def measure_sequence(sequence: PairSequence, split: str) -> SequenceFacts:
    """Measure one sequence on every `EVERY`-th frame."""
    clip, info = sequence.clip, sequence.info
    index = range(0, len(clip), EVERY)
    kind = info.get("degradation") or {}
    return SequenceFacts(
        split,
        sequence.name,
        str(info.get("family", "imported")),
        str(kind.get("kind", "imported")) if isinstance(kind, Mapping) else str(kind),
        len(clip),
        info.get("moving_actors"),
        tuple(psnr_db(clip.rgb_input[i], clip.rgb_gt[i]) for i in index),
        _mean([ssim(clip.rgb_input[i], clip.rgb_gt[i]) for i in index]),
        _mean([float(np.mean(clip.opacity[i] < HOLE_BELOW)) for i in index]),
        _mean([float(np.mean(clip.rgb_gt[i])) / 255 for i in index]),
        _mean([float(np.mean(clip.sdmap[i].max(axis=-1) > 0)) for i in index]),
        _travel_m(clip),
    )


def _travel_m(clip: PairClip) -> float | None:
    places = np.asarray(clip.T_world_camera[:, :3, 3])
    return (
        float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
        if np.isfinite(places).all()
        else None
    )


def sheet(facts: Sequence[SequenceFacts]) -> dict[str, Any]:
    """Return statistics as JSON: over all sequences, by split, and of every sequence."""
    splits = sorted({f.split for f in facts})
    return {
        "measured_every": EVERY,
        "all": _group(facts),
        "splits": {split: _group([f for f in facts if f.split == split]) for split in splits},
        "sequences": [{**asdict(f), "psnr_db": round(_mean(f.psnr_db), 2)} for f in facts],
    }


def _group(facts: Sequence[SequenceFacts]) -> dict[str, Any]:
    values = np.concatenate([f.psnr_db for f in facts]) if facts else np.zeros(0)
    counts, _ = np.histogram(values, PSNR_EDGES_DB)
    out: dict[str, Any] = {
        "sequences": len(facts),
        "frames": sum(f.frames for f in facts),
        "with_moving_actors": sum(bool(f.moving_actors) for f in facts),
        "not_known_whether_actors_move": sum(f.moving_actors is None for f in facts),
        "families": dict(sorted(Counter(f.family for f in facts).items())),
        "degradations": dict(sorted(Counter(f.degradation for f in facts).items())),
        "psnr_db": {
            "mean": _mean(values),
            "p05": _at(values, 5),
            "p50": _at(values, 50),
            "p95": _at(values, 95),
        },
        "psnr_histogram": {"edges_db": list(PSNR_EDGES_DB), "frames": counts.tolist()},
        "psnr_db_by_degradation": {
            kind: _mean(np.concatenate([f.psnr_db for f in facts if f.degradation == kind]))
            for kind in sorted({f.degradation for f in facts})
        },
    }
    for name in ("ssim", "hole_share", "luminance", "map_share"):
        out[name] = _mean([getattr(f, name) for f in facts])
    known_m = [f.travel_m for f in facts if f.travel_m is not None]
    out["travel_m"] = _mean(known_m) if known_m else None
    return out


def markdown(document: Mapping[str, Any]) -> str:
    """Return the statistics as two Markdown tables: by split, and a histogram of the input's
    PSNR.
    """
    columns = {**document["splits"], "all": document["all"]}
    counted = ("sequences", "frames", "with_moving_actors", "not_known_whether_actors_move")
    rows = [
        [name.replace("_", " "), *(f"{c[name]:,}" for c in columns.values())] for name in counted
    ]
    for name in ("families", "degradations"):
        rows += [
            [name, *(", ".join(f"{k} {v}" for k, v in c[name].items()) for c in columns.values())]
        ]
    spreads = ["{p05:.1f}, {mean:.1f}, {p95:.1f}".format(**c["psnr_db"]) for c in columns.values()]
    rows.append(["PSNR of input, dB (5 %, mean, 95 %)", *spreads])
    by_kind = [
        ", ".join(f"{k} {v:.1f}" for k, v in c["psnr_db_by_degradation"].items())
        for c in columns.values()
    ]
    rows.append(["PSNR by degradation, dB", *by_kind])
    for name, title, form in (
        ("ssim", "SSIM of input", "{:.3f}"),
        ("hole_share", "pixels missing", "{:.2%}"),
        ("luminance", "mean luminance", "{:.2f}"),
        ("map_share", "pixels with map", "{:.1%}"),
        ("travel_m", "metres driven, mean", "{:.0f}"),
    ):
        rows.append(
            [title, *("-" if c[name] is None else form.format(c[name]) for c in columns.values())]
        )
    head = ["", *columns]
    table = [head, ["---"] * len(head), *rows]
    edges = document["all"]["psnr_histogram"]["edges_db"]
    bins = [f"{a} to {b}" for a, b in pairwise(edges)]
    spread = [["PSNR, dB", *columns], ["---"] * len(head)]
    spread += [
        [b, *(str(c["psnr_histogram"]["frames"][i]) for c in columns.values())]
        for i, b in enumerate(bins)
    ]
    text = ["\n".join("| " + " | ".join(row) + " |" for row in t) for t in (table, spread)]
    return f"{text[0]}\n\nMeasured frames (every {document['measured_every']}th) by the PSNR of the input:\n\n{text[1]}\n"


def contact_sheet(sequences: Sequence[PairSequence], rows: int = ROWS) -> U8:
    """Return an image ``(H, W, 3)``: one row per sequence, evenly chosen; input and clean frame at
    three times, opacity and map.
    """
    chosen = [
        sequences[i]
        for i in np.unique(
            np.linspace(0, len(sequences) - 1, min(rows, len(sequences))).round().astype(int)
        )
    ]
    lines = []
    for sequence in chosen:
        clip = sequence.clip
        tiles = [
            tile
            for i in (len(clip) // 10, len(clip) // 2, 9 * len(clip) // 10)
            for tile in (clip.rgb_input[i], clip.rgb_gt[i])
        ]
        middle = len(clip) // 2
        tiles += [np.repeat(clip.opacity[middle][..., None], 3, axis=2), clip.sdmap[middle]]
        lines.append(np.concatenate([_thumb(t) for t in tiles], axis=1))
    width = max(line.shape[1] for line in lines)
    return np.concatenate(
        [np.pad(line, ((0, 2), (0, width - line.shape[1]), (0, 0))) for line in lines]
    )


def write_sheet(out: Path, document: Mapping[str, Any], image: U8) -> None:
    """Write ``sheet.md`` and ``sheet.jpg`` into a folder."""
    out.mkdir(parents=True, exist_ok=True)
    write_text(out / "sheet.md", markdown(document))
    cv2.imwrite(str(out / "sheet.jpg"), image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])


def _thumb(image: U8) -> U8:
    height = round(image.shape[0] * THUMB_WIDTH / image.shape[1])
    return np.asarray(
        cv2.resize(
            np.ascontiguousarray(image), (THUMB_WIDTH, height), interpolation=cv2.INTER_AREA
        ),
        dtype=np.uint8,
    )


def _mean(values: Any) -> float:
    array = np.asarray(values, dtype=np.float64)
    return float(array.mean()) if array.size else float("nan")


def _at(values: Any, percent: float) -> float:
    array = np.asarray(values, dtype=np.float64)
    return float(np.percentile(array, percent)) if array.size else float("nan")
