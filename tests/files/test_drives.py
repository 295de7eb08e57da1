"""Recorded drives as other tools write them: order, rows by name, lenses, models and frames.

Every file is made here; photographs are left out where they do not matter.
"""

import json
import re
import struct

import cv2
import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import quat_from_matrix, se2
from alpasim_plugin.drives.opening import read_source
from alpasim_plugin.drives.placing import check_motion, place
from alpasim_plugin.drives.quality import _page
from alpasim_plugin.drives.source import Points, checked
from alpasim_plugin.drives.splat import _in_frame
from alpasim_plugin.gaussians.cloud import GaussianCloud, placed_cloud
from alpasim_plugin.gaussians.files.ply import write_points
from alpasim_plugin.gaussians.fit.quality import Comparison
from scenarios.sources import import_advice
from tests.drives.street import FOCAL, HEIGHT, WIDTH, Street, edited

STEP_M = 1.2
LENS = {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "cx": 160.0, "cy": 54.0}


def poses(count):
    return [Street().pose(STEP_M * i) for i in range(count)]


def transforms(folder, names, order=None, **keys):
    """Write a ``transforms.json`` whose photograph i is taken i steps along the street."""
    folder.mkdir(parents=True, exist_ok=True)
    frames = [
        {"file_path": f"images/{name}", "transform_matrix": pose.tolist()}
        for name, pose in zip(names, poses(len(names)), strict=True)
    ]
    listed = [frames[i] for i in order or range(len(frames))]
    document = {"axes": "opencv", **LENS, "frames": listed, **keys}
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder


def colmap(model, names, points=True, camera="", places=None):
    model.mkdir(parents=True)
    lens = camera or f"PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} 160 54"
    (model / "cameras.txt").write_text(f"# cameras\n7 {lens}\n")
    rows = []
    for i, (name, pose) in enumerate(zip(names, places or poses(len(names)), strict=True)):
        back = np.linalg.inv(pose)
        numbers = [*quat_from_matrix(back[:3, :3]), *back[:3, 3]]
        rows.append(f"{i + 1} {' '.join(map(repr, map(float, numbers)))} 7 {name}")
        rows += ["10 20 -1 30 40 5" if i % 2 else ""] if points else []
    (model / "images.txt").write_text("# images\n" + "\n".join(rows) + "\n")
    (model / "points3D.txt").write_text("1 1.0 0.0 0.0 90 90 90 0.5 1 0\n")


def kitti(folder, calib, times=None):
    (folder / "image_2").mkdir(parents=True)
    for i in range(8):
        cv2.imwrite(
            str(folder / "image_2" / f"{i}.png"), np.full((HEIGHT, WIDTH, 3), i, dtype=np.uint8)
        )
    rows = [" ".join(f"{v:.9e}" for v in pose[:3].ravel()) for pose in poses(8)]
    (folder / "poses.txt").write_text("\n".join(rows))
    (folder / "calib.txt").write_text(calib)
    if times is not None:
        (folder / "times.txt").write_text(times)
    return folder


def row(name, focal):
    return f"{name}: {focal} 0 160 0 0 {focal} 54 0 0 0 1 0\n"


def along(drive):
    return [round(float(x), 3) for x in drive.path[:, 0]]


STRAIGHT = [round(STEP_M * i, 3) for i in range(13)]
NAMES = [f"{i}.png" for i in range(13)]


@pytest.mark.parametrize(
    ("names", "order"),
    [
        ([f"{i}.jpg" for i in range(1, 14)], None),  # sorted as text: 1, 10, 11, 12, 13, 2
        ([f"{i}.jpg" for i in range(1, 14)], [0, 9, 10, 11, 12, *range(1, 9)]),
        ([f"{i}.jpg" for i in reversed(range(13))], None),  # named backwards: the list counts
        ([f"{(7 * i) % 13:x}{i}.jpg" for i in range(13)], None),  # names without an order
        ([f"IMG_{i}.JPG" for i in range(95, 108)], None),
    ],
)
def test_photographs_without_times_are_taken_along_the_path(tmp_path, names, order):
    drive = read_source(transforms(tmp_path / "a", names, order, unit="m"), need_files=False)
    assert along(drive) == STRAIGHT
    assert "no times" in str(drive.notes)


def test_a_colmap_model_is_read_in_natural_order_with_any_line_of_points(tmp_path):
    names = [f"my photo  {i}.png" for i in range(1, 14)]
    for points in (True, False):
        colmap(tmp_path / f"{points}/sparse/0", names, points)
        drive = read_source(tmp_path / str(points), need_files=False)
        assert along(drive) == STRAIGHT
        assert drive.photographs[2].file.name == "my photo  3.png"


def test_the_largest_of_several_colmap_models_is_read_and_said(tmp_path):
    colmap(tmp_path / "sparse/0", ["a.png", "b.png"])
    colmap(tmp_path / "sparse/10", NAMES)
    drive = read_source(tmp_path, need_files=False)
    assert len(drive.photographs) == 13
    assert any("2 models" in note and "sparse/10" in note for note in drive.notes)


@pytest.mark.parametrize("name", ["FOV", "THIN_PRISM_FISHEYE", "SIMPLE_DIVISION", "NEWEST"])
def test_a_lens_of_colmap_that_is_not_read_is_named(tmp_path, name):
    colmap(tmp_path / "sparse", ["a.png"], camera=f"{name} 320 128 180 180 160 54 0.1")
    with pytest.raises(InputError, match=f"camera model {name}: a lens that is not read"):
        read_source(tmp_path, need_files=False)


@pytest.mark.parametrize(
    ("calib", "focal"),
    [
        ("Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n" + row("P0", 150) + row("P2", 180), 180),
        (row("P3", 190) + row("P2", 180), 180),
        ("calib_time: 09-Jan-2012 13:57:47\n" + row("P_rect_02", 180) + row("P_rect_00", 150), 180),
        (row("P2", 180).replace(":", ""), 180),
        (row("P0", 150), None),
        (row("P2", 180) + row("P2", 150), None),
        ("projections\n" + row("P2", 180), None),
    ],
)
def test_rows_of_kitti_are_found_by_name(tmp_path, calib, focal):
    folder = kitti(tmp_path / "a", calib)
    if focal is None:
        with pytest.raises(InputError):
            read_source(folder)
    else:
        assert read_source(folder).photographs[0].lens.K[0, 0] == focal


def test_unknown_rows_of_kitti_are_said(tmp_path):
    drive = read_source(kitti(tmp_path / "a", row("P2", 180) + "W_odd: 1 2\n"))
    assert "W_odd" in str(drive.notes)


def test_a_header_of_times_is_refused_with_its_line(tmp_path):
    times = "# seconds\n" + "\n".join(str(0.1 * i) for i in range(8))
    with pytest.raises(InputError, match="line 1"):
        read_source(kitti(tmp_path / "a", row("P2", 180), times=times))


@pytest.mark.parametrize(
    ("keys", "found"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR"),
        ({"camera_model": "OPENCV", "k4": 0.1}, "k4"),
        ({"camera_model": "SIMPLE_PINHOLE", "k1": 0.1}, "k1"),
        ({"distortion_params": [0.1, 0.0]}, "distortion_params"),
        ({"unit": "cm"}, "cm"),
        ({"axes": "opengll"}, "opengll"),
    ],
)
def test_what_transforms_cannot_mean_is_refused_by_name(tmp_path, keys, found):
    with pytest.raises(InputError, match=found):
        read_source(transforms(tmp_path / "a", NAMES[1:3], **keys), need_files=False)


def test_a_fisheye_of_instant_ngp_and_unknown_keys(tmp_path):
    folder = transforms(tmp_path / "a", NAMES[1:3], is_fisheye=True, k1=0.1, wobble=3)
    drive = read_source(folder, need_files=False)
    assert drive.photographs[0].lens.model == "fisheye"
    assert "wobble" in str(drive.notes)


WIDE, TALL = 2 * np.arctan(160 / 180), 2 * np.arctan(64 / 150)


@pytest.mark.parametrize(
    ("keys", "focal"),
    [
        ({"camera_angle_x": WIDE, "camera_angle_y": TALL}, (180, 150)),
        ({"camera_angle_x": WIDE}, (180, 180)),
        ({"camera_angle_y": TALL}, (150, 150)),
        ({"camera_angle_x": WIDE, "camera_angle_y": TALL, "fl_y": 170}, (180, 170)),
        ({"fl_x": 190, "camera_angle_x": WIDE, "camera_angle_y": TALL}, (190, 150)),
        ({"x_fov": np.rad2deg(WIDE), "y_fov": np.rad2deg(TALL)}, (180, 150)),
    ],
)
def test_focal_lengths_by_angles_of_view(tmp_path, keys, focal):
    folder = transforms(tmp_path / "a", NAMES)
    file = folder / "transforms.json"
    document = json.loads(file.read_text())
    for holder in (document, *document["frames"]):
        for key in ("fl_x", "fl_y"):
            holder.pop(key, None)
    size = {"w": 320, "h": 128}
    file.write_text(json.dumps({**document, **size, **keys}))
    K = read_source(folder, need_files=False).photographs[0].lens.K
    assert (K[0, 0], K[1, 1]) == pytest.approx(focal)


@pytest.mark.parametrize(
    "keys",
    [{"polygon": [[1, 2], [3]]}, {"camera_angle_x": "wide"}, {"camera_angle_x": 0}, {"x_fov": {}}],
)
def test_keys_that_change_nothing_refuse_no_drive(tmp_path, keys):
    folder = transforms(tmp_path, NAMES)
    with edited(folder) as document:
        document.update(keys)
    plain = read_source(transforms(tmp_path / "plain", NAMES), need_files=False)
    read = read_source(folder, need_files=False)
    assert len(read.photographs) == len(plain.photographs)
    assert "inf" not in str(read.notes)


def test_masks_of_frames_are_noted_since_they_are_not_used(tmp_path):
    folder = transforms(tmp_path, [f"{i}.png" for i in range(6)])
    with edited(folder) as document:
        document["frames"][2]["mask_path"] = "masks/2.png"
    assert "mask_path" in str(read_source(folder, need_files=False).notes)


def test_a_point_file_of_another_place_is_not_needed_for_a_model(tmp_path):
    folder = transforms(tmp_path / "a", NAMES[1:3], ply_file_path="gone.ply")
    assert read_source(folder, need_files=False).points is None
    with pytest.raises(InputError):
        read_source(folder)


def test_nothing_outside_of_the_folder_is_read_as_a_photograph(tmp_path):
    transforms(tmp_path / "b", NAMES[1:3])
    folder = transforms(tmp_path / "a", NAMES[1:3])
    text = (folder / "transforms.json").read_text()
    for outside in ("../b/images/", f"{tmp_path}/b/images/"):
        (folder / "transforms.json").write_text(text.replace("images/", outside))
        with pytest.raises(InputError):
            read_source(folder)
        read_source(folder, need_files=False)


def test_photographs_of_another_machine_and_axes_without_photographs(tmp_path):
    folder = transforms(tmp_path / "a", NAMES[1:3])
    with edited(folder) as document:
        for frame in document["frames"]:
            frame["file_path"] = f"/home/someone/{frame['file_path']}"
    with pytest.raises(InputError, match=r"/home/someone/images/1\.png"):
        read_source(folder)
    with edited(folder) as document:
        del document["axes"]
    with pytest.raises(InputError, match="'axes'"):
        read_source(folder, need_files=False)


def test_a_pose_of_kitti_belongs_to_the_number_of_a_photograph(tmp_path):
    folder = kitti(tmp_path / "a", row("P2", 180) + row("P3", 180))
    (folder / "image_3").mkdir()
    for path in (folder / "image_2").iterdir():
        (folder / "image_3" / path.name).write_bytes(path.read_bytes())
    (folder / "image_2/4.png").unlink()
    left = read_source(folder).of("left")
    right = read_source(folder).of("right")
    assert [one.file.stem for one in left] == ["0", "1", "2", "3", "5", "6", "7"]
    by_time = {one.t_us: one for one in right}
    for one in left:
        assert by_time[one.t_us].file.name == one.file.name
        assert np.array_equal(by_time[one.t_us].T_world_camera, one.T_world_camera)
    for i, path in enumerate(sorted((folder / "image_2").iterdir())):
        path.rename(path.with_stem(f"photograph-{'abcdefg'[i]}"))
    with pytest.raises(InputError, match="image_2"):
        read_source(folder)


def two_cameras(folder, names, form):
    """Write a drive of two cameras at one place, without times; the side one's names by number."""
    photographs = [
        *((f"front/{i:04d}.png", pose) for i, pose in enumerate(poses(13))),
        *((f"side/{name}.png", poses(13)[i]) for i, name in names.items()),
    ]
    if form != "colmap":
        frames = [
            {"file_path": name, "transform_matrix": pose.tolist(), "camera": name.split("/")[0]}
            if form == "transforms"
            else {"file_path": name, "transform_matrix": pose.tolist()}
            for name, pose in photographs
        ]
        folder.mkdir()
        document = {"axes": "opencv", **LENS, "frames": frames}
        (folder / "transforms.json").write_text(json.dumps(document))
    else:
        names, places = zip(*photographs, strict=True)
        colmap(folder / "sparse/0", names, places=places)
    return folder


@pytest.mark.parametrize("form", ["transforms", "folders", "colmap"])
def test_photographs_of_one_number_have_one_time(tmp_path, form):
    names = {i: f"{i:04d}" for i in range(13) if i not in (0, 7)}
    drive = read_source(two_cameras(tmp_path / "a", names, form), need_files=False)
    assert [one.t_us for one in drive.of("front")] == [100_000 * i for i in range(13)]
    assert [one.t_us for one in drive.of("side")] == [100_000 * i for i in names]
    if form == "folders":  # no name stands in both: they may be one camera's
        return
    unnumbered = {i: f"x{'abcdefghijklm'[i]}" for i in names}
    with pytest.raises(InputError, match=r"\[13, 11\]"):
        read_source(two_cameras(tmp_path / "b", unnumbered, form), need_files=False)
    unnumbered = {i: f"x{'abcdefghijklm'[i]}" for i in range(13)}
    drive = read_source(two_cameras(tmp_path / "c", unnumbered, form), need_files=False)
    assert [one.t_us for one in drive.of("side")] == [100_000 * i for i in range(13)]


def test_gaps_in_the_numbers_of_photographs_are_gaps_in_time(tmp_path):
    names = [f"frame_{5 * i + (40 if i > 6 else 0):05d}.png" for i in range(13)]
    drive = read_source(transforms(tmp_path / "a", names), need_files=False)
    assert [one.t_us // 100_000 for one in drive.photographs] == [*range(7), *range(15, 21)]


def test_times_in_nanoseconds_are_refused(tmp_path):
    folder = transforms(tmp_path / "a", NAMES, unit="m")
    with edited(folder) as document:
        for i, frame in enumerate(document["frames"]):
            frame["t_us"] = 100_000_000 * i
    drive = read_source(folder, need_files=False)
    with pytest.raises(InputError, match="m/s"):
        check_motion(drive, place(drive, street_points(drive)))


def test_the_page_of_a_drive_holds_no_markup_of_its_files(tmp_path):
    folder = transforms(tmp_path / "a\x1b[2J", NAMES[1:3], **{"<img src=x>\u202e": 1})
    drive = read_source(folder, need_files=False)
    grey = np.zeros((4, 4, 3), dtype=np.uint8)
    shown = [("held-out", Comparison("<b>\x1b", grey, grey, 30.0, 0.9), "pictures/<b>\x1b.jpg")]
    quality = {
        "photographs": {},
        "coverage": [],
        "measured": None,
        "notes": drive.notes,
        "fitted": 2,
        "obstacles": {"boxes": 0, "cleared_cells": 0},
        "ground": None,
    }
    page = _page(drive, quality, shown)
    assert not re.search("[<\x1b\u202e]", page)
    assert "&lt;img src=x&gt;" in page


def test_a_drive_that_no_car_can_drive_is_refused_with_the_photograph(tmp_path):
    folder = transforms(tmp_path / "a", NAMES, unit="m")
    with edited(folder) as document:
        for i, frame in enumerate(document["frames"]):
            frame["t_us"] = 100_000 * i if i != 7 else 650_000
        document["frames"][7]["transform_matrix"][0][3] += 2.0
    drive = checked(read_source(folder, need_files=False), folder, need_files=False)
    with pytest.raises(InputError, match=r"7\.png"):
        check_motion(drive, place(drive, street_points(drive)))


def street_points(drive):
    from alpasim_plugin.drives.splat import _surface

    return _surface(street_cloud())


def street_cloud():
    rng = np.random.default_rng(0)
    points = rng.uniform([-2.0, -4.0, 0.0], [40.0, 4.0, 0.0], (6000, 3))
    points[:, 2] = Street().ground(points[:, 0])
    n = len(points)
    turns = np.tile([1.0, 0, 0, 0], (n, 1))
    return GaussianCloud(
        points, turns, np.full((n, 3), 0.15), np.full(n, 0.95), np.zeros((n, 1, 3))
    )


@pytest.mark.parametrize("keys", ["none", "stated", "old"])
def test_a_model_in_the_frame_of_its_trainer_is_moved_by_the_file_beside_it(tmp_path, keys):
    before = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
    more = {"applied_transform": before[:3].tolist(), "applied_scale": 2.0}
    names = NAMES
    folder = transforms(tmp_path / "a", names, **(more if keys == "stated" else {}))
    drive = read_source(folder, need_files=False)
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(np.array([0.7, 0.2, -0.4]))[0]
    T[:3, 3] = -6.9, 0.5, -1.7
    model = placed_cloud(street_cloud(), np.diag([0.145, 0.145, 0.145, 1.0]) @ T)
    with pytest.raises(InputError):
        _in_frame(tmp_path / "splat.ply", model, folder, drive)
    document = {
        "transform": (T if keys == "none" else T @ before)[:3].tolist(),
        "scale": 0.145 * (2.0 if keys == "stated" else 1.0),
    }
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(document))
    moved, notes = _in_frame(tmp_path / "splat.ply", model, folder, drive)
    assert np.abs(moved.means - street_cloud().means).max() < 1e-6
    assert "dataparser_transforms.json" in str(notes)
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps({**document, "up": [0, 0, 1]}))
    with pytest.raises(InputError, match="file/up"):
        _in_frame(tmp_path / "splat.ply", model, folder, drive)
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(document))
    unmoved, _ = _in_frame(tmp_path / "splat.ply", street_cloud(), folder, drive)
    assert np.abs(unmoved.means - street_cloud().means).max() < 1e-9


@pytest.mark.parametrize(
    ("file", "text", "found"),
    [
        ("cameras.txt", "8 PINHOLE 320 128 180 180 160 54\n", "camera 7"),
        ("images.txt", "IMAGE_ID QW QX QY QZ\n", "IMAGE_ID"),
        ("rigs.txt", "1 2 CAMERA 7\n", "rigs.txt"),
        ("frames.txt", "1 1 one 0 0 0 0 0 0 1 CAMERA 7 1\n", "frames.txt"),
    ],
)
def test_what_a_colmap_model_lacks_is_said(tmp_path, file, text, found):
    model = tmp_path / "sparse/0"
    colmap(model, NAMES)
    (model / file).write_text(text)
    with pytest.raises(InputError, match=found):
        read_source(tmp_path, need_files=False)


SIDE = np.eye(4)
SIDE[:3] = [[0, 0, -1, 0], [0, 1, 0, 0.1], [1, 0, 0, -0.3]]  # from the front camera to the left one


def rig(model, folders, left, binary=False, shift=0.0):
    """Write a rig of two cameras, 7 ahead and 9 to the left, which has images of some frames only;
    frames and images are numbered against their order.
    """
    model.mkdir(parents=True)
    lens = f"PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} 160 54"
    (model / "cameras.txt").write_text(f"7 {lens}\n9 {lens}\n")
    (model / "points3D.txt").write_text("1 1.0 0.0 0.0 90 90 90 0.5 1 0\n")

    def numbers(T):
        return " ".join(repr(float(v)) for v in [*quat_from_matrix(T[:3, :3]), *T[:3, 3]])

    images = []
    frames = []
    for i, pose in enumerate(poses(13)):
        ahead = 100 - i
        side = 200 - i
        T_rig_world = np.linalg.inv(pose)
        images.append(f"{ahead} {numbers(T_rig_world)} 7 {folders[0]}{i}.png")
        data = f"1 CAMERA 7 {ahead}"
        if i in left:
            images.append(f"{side} {numbers(SIDE @ T_rig_world)} 9 {folders[1]}{i}.png")
            data = f"2 CAMERA 9 {side} CAMERA 7 {ahead}"
        frames.append(f"{50 - i} 3 {numbers(T_rig_world)} {data}")
    mount = SIDE.copy()
    mount[0, 3] += shift
    (model / "images.txt").write_text("\n\n".join(images) + "\n")
    (model / "rigs.txt").write_text(f"# rigs\n3 2 CAMERA 7 CAMERA 9 1 {numbers(mount)}\n")
    (model / "frames.txt").write_text("# frames\n" + "\n".join(frames[::-1]) + "\n")
    if binary:
        as_binary(model)
    return model


def as_binary(model):
    """Turn a rig's text files into binary ones."""
    p = (FOCAL, FOCAL, 160.0, 54.0)
    cameras = [struct.pack("<IiQQ4d", n, 1, WIDTH, HEIGHT, *p) for n in (7, 9)]
    images = []
    for line in (model / "images.txt").read_text().split("\n\n"):
        words = line.split()
        pose = struct.pack("<7d", *map(float, words[1:8]))
        head = struct.pack("<I", int(words[0])) + pose + struct.pack("<I", int(words[8]))
        images.append(head + words[9].encode() + b"\0" + struct.pack("<Q", 0))
    mount = map(float, (model / "rigs.txt").read_text().split()[-7:])
    rigs = [struct.pack("<IIiIiIB7d", 3, 2, 0, 7, 0, 9, 1, *mount)]
    frames = []
    for line in (model / "frames.txt").read_text().splitlines()[1:]:
        words = line.replace("CAMERA", "0").split()
        head = struct.pack("<II7dI", int(words[0]), 3, *map(float, words[2:9]), int(words[9]))
        data = [int(word) for word in words[10:]]
        taken = [struct.pack("<iIQ", *data[at : at + 3]) for at in range(0, len(data), 3)]
        frames.append(head + b"".join(taken))
    points = [struct.pack("<Q3d3BdQ", 1, 1.0, 0.0, 0.0, 90, 90, 90, 0.5, 0)]
    files = {"cameras": cameras, "images": images, "rigs": rigs, "frames": frames}
    for name, rows in {**files, "points3D": points}.items():
        (model / f"{name}.bin").write_bytes(struct.pack("<Q", len(rows)) + b"".join(rows))
        (model / f"{name}.txt").unlink()


@pytest.mark.parametrize("binary", [False, True], ids=["text", "binary"])
@pytest.mark.parametrize("folders", [("front/", "left/"), ("a", "b")], ids=["folders", "prefixes"])
def test_images_of_a_frame_of_a_rig_have_one_time(tmp_path, folders, binary):
    rig(tmp_path / "sparse/0", folders, [0, 1, 4, 12], binary)
    drive = read_source(tmp_path, need_files=False)
    names = ["front", "left"] if folders[0] == "front/" else ["camera-7", "camera-9"]
    assert drive.cameras == names
    assert along(drive) == STRAIGHT
    assert [one.t_us for one in drive.of(names[1])] == [0, 100_000, 400_000, 1_200_000]
    mount = (
        np.linalg.inv(drive.of(names[0])[4].T_world_camera) @ drive.of(names[1])[2].T_world_camera
    )
    assert np.allclose(mount, np.linalg.inv(SIDE), atol=1e-9)


def test_photographs_of_a_rig_are_in_the_order_of_time_whatever_their_names(tmp_path):
    model = rig(tmp_path / "sparse/0", ["front/", "left/"], range(13))
    text = (model / "images.txt").read_text()
    backwards = re.sub(r"left/(\d+)", lambda name: f"left/{20 - int(name[1])}", text)
    (model / "images.txt").write_text(backwards)
    drive = read_source(tmp_path, need_files=False)
    assert [one.t_us for one in drive.of("left")] == [100_000 * i for i in range(13)]
    assert [one.file.name for one in drive.of("left")][:2] == ["20.png", "19.png"]


@pytest.mark.parametrize("binary", [False, True])
def test_images_that_do_not_stand_where_their_rig_says_are_refused(tmp_path, binary):
    rig(tmp_path / "sparse/0", ["front/", "left/"], [0, 1], binary, shift=0.2)
    with pytest.raises(InputError, match=r"its pose is 0\.2 units"):
        read_source(tmp_path, need_files=False)


def test_a_colmap_model_without_points_leaves_them_to_be_found(tmp_path):
    model = tmp_path / "sparse/0"
    colmap(model, NAMES)
    assert len(read_source(tmp_path, need_files=False).points) == 1
    (model / "points3D.txt").write_text("# no points\n")
    assert read_source(tmp_path, need_files=False).points is None


def test_numbers_behind_the_last_one_of_a_line_of_colmap_are_refused(tmp_path):
    model = tmp_path / "sparse/0"
    colmap(model, NAMES)
    cameras = model / "cameras.txt"
    cameras.write_text(cameras.read_text().rstrip() + " 0.01\n")  # a lens of one number more
    with pytest.raises(InputError, match="goes on with"):
        read_source(tmp_path, need_files=False)


@pytest.mark.parametrize("number", ["nan", "inf"])
@pytest.mark.parametrize(
    ("file", "record", "column", "place"),
    [
        ("points3D.txt", 0, 2, "points3D.txt: .* point 1: its position"),
        ("images.txt", 1, 6, "images.txt: .* image 0.png: its pose"),
    ],
)
def test_poses_and_points_of_colmap_that_are_not_finite_are_named(
    tmp_path, file, record, column, place, number
):
    model = tmp_path / "sparse/0"
    colmap(model, NAMES)
    lines = (model / file).read_text().splitlines()
    words = lines[record].split()
    words[column] = number
    lines[record] = " ".join(words)
    (model / file).write_text("\n".join(lines))
    with pytest.raises(InputError, match=place):
        read_source(tmp_path, need_files=False)


def test_bytes_behind_the_last_record_of_colmap_are_refused(tmp_path):
    model = rig(tmp_path / "sparse/0", ["front/", "left/"], [0, 1], binary=True)
    with (model / "cameras.bin").open("ab") as file:
        file.write(b"more")
    with pytest.raises(InputError, match="4 bytes after the last record"):
        read_source(tmp_path, need_files=False)


def test_rigs_of_one_camera_change_nothing(tmp_path):
    model = tmp_path / "sparse/0"
    colmap(model, NAMES)
    (model / "rigs.txt").write_text("1 1 CAMERA 7\n")
    first_image = (model / "images.txt").read_text().splitlines()[1]
    pose = " ".join(first_image.split()[1:8])
    (model / "frames.txt").write_text(f"4 1 {pose} 1 CAMERA 7 1\n")
    assert along(read_source(tmp_path, need_files=False)) == STRAIGHT


def turned_rig(folder, turns_deg, **uses):
    """Write a ``transforms.json`` of cameras that look to the left by so many degrees."""
    frames = []
    for camera, turn_deg in turns_deg.items():
        for i, pose in enumerate(poses(10)):
            pose[:3, :3] = se2(0, 0, np.radians(turn_deg))[:3, :3] @ pose[:3, :3]
            frame = {"file_path": f"{camera}/{i}.png", "transform_matrix": pose.tolist()}
            use = {"use": uses[camera]} if camera in uses else {}
            frames.append({**frame, "camera": camera, "t_us": 100_000 * i, **use})
    folder.mkdir(parents=True)
    document = {"axes": "opencv", **LENS, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder


@pytest.mark.parametrize(
    ("turns_deg", "uses", "front"),
    [
        ({"CAM_BACK": 180, "CAM_FRONT": 0, "CAM_FRONT_LEFT": 55}, {}, "CAM_FRONT"),
        ({"FRONT": 0, "FRONT_LEFT": 45, "SIDE_LEFT": 90}, {}, "FRONT"),
        ({"front_left": 60, "front_wide": 2, "rear": 180}, {}, "front_wide"),
        ({"cam0": 90, "cam1": 3, "cam2": 0}, {}, "cam1"),
        ({"left": 0, "right": 0}, {"left": "never-fitted"}, "right"),
    ],
)
def test_a_rig_is_driven_by_the_camera_that_looks_ahead(tmp_path, turns_deg, uses, front):
    folder = turned_rig(tmp_path / "rig", turns_deg, **uses)
    assert read_source(folder, need_files=False).front == front


def test_points_of_a_file_are_as_uncertain_as_they_are_far_away(tmp_path):
    folder = transforms(tmp_path / "a", NAMES, ply_file_path="points.ply")
    (folder / "images").mkdir()
    for name in NAMES:
        cv2.imwrite(str(folder / "images" / name), np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8))
    xyz = poses(1)[0][:3, 3] + np.array([[0.0, 5.0, 0.0], [0.0, 50.0, 0.0]])
    write_points(folder / "points.ply", xyz, np.zeros((2, 3), dtype=np.uint8))
    points = read_source(folder).points
    assert points.spread == pytest.approx(np.sqrt(3) * 0.004 * np.array([5.0, 50.0]))


def test_a_file_without_frames_is_refused(tmp_path):
    with pytest.raises(InputError, match="no frames"):
        read_source(transforms(tmp_path / "a", []), need_files=False)


def test_photographs_that_are_missing_leave_their_time(tmp_path):
    folder = transforms(tmp_path / "a", NAMES, unit="m")
    (folder / "images").mkdir()
    for i in (0, 1, 5, 6, 7, 8, 9, 10, 11, 12):
        (folder / f"images/{i}.png").write_bytes(b"x")
    drive = read_source(folder, need_files=False)
    assert [one.t_us for one in drive.photographs][:3] == [0, 100_000, 500_000]
    assert "3 of 13" in str(drive.notes)


def test_a_walk_around_an_object_without_metres_has_no_speed(tmp_path):
    folder = transforms(tmp_path / "a", NAMES)
    with edited(folder) as document:
        for i, frame in enumerate(document["frames"]):
            frame["transform_matrix"][1][3] = 3.0 * (-1) ** i
    drive = read_source(folder, need_files=False)
    nothing = Points(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    check_motion(drive, place(drive, nothing))


def test_text_of_windows_is_read(tmp_path):
    model = tmp_path / "a/sparse/0"
    colmap(model, NAMES)
    for file in model.glob("*.txt"):
        file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes().replace(b"\n", b"\r\n"))
    assert along(read_source(tmp_path / "a", need_files=False)) == STRAIGHT
    folder = transforms(tmp_path / "b", NAMES)
    file = folder / "transforms.json"
    file.write_text(file.read_text().replace("images/", r".\\images\\"))
    first = read_source(folder, need_files=False).photographs[0].file
    assert first == folder / "images/0.png"


def test_files_and_rows_that_no_reader_of_kitti_knows_are_named(tmp_path):
    folder = kitti(tmp_path / "a", row("P2", 180) + "Tr: 1 0 0\nT_cam_gps: 1 2 3\n")
    (folder / "oxts").mkdir()
    (folder / "velodyne").mkdir()
    notes = str(read_source(folder).notes)
    assert "KITTI odometry: not read are calib.txt/T_cam_gps (1)" in notes
    assert "folder/oxts (1)" in notes
    assert "velodyne" not in notes


def test_files_of_a_colmap_model_that_are_not_read_are_named(tmp_path):
    colmap(tmp_path / "sparse/0", NAMES)
    (tmp_path / "sparse/0/pose_priors.txt").write_text("")
    (notes,) = [n for n in read_source(tmp_path, need_files=False).notes if "COLMAP" in n]
    assert notes == "COLMAP: not read are model/pose_priors (1)"


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("rolling_shutter", [0, 0, 1, 0]),
        ("normal_mts_args", ["--scene"]),
        ("ftheta_p0", 0.1),
        ("equirectangular", True),
        ("n_frames", 5),
    ],
)
def test_keys_of_transforms_by_which_cameras_differ_are_refused(tmp_path, key, value):
    folder = transforms(tmp_path / "a", NAMES, **{key: value})
    with pytest.raises(InputError, match=f"frame/{key}"):
        read_source(folder, need_files=False)


def test_a_shutter_of_no_duration_changes_nothing(tmp_path):
    folder = transforms(tmp_path / "a", NAMES, rolling_shutter=[0.0, 0.0, 0.0, 0.0])
    assert along(read_source(folder, need_files=False)) == STRAIGHT


@pytest.mark.parametrize(("key", "angle"), [("camera_angle_x", 0.86), ("y_fov", 30.0)])
def test_a_focal_length_and_an_angle_of_view_that_disagree_are_said(tmp_path, key, angle):
    folder = transforms(tmp_path / "a", NAMES, **{key: angle})
    drive = read_source(folder, need_files=False)
    assert drive.photographs[0].lens.K[0, 0] == FOCAL
    assert any("disagree" in note and key in note for note in drive.notes)
    agreeing = {"camera_angle_x": 2 * float(np.arctan(0.5 * WIDTH / FOCAL))}
    calm = read_source(transforms(tmp_path / "b", NAMES, **agreeing), need_files=False)
    assert not any("disagree" in note for note in calm.notes)


@pytest.mark.parametrize(
    ("entry", "form"),
    [
        ("keyframes/cameras/1.json", "Polycam"),
        ("EXR_RGBD/rgb/0.jpg", "Record3D"),
        ("data_poses/2013_sync/poses.txt", "KITTI-360"),
        ("rlog.zst", "openpilot"),
        ("scenario_0a1e.parquet", "motion forecasting"),
        ("segment-1.tfrecord", "Waymo"),
        ("2013_05_28_drive_0000_sync/cam0_to_world.txt", "KITTI-360"),
        ("v1.0-mini/scene.json", "nuScenes"),
        ("2021.05.12.22.db", "nuPlan"),
        ("map.gpkg", "nuPlan"),
        ("drive.bag", "ROS"),
        ("cut-in.xosc", "OpenSCENARIO"),
    ],
)
def test_forms_without_a_reader_are_refused_by_their_names(tmp_path, entry, form):
    (tmp_path / entry).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / entry).write_bytes(b"")
    for path in [tmp_path] if "/" in entry else [tmp_path, tmp_path / entry]:
        with pytest.raises(InputError, match=form):
            read_source(path)
        assert form in str(import_advice(path))
