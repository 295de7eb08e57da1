"""Keep per-frame facts that the ASL format has no field for (mean opacity, stage times) in a file beside the log."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.io.atomic import atomic_file
from alpasim_plugin.io.reading import read_json_lines

Fact = str | int | float | bool | None


def write_facts(path: Path | str, rows: Iterable[Mapping[str, Fact]]) -> None:
    """Write one JSON object a line, such as ``{"t_us": 100000, "camera": "front", "alpha_mean": 0.98, "render_ms": 12.1}``.

    The file appears under its name only once complete. NaN and infinities are refused: a fact that is missing is left out.

    Raises:
        InputError: A value that JSON cannot hold.
        InfrastructureError: The disk refuses.
    """
    path = Path(path)
    try:
        with atomic_file(path, "writing facts of a rollout") as partial, partial.open("w", encoding="utf-8") as stream:
            stream.writelines(json.dumps(dict(row), allow_nan=False) + "\n" for row in rows)
    except (TypeError, ValueError) as error:
        raise InputError("writing facts of a rollout", str(path), str(error), "give finite numbers, text or booleans") from error


def read_facts(path: Path | str) -> list[dict[str, Fact]]:
    """Read what `write_facts` wrote.

    Raises:
        InputError: Missing file, or a line that is no JSON object.
    """
    rows: list[dict[str, Fact]] = read_json_lines(path, "reading facts of a rollout", do_this="run the rollout again")
    return rows
