"""What a reader of a recorded drive returns, in the frame and the unit of its own files, and the
checks that all of them pass.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import scipy

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import natural_order
from alpasim_plugin.core.files.limits import Bound
from alpasim_plugin.core.types import F64, Actor, Bool, Vehicle
from alpasim_plugin.gaussians.fit.photographs import PosedPhotograph

# A step so many times the usual one is no driving: two units, or two drives in one file.
JUMP = 12.0
LEAST_M = 1.0
UNITS = 30.0  # steps change by so much, at once and for good, between metres and centimetres
PHOTOGRAPHS = Bound("photographs with poses", "", 8, 400, "give a drive, or a part of a long one")
PERIOD_US = 100_000  # between photographs without times
LONGEST = 36_000  # steps between the numbers of names that count time: an hour
SAME_LENGTH = 0.01  # paths that differ by less are equally long
# Cosines with the way that differ by less look alike along it: 25 degrees are as good as none
ALIKE = 0.1
# Of points whose error is not stated, as a share of their distance from the nearest photograph
SPREAD = 0.004


@dataclass(frozen=True, eq=False)
class Points:
    """Points of surfaces.

    Attributes:
        xyz: ``(N, 3)``.
        rgb: ``(N, 3)`` 0..1.
        covariance: ``(N, 3, 3)`` of a point's place, same unit as ``xyz``, squared.
    """

    xyz: F64
    rgb: F64
    covariance: F64

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self.xyz)

    @classmethod
    def of_unstated_error(
        cls, xyz: F64, rgb: F64, photographs: Sequence[PosedPhotograph]
    ) -> Points:
        """Return points ``(N, 3)`` with colours ``(N, 3)`` 0..1; how far each may be off grows with
        its distance from the nearest photograph.
        """
        centres = np.array([photograph.T_world_camera[:3, 3] for photograph in photographs])
        sampled_centres = centres[:: max(1, len(centres) // 32)]
        distance = scipy.spatial.KDTree(sampled_centres).query(xyz)[0]
        return cls(xyz, rgb, np.eye(3) * ((SPREAD * distance) ** 2)[:, None, None])

    def moved(self, T: F64) -> Points:
        """Return them in another frame; ``(4, 4)``, may scale."""
        return Points(
            self.xyz @ T[:3, :3].T + T[:3, 3], self.rgb, T[:3, :3] @ self.covariance @ T[:3, :3].T
        )

    def chosen(self, which: Bool) -> Points:
        """Return those that a mask ``(N,)`` chooses."""
        return Points(self.xyz[which], self.rgb[which], self.covariance[which])

    def joined(self, other: Points) -> Points:
        """Return these and others of the same frame."""
        return Points(
            np.concatenate([self.xyz, other.xyz]),
            np.concatenate([self.rgb, other.rgb]),
            np.concatenate([self.covariance, other.covariance]),
        )

    @property
    def rise_spread(self) -> F64:
        """Return the standard deviation of the third coordinate, ``(N,)``."""
        return np.sqrt(np.maximum(self.covariance[:, 2, 2], 0.0))

    @property
    def spread(self) -> F64:
        """Return the standard deviation of the place, all directions together, ``(N,)``."""
        return np.sqrt(np.maximum(np.trace(self.covariance, axis1=1, axis2=2), 0.0))


@dataclass(frozen=True, eq=False)
class SourceDrive:
    """A recorded drive as its files say it.

    Attributes:
        kind: Of the files: ``kitti``, ``transforms``, ``colmap`` or ``py123d``.
        scene_id: A name for the scenario.
        photographs: All photographs, camera by camera in order of time; each has its time and camera.
        front: The camera that looks ahead and is driven by.
        never_fitted: Cameras whose photographs are kept for measuring.
        metric: What makes lengths metres; None where the unit is arbitrary.
        points: Points that come with the poses; None where there are none.
        notes: What was assumed or left out.
        actors: Road users that move, of a drive in metres.
        vehicle: The body that carries the cameras.
        front_xy_m: Where the front camera stands ahead and to the left of the rear axle; None where
            that is unknown.
    """

    kind: str
    scene_id: str
    photographs: tuple[PosedPhotograph, ...]
    front: str
    never_fitted: tuple[str, ...] = ()
    metric: str | None = None
    points: Points | None = None
    notes: tuple[str, ...] = ()
    actors: tuple[Actor, ...] = ()
    vehicle: Vehicle = Vehicle()
    front_xy_m: tuple[float, float] | None = None

    def of(self, camera: str) -> list[PosedPhotograph]:
        """Return a camera's images in order of time."""
        return [photograph for photograph in self.photographs if photograph.camera == camera]

    @property
    def cameras(self) -> list[str]:
        """Return the cameras, the front one first."""
        names = {str(photograph.camera) for photograph in self.photographs}
        return sorted(
            names,
            key=lambda name: (name != self.front, name in self.never_fitted, name),
        )

    @property
    def path(self) -> F64:
        """Return where the front camera was, ``(N, 3)``."""
        return np.array([photograph.T_world_camera[:3, 3] for photograph in self.of(self.front)])


def front_camera(cameras: Mapping[str, Sequence[PosedPhotograph]]) -> str:
    """Return the camera to drive by: the first of those that look along the way as well as any; of
    those with a front in their name, where there are some.

    Args:
        cameras: Name to photographs, as they were taken; the preferred ones first.
    """
    names = [name for name in cameras if "front" in name.lower()] or list(cameras)
    ahead = {name: _ahead(cameras[name]) for name in names}
    best = max(ahead.values())
    return next(name for name in names if ahead[name] >= best - ALIKE)


def _ahead(photographs: Sequence[PosedPhotograph]) -> float:
    """Return the cosine between a camera's axis and the way it goes, the mean by length; 0 of a
    camera that stands.
    """
    poses = np.array([photograph.T_world_camera for photograph in photographs])
    steps = np.diff(poses[:, :3, 3], axis=0)
    length = float(np.linalg.norm(steps, axis=1).sum())
    along = float(np.einsum("ij,ij->", steps, poses[:-1, :3, 2]))
    return along / length if length else 0.0


def checked(drive: SourceDrive, folder: Path, need_files: bool = True) -> SourceDrive:
    """Return a drive whose poses can be those of a moving camera, and, if their files are
    needed, whose photographs are whole.

    Raises:
        InputError: A photograph is cut off, or of another size than its lens or its camera's
            others; too few; two units of length in one file; a camera that stands or only turns.
    """
    photographs = drive.of(drive.front)
    camera = f"{folder}, camera {drive.front!r}"
    PHOTOGRAPHS.check(len(photographs), camera)
    for photograph in drive.photographs:
        if need_files:
            photograph.encoded()
        size = (photograph.lens.width, photograph.lens.height)
        first = drive.of(str(photograph.camera))[0].lens
        if size != (first.width, first.height):
            raise InputError(
                f"{photograph.location}, {photograph.file}: {size} pixels, others of the camera {photograph.camera!r} have {first.width}x{first.height}",
                "give the photographs as they were, each with its camera's name",
            )
    steps = np.linalg.norm(np.diff(drive.path, axis=0), axis=1)
    length = float(steps.sum())
    if length == 0 or (drive.metric and length < LEAST_M):
        raise InputError(
            f"{camera}: it moves {length:.2f} m over {len(photographs)} photographs: it stands, or only turns",
            "give a part of the drive in which the car moves: depth comes from moving",
        )
    usual = float(np.median(steps[steps > 0]))
    far = int(np.argmax(steps))
    if steps[far] > JUMP * usual and steps[far] > 0.2 * length:
        fault = f"a step of {steps[far]:.4g}, where the usual step is {usual:.4g}"
        raise _two_units(photographs[far + 1], fault)
    medians = np.median(np.lib.stride_tricks.sliding_window_view(steps, 5), axis=1)
    before = medians[:-5]
    after = medians[5:]
    changes = np.flatnonzero(
        (np.maximum(before, after) > UNITS * np.minimum(before, after)) & (before * after > 0)
    )
    if len(changes):
        fault = f"steps more than {UNITS:.0f} times as long, or as short, from here on"
        raise _two_units(photographs[int(changes[0]) + 6], fault)
    first_us = int(photographs[0].t_us or 0)
    tracks = [replace(actor.track, t_us=actor.track.t_us - first_us) for actor in drive.actors]
    return replace(
        drive,
        photographs=tuple(
            replace(photograph, t_us=int(photograph.t_us or 0) - first_us)
            for photograph in drive.photographs
        ),
        actors=tuple(
            replace(actor, track=track) for actor, track in zip(drive.actors, tracks, strict=True)
        ),
    )


def _two_units(photograph: PosedPhotograph, fault: str) -> InputError:
    return InputError(
        f"{photograph.location}, {photograph.file.name}: {fault}",
        "give all poses in one unit, metres, and one drive at a time",
    )


def timed(cameras: Sequence[Sequence[PosedPhotograph]]) -> list[PosedPhotograph]:
    """Return photographs without times with the times at which they were taken.

    The numbers of their names count time, `PERIOD_US` for the usual step: photographs of one number
    have one time, and gaps stay. Without such numbers, those of a camera follow one another.

    Args:
        cameras: The photographs of each, as they were taken.

    Raises:
        InputError: Nothing says which photographs of the cameras belong together.
    """
    numbers = [name_numbers([photograph.file for photograph in camera]) for camera in cameras]
    all_numbers = sorted({number for column in numbers for number in column})
    steps = sorted(after - before for before, after in pairwise(all_numbers))
    step = steps[len(steps) // 2] if steps else 1
    if (
        not set.intersection(*map(set, numbers))
        or all_numbers[-1] - all_numbers[0] > LONGEST * step
    ):
        counts = [len(camera) for camera in cameras]
        if len(set(counts)) > 1:
            raise InputError(
                f"{cameras[0][0].location}: no times, and cameras of {counts} photographs whose names share no numbers",
                "give each photograph its time (t_us), or photographs of one time names of one number",
            )
        numbers = [list(range(count)) for count in counts]
        all_numbers = numbers[0]
        step = 1
    return [
        replace(photograph, t_us=round((number - all_numbers[0]) * PERIOD_US / step))
        for camera, column in zip(cameras, numbers, strict=True)
        for photograph, number in zip(camera, column, strict=True)
    ]


def name_numbers(files: Sequence[Path]) -> list[int]:
    """Return the number in each name that changes from name to name; nothing where there is no such
    number, more than one, or one that does not increase.
    """
    names = [re.findall(r"\d+", file.stem) for file in files]
    columns = [column for column in zip(*names, strict=False) if len(set(column)) > 1]
    if len({len(name) for name in names}) > 1 or len(columns) != 1:
        return []
    numbers = [int(digits) for digits in columns[0]]
    return numbers if all(before < after for before, after in pairwise(numbers)) else []


def in_order(photographs: Sequence[PosedPhotograph]) -> tuple[list[PosedPhotograph], str]:
    """Return a camera's images without times as they were taken, with a note.

    The order is that of the file. Some tools list photographs in an order of their own: where the
    path along the names, in natural order, is shorter, the names count.
    """
    by_name = sorted(photographs, key=lambda photograph: natural_order(photograph.file.as_posix()))
    listed = _length(photographs)
    named = _length(by_name)
    name = photographs[0].camera
    rate = 1_000_000 // PERIOD_US
    if named < (1 - SAME_LENGTH) * listed:
        note = f"in the order of their names: in the file's order the path is {listed / max(named, 1e-12):.1f} times as long"
        return by_name, f"no times: photographs of {name} are taken {note}; {rate} a second"
    return list(photographs), (
        f"no times: photographs of {name} are taken in the file's order, {rate} a second"
    )


def _length(photographs: Sequence[PosedPhotograph]) -> float:
    centres = np.array([photograph.T_world_camera[:3, 3] for photograph in photographs])
    return float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())
