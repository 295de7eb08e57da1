"""A file that is not the one that was written is noticed, and a copy of it is not taken for another
one.
"""

import os

from alpasim_plugin.log.run_folder.checksums import checksums_of, problem_of


def test_missing_cut_and_changed_files_are_told_apart(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"0123456789")
    facts = checksums_of(tmp_path, ["a", "absent"])
    assert list(facts) == ["a"]
    assert problem_of(path, facts["a"]) is None
    path.write_bytes(b"01234")
    assert problem_of(path, facts["a"]) == "5 bytes, written with 10"
    path.write_bytes(b"012345678x")
    os.utime(path, ns=(0, facts["a"]["mtime_ns"] + 10**9))
    assert problem_of(path, facts["a"]) == "not the content that was written"
    path.unlink()
    assert problem_of(path, facts["a"]) == "missing"
    path.mkdir()
    assert problem_of(path, facts["a"]) == "not a file"


def test_content_that_rots_under_the_same_size_and_time_is_found_when_everything_is_read(
    tmp_path,
):
    path = tmp_path / "a"
    path.write_bytes(b"0123456789")
    facts = checksums_of(tmp_path, ["a"])["a"]
    path.write_bytes(b"x123456789")
    os.utime(path, ns=(0, facts["mtime_ns"]))
    assert problem_of(path, facts) is None
    assert problem_of(path, facts, full=True) == "not the content that was written"
