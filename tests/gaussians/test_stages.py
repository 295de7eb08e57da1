"""Threads of the rasteriser: kept from call to call, and started again by a forked process."""

import multiprocessing
import threading
from pathlib import Path

import pytest

from alpasim_plugin.gaussians.raster.stages import map_on_threads, run_on_threads


def test_calls_share_their_threads() -> None:
    first = _names_of_two_threads()
    assert len(first) == 2
    assert _names_of_two_threads() == first


def test_forked_process_starts_threads_of_its_own(tmp_path: Path) -> None:
    _names_of_two_threads()
    child = multiprocessing.get_context("fork").Process(
        target=_write_names, args=(tmp_path / "out",)
    )
    child.start()
    child.join(timeout=60)
    child.kill()  # where it waits for threads that were not forked
    assert child.exitcode == 0
    assert len((tmp_path / "out").read_text().split()) == 2


def test_thread_of_a_call_may_make_another_call() -> None:
    squares = map_on_threads(2, lambda i: map_on_threads(2, lambda j: i * j, [i, 0]), [1, 2, 3])
    assert squares == [[1, 0], [4, 0], [9, 0]]


def test_error_of_a_thread_is_raised_when_all_have_ended() -> None:
    ended = []

    def work(number: int) -> None:
        if number == 0:
            raise ValueError("the first item")
        ended.append(number)

    with pytest.raises(ValueError, match="the first item"):
        map_on_threads(2, work, [0, 1, 2])
    assert sorted(ended) == [1, 2]


def _names_of_two_threads() -> set[str]:
    """Return the names of the threads of a call, each of which waits for the other."""
    names: set[str] = set()
    both = threading.Barrier(2)

    def work() -> None:
        both.wait(timeout=30)
        names.add(threading.current_thread().name)

    run_on_threads(2, work)
    return names


def _write_names(path: Path) -> None:
    path.write_text(" ".join(_names_of_two_threads()))
