"""Recorded drives and scenes of other tools that no reader reads, by their names, and what makes a
drive of them.
"""

import os
from pathlib import Path

MOTION = "a scenario of Argoverse 2 motion forecasting"
COMMA = "a segment of openpilot (comma)"
NUPLAN = "a file of nuPlan"


def _by(tool: str) -> str:
    return f"make a drive with {tool}, then simrun import drive"


BY_PY123D = _by("py123d")
BY_FILM = _by("COLMAP, of frames of its film")
# A file, or a file or folder in a folder, by which a form is recognised, its name, and what to do.
UNREAD_FORMS = (
    ("keyframes", "a raw export of Polycam", _by("ns-process-data polycam (nerfstudio)")),
    ("EXR_RGBD", "an export of Record3D", _by("ns-process-data record3d (nerfstudio)")),
    ("data_poses", "KITTI-360", BY_PY123D),
    ("cam0_to_world.txt", "a drive of KITTI-360", BY_PY123D),
    ("2013_05_28_drive_*_sync", "KITTI-360", BY_PY123D),
    *((f"{log}{ending}", COMMA, BY_FILM)
      for log in ("rlog", "qlog") for ending in ("", ".bz2", ".zst")),
    ("scenario_*.parquet", MOTION, _by("the sensor log that it was cut from")),
    ("*.tfrecord", "a file of Waymo", BY_PY123D),
    ("v1.0-*", "nuScenes", BY_PY123D),
    ("*.db", NUPLAN, BY_PY123D),
    ("*.gpkg", NUPLAN, BY_PY123D),
    ("*.bag", "a bag of ROS", BY_FILM),
    ("*.db3", "a bag of ROS", BY_FILM),
    ("*.xosc", "a file of OpenSCENARIO", "run it in esmini, and give the OSI trace that it records"),
)  # fmt: skip


def unread_form(path: Path) -> tuple[str, str] | None:
    """Return the name of the form of a file or a folder that has no reader, and what makes a drive of
    it; None where no such form is recognised.
    """
    for pattern, form, do_this in UNREAD_FORMS:
        if os.path.isdir(path) and any(path.glob(pattern)):
            return form, do_this
        if os.path.isfile(path) and path.match(pattern):
            return form, do_this
    return None
