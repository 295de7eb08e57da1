"""Labels of a pair sequence from its scene, kept on disk: what the simulator knows about some of
its frames.

FOLDER/SPLIT/SEQUENCE.npz   frames (F,), lanes (F, L, 29) metres or NaN, vehicles (F, B, 8) or NaN rows, T_rig_camera, K, size
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from alpasim_plugin.core.atomic import atomic_file
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import interpolate, inverse
from alpasim_plugin.core.reading import parsing
from alpasim_plugin.core.types import F64, I64, CameraSpec, Scenario
from alpasim_plugin.lab.learned_metrics.types import Cuboid, Lane3D
from alpasim_plugin.lab.training.learned_metrics.truth import (
    VEHICLES,
    lanes_seen,
    vehicles_seen,
    world_lines,
)
from alpasim_plugin.lab.training.pair_store import PairSequence
from scenarios.load import load_scenario

DOING = "labelling frames for a judge"
TRAINING_SPLITS = ("train", "val")  # a judge never sees a test scene before it is frozen
VERSION = 1
AWAY_M = 2.0  # pairs are rendered up to 1.5 m beside the recorded drive


@dataclass(frozen=True)
class Labels:
    """Truth of F frames of a sequence.

    Args:
        frames: ``(F,)`` numbers of the frames.
        lanes: ``(F, L, 29)`` lateral positions, metres, rig frame; NaN where not visible.
        vehicles: ``(F, B, 8)``: class number, x, y, z, length, height, width (metres), yaw
            (radians); NaN rows fill up.
        camera: Lens and mounting.
    """

    frames: I64
    lanes: F64
    vehicles: F64
    camera: CameraSpec

    def lanes_of(self, row: int) -> list[Lane3D]:
        """Return the lanes of a labelled frame."""
        return [Lane3D(line, 1.0) for line in self.lanes[row] if np.isfinite(line).any()]

    def cuboids_of(self, row: int) -> list[Cuboid]:
        """Return the vehicles of a labelled frame."""
        found = self.vehicles[row]
        return [
            Cuboid(VEHICLES[int(v[0])], 1.0, *(float(x) for x in v[1:]))
            for v in found
            if np.isfinite(v[0])
        ]


def sequence_labels(sequence: PairSequence, scenes: Path, kept: Path, every: int) -> Labels:
    """Return the truth of every n-th frame of a sequence, from disk where it is there.

    Args:
        sequence: Of the split ``train`` or ``val``, or of a test split when a frozen judge is
            measured.
        scenes: ROOT of the scenario files, ROOT/SPLIT/NAME.yaml.
        kept: Folder of the labels.
        every: Frames between two labelled ones.

    Raises:
        InputError: The scene is missing, or is not the one that the sequence was rendered from.
    """
    split = str(sequence.info.get("split", "train"))
    path = kept / split / f"{sequence.name}-{VERSION}-{every}-{sequence.content[:12]}.npz"
    if not path.is_file():
        labels = _make(sequence, scenes / split / f"{sequence.name}.yaml", every)
        path.parent.mkdir(parents=True, exist_ok=True)
        camera = labels.camera
        with atomic_file(path) as partial_path, partial_path.open("wb") as file:
            np.savez_compressed(
                file,
                frames=labels.frames,
                lanes=labels.lanes,
                vehicles=labels.vehicles,
                T_rig_camera=camera.T_rig_camera,
                K=camera.K,
                size=np.array([camera.width, camera.height]),
            )
    with (
        parsing(path, f"remove {path}; it is made again", "not whole labels"),
        np.load(path) as stored,
    ):
        width, height = (int(v) for v in stored["size"])
        camera = CameraSpec("camera", width, height, stored["K"], stored["T_rig_camera"])
        return Labels(stored["frames"], stored["lanes"], stored["vehicles"], camera)


def all_labels(
    sequences: Sequence[PairSequence],
    scenes: Path,
    kept: Path,
    every: int,
    jobs: int = 1,
    report: Callable[[int, int], None] | None = None,
) -> list[Labels]:
    """Return `sequence_labels` of many sequences, in order; ``report`` gets how many are done."""
    one = partial(sequence_labels, scenes=scenes, kept=kept, every=every)
    out: list[Labels] = []
    if jobs == 1:
        for labels in map(one, sequences):
            out.append(labels)
            if report is not None:
                report(len(out), len(sequences))
        return out
    with ProcessPoolExecutor(jobs) as pool:
        for labels in pool.map(one, sequences, chunksize=4):
            out.append(labels)
            if report is not None:
                report(len(out), len(sequences))
    return out


def for_training(sequences: Sequence[PairSequence]) -> tuple[PairSequence, ...]:
    """Return the sequences, all of which must belong to a training split.

    Raises:
        InputError: One is of a test split.
    """
    for sequence in sequences:
        if sequence.info.get("split", "train") not in TRAINING_SPLITS:
            raise InputError(
                f"{sequence.folder}: split {sequence.info.get('split')!r}",
                "train judges on the splits train and val only",
            )
    return tuple(sequences)


def _make(sequence: PairSequence, path: Path, every: int) -> Labels:
    if not path.is_file():
        raise InputError(
            f"{path}: no such scene",
            "give the folder of scenes that the pairs were rendered from",
        )
    scenario = load_scenario(path)
    clip = sequence.clip
    camera = next(
        (c for c in scenario.cameras if c.width == clip.rgb_gt.shape[2]), scenario.cameras[0]
    )
    _require_same_scene(scenario, camera, sequence, path)
    T_camera_rig = inverse(camera.T_rig_camera)
    lines = world_lines(scenario.lane_map)
    frames = np.arange(0, len(clip), every)
    lanes, vehicles = [], []
    for i in frames:
        T_world_camera = clip.T_world_camera[i]
        seen = lanes_seen(lines, T_world_camera @ T_camera_rig, camera)
        lanes.append(np.array([lane.lateral_m for lane in seen]).reshape(len(seen), -1))
        boxes = vehicles_seen(scenario, int(clip.t_us[i]), T_world_camera, camera)
        rows = [
            [
                VEHICLES.index(b.label),
                b.x_m,
                b.y_m,
                b.z_m,
                b.length_m,
                b.height_m,
                b.width_m,
                b.yaw_rad,
            ]
            for b in boxes
        ]
        vehicles.append(np.array(rows).reshape(len(rows), 8))
    return Labels(frames, _filled(lanes, 29), _filled(vehicles, 8), camera)


def _require_same_scene(
    scenario: Scenario, camera: CameraSpec, sequence: PairSequence, path: Path
) -> None:
    """Refuse a scene in which the sequence's camera cannot have stood: another lens, or a rig away
    from the recorded drive.

    The scene's hash is no test: it changes with the format of scenes, and pairs outlive it.
    """
    lens = sequence.info.get("camera", {}).get("K")
    clip = sequence.clip
    rig = clip.T_world_camera @ inverse(camera.T_rig_camera)
    recorded = interpolate(scenario.ego_log, clip.t_us)
    away = float(np.linalg.norm(rig[:, :3, 3] - recorded[:, :3, 3], axis=1).max())
    if (lens is not None and not np.allclose(lens, camera.K)) or away > AWAY_M:
        raise InputError(
            f"{path}: a camera of another lens, or up to {away:.1f} m from the recorded drive",
            "give the folder of scenes that the pairs were rendered from",
        )


def _filled(rows: Sequence[F64], width: int) -> F64:
    """Stack ``(n_i, width)`` arrays as ``(F, max n, width)``, filled with NaN."""
    out = np.full((len(rows), max((len(r) for r in rows), default=0), width), np.nan)
    for i, r in enumerate(rows):
        out[i, : len(r)] = r.reshape(len(r), width)
    return out
