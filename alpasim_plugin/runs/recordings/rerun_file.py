"""Write a recording as .rrd for Rerun, with a layout: a scene a renderer, its cameras, and metrics
below.
"""

from __future__ import annotations

import hashlib
import json
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from alpasim_plugin.core.atomic import atomic_file
from alpasim_plugin.core.geometry import quat_from_matrix
from alpasim_plugin.core.lazy import require_library
from alpasim_plugin.core.types import I64, Box, Trajectory
from alpasim_plugin.runs.recordings.content import (
    MAP,
    ROAD_USER,
    Camera,
    Drive,
    Recording,
    Rgba,
    as_bytes,
    fainter,
    of_renderer,
    present,
)
from evaluators.metrics import METRICS

TIMELINE = "t"
NS_PER_US = 1_000
THICK_M, THIN_M = 0.15, 0.06  # radii


def write_rrd(recording: Recording, path: Path) -> dict[str, int]:
    """Write a recording.

    Times are durations in nanoseconds on the time line ``t``, counted as the log counts.

    Args:
        recording: What to write.
        path: The file; replaced.

    Returns:
        Entity -> number of instants logged (1 for what is static).

    Raises:
        InputError: The library ``rerun-sdk`` is not installed.
        InfrastructureError: The disk refuses.
    """
    rr = require_rerun()
    with atomic_file(path) as partial:
        facts = json.dumps([recording.name, *recording.facts.items()])
        stream = rr.RecordingStream(
            "simrun", recording_id=hashlib.sha256(facts.encode()).hexdigest()[:32]
        )
        rr.set_log_time_enabled(False, recording=stream)  # one time line: that of the drive
        rr.set_log_tick_enabled(False, recording=stream)
        writer = _Writer(rr, stream)
        stream.save(partial, default_blueprint=_layout(rr, recording))
        writer.write(recording)
        stream.flush()
        stream.disconnect()
    return writer.counts


def require_rerun() -> Any:
    """Import the library; see `require_library`."""
    return require_library(
        "rerun",
        "--rrd",
        "install the extra [rerun], or pip install rerun-sdk (half a gigabyte)",
    )


class _Writer:
    """Logs a recording into a stream, and counts."""

    def __init__(self, rr: Any, stream: Any) -> None:
        self._rr, self._stream = rr, stream
        self.counts: dict[str, int] = {}

    def write(self, recording: Recording) -> None:
        """Log everything."""
        rr, stream = self._rr, self._stream
        stream.send_recording_name(recording.name)
        for name, text in {**recording.facts, "notes": "\n".join(recording.notes)}.items():
            stream.send_property(name, rr.AnyValues(text=text))
        self._static("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        for kind, rgba in MAP.items():
            lines = [line.points for line in recording.lines if line.kind == kind]
            if lines:
                self._static(
                    ["world", "map", kind],
                    rr.LineStrips3D(lines, colors=as_bytes(rgba), radii=THIN_M),
                )
        for number, drive in enumerate(recording.drives):
            self._drive(drive, of_renderer(number))

    def _drive(self, drive: Drive, rgba: Rgba) -> None:
        rr = self._rr
        base = ["world", drive.renderer]
        log = drive.log
        self._box([*base, "ego"], log.ego_box, log.ego, log.ego.t_us, drive.renderer, rgba)
        for name, actor in log.actors.items():
            self._box(
                [*base, "road users", name],
                actor.box,
                actor.track,
                log.ego.t_us,
                f"{actor.label} {name}",
                ROAD_USER,
            )
        self._static(
            [*base, "path"],
            rr.LineStrips3D([drive.rig.xyz], colors=as_bytes(fainter(rgba, 0.6)), radii=THIN_M),
        )
        self._poses([*base, "rig"], drive.rig)
        for plan in log.plans:
            lines = [plan.trajectory.xyz, *(one.xyz for one in plan.samples)]
            colors = [as_bytes(rgba), *([as_bytes(fainter(rgba, 0.35))] * len(plan.samples))]
            radii = [THICK_M, *([THIN_M] * len(plan.samples))]
            self._at(
                plan.now_us, [*base, "plan"], rr.LineStrips3D(lines, colors=colors, radii=radii)
            )
        for camera in drive.cameras:
            self._camera([*base, "rig", camera.name], camera)
        for name, (t_us, value) in drive.metrics.items():
            finite, parts = np.isfinite(value), ["metrics", name, drive.renderer]
            if finite.any():
                self._columns(parts, t_us[finite], rr.Scalars.columns(scalars=value[finite]))
                self._stream.log(
                    self._path(parts),
                    rr.SeriesLines(colors=as_bytes(rgba), names=parts[-1]),
                    static=True,
                )
        for at_us, text in drive.events:
            self._at(at_us, ["events", drive.renderer], rr.TextLog(text, level="WARN"))

    def _box(
        self, parts: list[str], box: Box, track: Trajectory, steps: I64, label: str, rgba: Rgba
    ) -> None:
        """Log a box that moves; it appears and goes as the log's steps ``(T,)`` have a pose of
        it.
        """
        half = [[box.length_m / 2, box.width_m / 2, box.height_m / 2]]
        there = present(track, steps) >= 0
        changed = np.flatnonzero(there != np.concatenate([[False], there[:-1]]))
        for k in changed.tolist():
            shown = self._rr.Boxes3D(
                half_sizes=half, colors=as_bytes(rgba), labels=[label], show_labels=False
            )
            self._at(int(steps[k]), parts, shown if there[k] else self._rr.Clear(recursive=False))
        self._poses(parts, track)

    def _poses(self, parts: list[str], track: Trajectory) -> None:
        xyzw = track.quat[:, [1, 2, 3, 0]]
        columns = self._rr.Transform3D.columns(translation=track.xyz, quaternion=xyzw)
        self._columns(parts, track.t_us, columns)

    def _camera(self, parts: list[str], camera: Camera) -> None:
        rr, spec = self._rr, camera.spec
        if spec is not None:
            place = spec.T_rig_camera
            self._static(
                parts,
                rr.Transform3D(
                    translation=place[:3, 3],
                    quaternion=quat_from_matrix(place[:3, :3])[[1, 2, 3, 0]],
                ),
            )
            pinhole = rr.Pinhole(
                image_from_camera=spec.K,
                width=spec.width,
                height=spec.height,
                camera_xyz=rr.ViewCoordinates.RDF,
            )
            self._stream.log(self._path(parts), pinhole, static=True)
        for one in camera.pictures():
            self._at(
                one.t_us,
                [*parts, "image"],
                rr.EncodedImage(contents=one.data, media_type=one.media_type),
            )

    def _path(self, parts: list[str] | str) -> str:
        return parts if isinstance(parts, str) else str(self._rr.new_entity_path(parts))

    def _static(self, parts: list[str] | str, what: Any) -> None:
        self._stream.log(self._path(parts), what, static=True)
        self._count(parts, 1)

    def _at(self, t_us: int, parts: list[str], what: Any) -> None:
        self._stream.set_time(TIMELINE, duration=np.timedelta64(t_us * NS_PER_US, "ns"))
        self._stream.log(self._path(parts), what)
        self._count(parts, 1)

    def _columns(self, parts: list[str], t_us: I64, columns: Any) -> None:
        times = self._rr.TimeColumn(TIMELINE, duration=(t_us * NS_PER_US).astype("timedelta64[ns]"))
        self._stream.send_columns(self._path(parts), [times], columns)
        self._count(parts, len(t_us))

    def _count(self, parts: list[str] | str, number: int) -> None:
        name = self._path(parts)
        self.counts[name] = self.counts.get(name, 0) + number


def _layout(rr: Any, recording: Recording) -> Any:
    """Return the first view of a file: what each renderer did from above, what its cameras saw, and
    a few metrics.
    """
    bp = import_module("rerun.blueprint")
    columns = []
    for drive in recording.drives:
        own = f"/{rr.new_entity_path(['world', drive.renderer])}".replace("//", "/")
        scene = bp.Spatial3DView(
            name=drive.renderer,
            origin="/world",
            contents=["/world/map/**", f"{own}/**", f"- {own}/rig/**"],
        )
        cameras = [
            bp.Spatial2DView(
                name=f"{drive.renderer} {camera.name}",
                origin=f"{own}/rig/{rr.escape_entity_path_part(camera.name)}",
            )
            for camera in drive.cameras
        ]
        columns.append(
            bp.Vertical(scene, bp.Tabs(*cameras), row_shares=[3, 2]) if cameras else scene
        )
    known = [
        name
        for name in METRICS.first_curves()
        if any(name in drive.metrics for drive in recording.drives)
    ]
    others = sorted({name for drive in recording.drives for name in drive.metrics} - set(known))
    curves = [
        bp.TimeSeriesView(name=name, origin=f"/metrics/{rr.escape_entity_path_part(name)}")
        for name in [*known, *others]
    ]
    below = [bp.Tabs(*curves)] if curves else []
    return bp.Blueprint(
        bp.Vertical(bp.Horizontal(*columns), *below, row_shares=[3, 1] if below else None),
        collapse_panels=True,
    )
