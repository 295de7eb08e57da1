"""Recorded drives of other tools that no reader reads, by their names, and what makes a drive of
them.
"""

import os
from pathlib import Path

MOTION = "a scenario of Argoverse 2 motion forecasting"
# A file or folder by which a form is recognised, its name, and the tool that converts it.
UNREAD_FORMS = (
    ("keyframes", "a raw export of Polycam", "ns-process-data polycam (nerfstudio)"),
    ("EXR_RGBD", "an export of Record3D", "ns-process-data record3d (nerfstudio)"),
    ("data_poses", "KITTI-360", "py123d"),
    ("cam0_to_world.txt", "a drive of KITTI-360", "py123d"),
    ("rlog", "a segment of openpilot (comma)", "COLMAP, of frames of its film"),
    ("rlog.bz2", "a segment of openpilot (comma)", "COLMAP, of frames of its film"),
    ("rlog.zst", "a segment of openpilot (comma)", "COLMAP, of frames of its film"),
    ("qlog", "a segment of openpilot (comma)", "COLMAP, of frames of its film"),
    ("qlog.bz2", "a segment of openpilot (comma)", "COLMAP, of frames of its film"),
    ("qlog.zst", "a segment of openpilot (comma)", "COLMAP, of frames of its film"),
    ("scenario_*.parquet", MOTION, "the sensor log that it was cut from"),
    ("*.tfrecord", "Waymo's own files", "py123d"),
)


def unread_form(folder: Path) -> tuple[str, str] | None:
    """Return the name of a form that has no reader, and what makes a drive of it; None where no such
    form is recognised.
    """
    for pattern, form, tool in UNREAD_FORMS:
        if os.path.isdir(folder) and any(folder.glob(pattern)):
            return form, f"make a drive with {tool}, then simrun import drive"
    return None
