"""How far from its path an imported drive was compared with photographs."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from alpasim_plugin.core.types import MeasuredRange
from scenarios.measured import measured_range
from tests.renderers.recorded_drive import recorded_drive


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return recorded_drive(tmp_path_factory.mktemp("drive"))


def range_of(drive, recording):
    log = SimpleNamespace(model=drive.model, recording=recording, ego_log=drive.ego_log)
    return measured_range(log, drive.cameras)


def test_a_camera_that_no_fit_saw_compares_at_its_distance_from_the_path(drive):
    assert range_of(drive, drive.recording) == MeasuredRange(0.5, 0.0, 10)


def test_photographs_that_were_held_out_compare_on_the_path_alone(drive):
    front = tuple(photograph for photograph in drive.recording if photograph.camera == "front")
    assert range_of(drive, front) == MeasuredRange(0.0, 0.0, 1)


def test_a_camera_that_looks_aside_compares_turned(drive):
    quarter = np.eye(4)
    quarter[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    turned = tuple(
        replace(photograph, T_world_camera=photograph.T_world_camera @ quarter)
        if photograph.camera == "right"
        else photograph
        for photograph in drive.recording
    )
    measured = range_of(drive, turned)
    assert measured.turn_deg == pytest.approx(90.0)
    assert measured.lateral_m == 0.0, "it compares no view ahead from beside the path"


def test_nothing_was_compared_without_photographs_that_no_fit_saw(drive):
    fitted = tuple(photograph for photograph in drive.recording if photograph.use == "fitted")
    assert range_of(drive, fitted).n_photographs == 0
    assert range_of(drive, ()).n_photographs == 0


def test_a_built_scene_has_no_range(drive):
    assert range_of(replace(drive, model=None), ()) is None


def test_cameras_of_a_rig_do_not_join_into_one_path(drive):
    # A second fitted camera at the other end of the street: no way leads from one to the other.
    moved = np.eye(4)
    moved[:3, 3] = [0.0, 30.0, 0.0]
    other = tuple(
        replace(photograph, camera="other", T_world_camera=moved @ photograph.T_world_camera)
        for photograph in drive.recording
        if photograph.use == "fitted"
    )
    assert range_of(drive, (*drive.recording, *other)).lateral_m == 0.5
