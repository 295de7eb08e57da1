"""Files are whole or absent."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from alpasim_plugin.errors import InfrastructureError, InputError
from alpasim_plugin.runtime import store


def test_a_full_disk_leaves_the_old_file_and_no_litter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "summary.json"
    store.write_json(path, {"run": 1})

    def full(fd: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(store.os, "fsync", full)
    with pytest.raises(InfrastructureError, match="No space left on device") as caught:
        store.write_json(path, {"run": 2})
    assert "free disk space" in caught.value.do_this
    assert store.read_json(path) == {"run": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["summary.json"]


def test_nan_is_refused_in_json(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="JSON"):
        store.write_json(tmp_path / "a.json", {"x": float("nan")})


@pytest.mark.parametrize(("content", "found"), [(None, "no such file"), ("{", "not JSON")])
def test_unreadable_json_is_named(tmp_path: Path, content: str | None, found: str) -> None:
    path = tmp_path / "run.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(InputError, match=found):
        store.read_json(path)
