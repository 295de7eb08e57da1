"""Photographs that are held out shape nothing of an import: neither poses nor ground, points,
model or exposures. What is found by photographs of one camera holds for its rig.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from alpasim_plugin.core.geometry import interpolate, inverse, se2, trajectory_from_poses
from alpasim_plugin.drives import build, quality
from alpasim_plugin.drives.build import import_drive
from alpasim_plugin.drives.held_out import EVERY
from alpasim_plugin.drives.placing import place
from alpasim_plugin.drives.points import moved_rig, with_corrected_poses
from alpasim_plugin.drives.source import Points, SourceDrive
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.fit.drive import fit_drive
from alpasim_plugin.gaussians.fit.lens import Lens
from alpasim_plugin.gaussians.fit.photographs import PosedPhotograph
from alpasim_plugin.gaussians.fit.recipe import SplatRecipe
from alpasim_plugin.gaussians.fit.reconstruction import Reconstruction
from alpasim_plugin.gaussians.fit.start import cloud_from_points
from alpasim_plugin.gaussians.fit.views import PosedView
from alpasim_plugin.gaussians.scene import sky
from scenarios.load import load_scenario
from tests.drives.street import HEIGHT, STEP_M, WIDTH, K, Street, write_kitti

SHORT = replace(SplatRecipe.street(), steps=2, points=1500, densify_every=0, save_every=2)
# What a scenario drives in and is measured by; the photographs themselves differ.
SHAPED = ("model/background.ply", "model/sky.png", "points.ply", "transforms.json")


@pytest.fixture
def short_fit(monkeypatch):
    """Fit with two updates."""
    monkeypatch.setattr(build, "fit_drive", partial(fit_drive, recipe=SHORT, threads=1))


def held_out_files(folder):
    scenario = load_scenario(folder / "scenario.yaml")
    return [one.path.rsplit("/", 1)[1] for one in scenario.recording if one.use == "held-out"]


@pytest.mark.slow
def test_other_pixels_in_a_held_out_photograph_leave_the_import_equal_bit_for_bit(
    short_fit, tmp_path
):
    source = write_kitti(tmp_path / "street", stereo=False)
    import_drive(source, tmp_path / "before")
    names = held_out_files(tmp_path / "before")
    assert len(names) == 3
    for name in names:
        photograph = cv2.imread(str(source / "image_l" / name))
        cv2.imwrite(str(source / "image_l" / name), np.ascontiguousarray(photograph[::-1, ::-1]))
    import_drive(source, tmp_path / "after")
    assert held_out_files(tmp_path / "after") == names
    for file in SHAPED:
        before = (tmp_path / "before" / file).read_bytes()
        assert (tmp_path / "after" / file).read_bytes() == before, file


class PastPixelsError(Exception):
    """Ends an import before its fit."""


def what_a_fit_reads(drive, monkeypatch, folder):
    """Return the names of the photographs that the fit of a drive is given, and the bytes of all
    that it reads of them.
    """
    parts = []
    names = []

    def read(views, points, *, kept, **rest):
        names.extend(view.name for view in views)
        for view in views:
            parts.extend((view.rgb, view.camera.K, view.camera.T_camera_world))
        parts.extend((points.means, points.sh, points.scales))
        for camera in kept.values():  # cameras alone, without pixels
            parts.extend((camera.K, camera.T_camera_world))
        raise PastPixelsError

    monkeypatch.setattr(build, "fit_drive", read)
    task = build._Import(
        drive=drive,
        folder=folder,
        out=folder / "out",
        work=folder / "work",
        key="",
        camera_height_m=None,
        map_file=None,
        recipe=SplatRecipe.street(),
        device="cpu",
    )
    with pytest.raises(PastPixelsError):
        build._built(task, lambda *stage: None)
    return names, b"".join(np.ascontiguousarray(part).tobytes() for part in parts)


def street_drive(count=9, unlike=(), shaken_m=0.03):
    """Return a drive of a front camera along the street, and of a side camera that takes its
    photographs 12 ms later and whose pixels nobody looks at; poses are off, those of a rig together.

    Args:
        count: Photographs of the front camera.
        unlike: Numbers of photographs that show something else.
        shaken_m: How far the rig's poses are off.
    """
    street = Street(bow_m=0.0)
    lens = Lens(WIDTH, HEIGHT, K)
    blank = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
    looks_left = se2(0, 0, np.pi / 2)[:3, :3]
    photographs = []
    for camera, late_us in (("front", 0), ("left", 12_000)):
        for i in range(count):
            t_us = 60_000 * i + late_us
            T = street.pose(STEP_M * t_us / 60_000)
            image = blank
            if camera == "front":
                image = street.photograph(T)[::-1, ::-1] if i in unlike else street.photograph(T)
            else:
                T[:3, :3] = looks_left @ T[:3, :3]
            T[1:3, 3] += shaken_m * np.array([np.sin(t_us * 1e-5), np.cos(t_us * 8e-6)])
            data = memoryview(cv2.imencode(".png", np.ascontiguousarray(image))[1].tobytes())
            file = Path(f"{camera}/{i:06d}.png")
            photographs.append(PosedPhotograph(file, lens, T, str(file), t_us, camera, {}, data))
    return SourceDrive("transforms", "rig", tuple(photographs), "front", ("left",), "metres")


def test_other_pixels_in_a_held_out_photograph_change_nothing_that_a_fit_reads(
    monkeypatch, tmp_path
):
    names, before = what_a_fit_reads(street_drive(), monkeypatch, tmp_path / "before")
    assert names == [f"front-{i:06d}" for i in range(9) if i != 4]
    _, after = what_a_fit_reads(street_drive(unlike=[4]), monkeypatch, tmp_path / "after")
    assert after == before


def test_poses_that_photographs_correct_stay_those_of_one_rig():
    drive = street_drive()
    moved = with_corrected_poses(drive, EVERY)
    assert "poses were corrected" in str(moved.notes)
    front_us = [one.t_us for one in moved.of("front")]
    rig = trajectory_from_poses(front_us, [one.T_world_camera for one in moved.of("front")])
    places = np.array(
        [
            (inverse(interpolate(rig, one.t_us)) @ one.T_world_camera)[:3, 3]
            for one in moved.of("left")[:-1]
        ]
    )
    shifts = [
        np.linalg.norm(new.T_world_camera[:3, 3] - old.T_world_camera[:3, 3])
        for old, new in zip(drive.of("left"), moved.of("left"), strict=True)
    ]
    assert np.max(shifts) > 0.02
    assert np.linalg.norm(places, axis=1).max() < 0.005


def rig_drive(front_us, side_us, side_m=(0.4, 0.6, 0.0)):
    """A rig that drives along x at 10 m/s, its side camera looking to the left."""
    lens = Lens(320, 128, K)
    photographs = []
    for camera, times, turn, mount in (
        ("front", front_us, np.eye(3), (0.0, 0.0, 0.0)),
        ("left", side_us, se2(0, 0, np.pi / 2)[:3, :3], side_m),
    ):
        for t_us in times:
            T = Street(bow_m=0.0).pose(10.0 * t_us * 1e-6)
            T[:3, :3] = turn @ T[:3, :3]
            T[:3, 3] += mount
            photographs.append(
                PosedPhotograph(Path(f"{camera}/{t_us}.png"), lens, T, "here", t_us, camera, {})
            )
    return SourceDrive("transforms", "rig", tuple(photographs), "front", (), "metres")


def test_a_correction_moves_every_camera_of_the_rig_as_it_was_at_its_time():
    front_us = np.arange(10) * 100_000
    drive = rig_drive(front_us, front_us[:-1] + 12_000)
    wave_m = 0.3 * np.sin(front_us * 4e-6)
    corrections = np.tile(np.eye(4), (10, 1, 1))
    corrections[:, 0, 3] = wave_m  # to the camera's right
    corrections[:, :3, :3] = [cv2.Rodrigues(np.array([0, 0.02 * m, 0]))[0] for m in wave_m]
    moved = moved_rig(drive, trajectory_from_poses(front_us, corrections))
    for i, (old, new) in enumerate(zip(drive.of("front"), moved.of("front"), strict=True)):
        assert np.allclose(old.T_world_camera @ corrections[i], new.T_world_camera, atol=1e-9)
    rig = trajectory_from_poses(front_us, [one.T_world_camera for one in moved.of("front")])
    mounts = [inverse(interpolate(rig, one.t_us)) @ one.T_world_camera for one in moved.of("left")]
    # Between two photographs the turn about the front camera is interpolated: millimetres.
    assert np.ptp(np.array(mounts)[:, :3, 3], axis=0).max() < 0.005
    shifts = [
        np.linalg.norm(new.T_world_camera[:3, 3] - old.T_world_camera[:3, 3])
        for old, new in zip(drive.of("left"), moved.of("left"), strict=True)
    ]
    expected = np.abs(np.interp(front_us[:-1] + 12_000, front_us, wave_m))
    assert np.allclose(shifts, expected, atol=0.01)


def test_a_photograph_before_the_first_of_the_front_camera_moves_as_that_one():
    front_us = 50_000 + np.arange(8) * 100_000
    drive = rig_drive(front_us, front_us - 50_000)
    corrections = np.tile(np.eye(4), (8, 1, 1))
    corrections[:, 0, 3] = 0.2
    moved = moved_rig(drive, trajectory_from_poses(front_us, corrections))
    first = moved.of("left")[0].T_world_camera - drive.of("left")[0].T_world_camera
    assert first[:3, 3] == pytest.approx([0.0, -0.2, 0.0])
    assert np.allclose(first[:3, :3], 0)


def test_a_camera_whose_place_on_the_rig_is_not_known_is_said():
    front_us = np.arange(8) * 100_000
    none = Points(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    beside = place(rig_drive(front_us, front_us + 12_000), none)
    assert "left" in beside.mounts
    assert "camera left" not in str(beside.notes)
    later = place(rig_drive(front_us, front_us + 900_000), none)
    assert "left" not in later.mounts
    assert "camera left took no photograph while front did" in str(later.notes)


def test_a_held_out_photograph_is_compared_in_the_exposure_of_its_own_camera(monkeypatch):
    """The left camera stands beside the front one, and meters half as bright."""
    compared = {}
    monkeypatch.setattr(
        quality, "_compared", lambda graph, view, gain: compared.setdefault(view.name, gain)
    )
    monkeypatch.setattr(quality, "_covered", lambda graph, view, lateral_m: 0.0)
    seen = {}
    exposures = {}
    for camera, shift_m, gain in (("front", 0.0, 1.0), ("left", 0.1, 0.5)):
        for i in range(9):
            pose = Street().pose(0.6 * i, shift_m)
            seen[camera, i] = PosedView(
                PinholeCamera.from_pose(32, 16, K, pose),
                np.zeros((16, 32, 3), dtype=np.uint8),
                f"{camera}-{i:06d}",
            )
            exposures[seen[camera, i].name] = (gain,) * 3
    held = [seen[camera, 4] for camera in ("front", "left")]
    fitted = [view for (_, i), view in seen.items() if i != 4]
    empty = Reconstruction(
        cloud_from_points(np.zeros((3, 3)), np.zeros((3, 3))),
        {},
        sky.Sky(np.zeros((sky.HEIGHT, sky.WIDTH, 3), dtype=np.float32)),
    )
    views = {"fitted": fitted, "held-out": held, "never-fitted": []}
    quality.measure(empty, views, exposures, lambda stage, done, total: None)
    assert np.allclose(compared["front-000004"], 1.0)
    assert np.allclose(compared["left-000004"], 0.5)


def test_coverage_is_measured_beside_the_path_whatever_way_a_camera_looks(monkeypatch):
    """The left camera's own left is behind it on the path."""
    offsets = {}
    monkeypatch.setattr(
        quality,
        "_covered",
        lambda graph, view, offset: offsets.setdefault((view.camera_name, *offset), 1.0),
    )
    views = []
    for camera, turn in (("front", 0.0), ("left", np.pi / 2)):
        for i in range(4):
            pose = Street(bow_m=0.0).pose(2.0 * i)
            pose[:3, :3] = se2(0, 0, turn)[:3, :3] @ pose[:3, :3]
            image = np.zeros((16, 32, 3), dtype=np.uint8)
            views.append(
                PosedView(PinholeCamera.from_pose(32, 16, K, pose), image, f"{camera}-{i}")
            )
    empty = Reconstruction(
        cloud_from_points(np.zeros((3, 3)), np.zeros((3, 3))),
        {},
        sky.Sky(np.zeros((sky.HEIGHT, sky.WIDTH, 3), dtype=np.float32)),
    )
    quality.measure(
        empty, {"fitted": views, "held-out": [], "never-fitted": []}, {}, lambda *stage: None
    )
    assert {key[0] for key in offsets} == {"front", "left"}
    assert all(key[1:] == pytest.approx((0.0, key[2], 0.0), abs=1e-9) for key in offsets)
    assert {round(key[2], 6) for key in offsets} == {0.0, 1.0, -1.0, 2.0, -2.0}
