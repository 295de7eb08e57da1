"""A file of a run that cannot be read is named."""

from __future__ import annotations

from pathlib import Path

import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.log.run_folder.reader import read_json


@pytest.mark.parametrize(("content", "found"), [(None, "no such file"), ("{", "broken JSON")])
def test_unreadable_json_is_named(tmp_path: Path, content: str | None, found: str) -> None:
    path = tmp_path / "run.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(InputError, match=found):
        read_json(path)
