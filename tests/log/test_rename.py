"""Copies of logs: byte-equal where nothing is renamed, and otherwise only what is asked for."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.log import read_asl
from alpasim_plugin.log.asl import copy_log
from alpasim_plugin.log.schema import session_uuid


@pytest.fixture(scope="module")
def logs(shared_data):
    return sorted((shared_data / "alpasim-golden" / "rollouts").glob("*/*/rollout.asl"))


def test_alpasims_own_logs_are_copied_byte_by_byte(logs, tmp_path):
    whole = [log for log in logs if log.parent == min(log.parent.parent.iterdir())][
        ::4
    ]  # complete logs, of a few scenes
    assert len(whole) > 4
    for log in whole:
        copy_log(log, tmp_path / "copy.asl")
        assert (tmp_path / "copy.asl").read_bytes() == log.read_bytes(), log


def test_a_renamed_log_differs_in_its_names_alone(logs, tmp_path):
    source = logs[0]
    target = tmp_path / "copy.asl"
    old = source.parent.name
    camera = "camera_front_wide_120fov"
    new = session_uuid(7, "x")
    copy_log(source, target, new, cameras={camera: "other_camera_of_24_bytes"})
    assert old.encode() not in target.read_bytes()
    assert camera.encode() not in target.read_bytes()
    log = read_asl(target)
    assert (log.session_uuid, {image.camera for image in log.images}) == (
        new,
        {"other_camera_of_24_bytes"},
    )
    copy_log(target, tmp_path / "back.asl", old, cameras={"other_camera_of_24_bytes": camera})
    assert (tmp_path / "back.asl").read_bytes() == source.read_bytes()


def test_a_cut_log_is_no_source(logs, tmp_path):
    (tmp_path / "cut.asl").write_bytes(logs[0].read_bytes()[:5000])
    with pytest.raises(InputError, match="last entry cut"):
        copy_log(tmp_path / "cut.asl", tmp_path / "copy.asl", "x")
    assert not (tmp_path / "copy.asl").exists()


@given(
    st.lists(st.integers(0, 2**63 - 1), min_size=2, max_size=8, unique=True), st.text(), st.text()
)
def test_session_ids_sort_as_their_seeds(seeds, one, other):
    ids = {seed: session_uuid(seed, one if i % 2 else other) for i, seed in enumerate(seeds)}
    assert sorted(seeds) == sorted(seeds, key=ids.__getitem__)
    assert all(len(name) == 36 and name[14] == "8" and name[19] in "89ab" for name in ids.values())
