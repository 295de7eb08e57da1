"""Import a drive: read it, place it, fit it, and write the folder that scenarios are loaded from.
Read `import_drive` downwards.
"""

import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from alpasim_plugin.cameras.lens import projected
from alpasim_plugin.core.devices import implementation, require_device
from alpasim_plugin.core.errors import InputError, SimrunError
from alpasim_plugin.core.files import content_of, read_json, read_json_object
from alpasim_plugin.core.files.atomic import write_bytes, write_json, write_text
from alpasim_plugin.core.files.images import PNG
from alpasim_plugin.core.files.inputs import Inputs
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.core.parts.source import package_digest
from alpasim_plugin.core.types import F64, Actor, CameraSpec, LaneMap
from alpasim_plugin.drives.held_out import fitted_part, held_out, measured
from alpasim_plugin.drives.obstacles import standing_obstacles
from alpasim_plugin.drives.opening import read_source
from alpasim_plugin.drives.placing import (
    NO_MAP,
    PlacedDrive,
    check_motion,
    given_map,
    place,
)
from alpasim_plugin.drives.points import road_points, triangulated, with_corrected_poses
from alpasim_plugin.drives.quality import IMAGES, measure, require_covered, write_page
from alpasim_plugin.drives.source import Points, SourceDrive, checked
from alpasim_plugin.gaussians.files.ply import write_points
from alpasim_plugin.gaussians.fit.drive import FITTING, FittedDrive, fit_drive
from alpasim_plugin.gaussians.fit.photographs import PosedPhotograph, resized
from alpasim_plugin.gaussians.fit.recipe import SplatRecipe
from alpasim_plugin.gaussians.fit.reconstruction import Reconstruction
from alpasim_plugin.gaussians.fit.start import cloud_from_points
from alpasim_plugin.gaussians.fit.trial import Trial
from alpasim_plugin.gaussians.fit.views import PosedView
from alpasim_plugin.gaussians.lens_camera import LensCamera
from alpasim_plugin.gaussians.scene.log_views import actors_at
from scenarios.drive import MODEL_FOLDER, TRANSFORMS_FILE, read_drive, write_drive
from scenarios.map_lines import corridor
from scenarios.measured import measured_range
from scenarios.recorded import RecordedLog

SCENARIO_FILE = "scenario.yaml"
KEY_FILE = "import.json"
FIT_FOLDER = "fit"
POINTS_FILE = "points.ply"
FIT_PX = 608  # least longer side of fitted views; half of the photograph's where that is more
RENDER_PX = 640  # most of the longer side of the scenario's cameras
SIDE_PX = 16  # what the sides of these cameras are multiples of, as fixers need
SEED = 0  # of the fit
SHORT_US = 2_000_000  # a shorter log is driven from its first pose on
STRAIGHT_ON_GPU = (
    "photographs with distortion were freed of it before the fit, which cuts their borders: a GPU draws "
    "pinholes alone, --device cpu fits whole photographs"
)
THIN_MODEL_HINT = (
    "Check that the poses belong to the photographs, and give photographs that overlap and show the "
    "road: a policy would drive through nothing."
)
PREVIEW_NOTE = "a preview: its fit had done a quarter of the updates"
# Stage, how much is done, how much there is; of 0 the stage is a sentence for the user.
Report = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class PlacedPhotograph:
    """A photograph of the drive in the scenario's world.

    Attributes:
        source: The photograph as it was read.
        camera: Its camera's name in the scenario.
        use: ``fitted``, ``held-out`` or ``never-fitted``.
        T_world_camera: ``(4, 4)``.
        file: Where it lies in the imported folder.
    """

    source: PosedPhotograph
    camera: str
    use: str
    T_world_camera: F64
    file: str

    @property
    def name(self) -> str:
        """Return its name as a view: camera and number, which sorts along the way."""
        return f"{self.camera}-{Path(self.file).stem}"

    def view(self, through_lens: bool) -> PosedView:
        """Return it as a view of the width that is fitted: whole, through its lens, or without its
        distortion.
        """
        placed = replace(self.source, T_world_camera=self.T_world_camera)
        full = placed.whole_view() if through_lens else placed.view()
        whole = full.camera.width
        width = max(min(whole, FIT_PX * whole // max(whole, full.camera.height)), -(-whole // 2))
        small = resized(full, width + width % 2) if width < full.camera.width else full
        return replace(small, name=self.name)


def import_drive(
    folder: Path,
    out: Path,
    camera_height_m: float | None = None,
    lane_map: Path | None = None,
    report: Report | None = None,
    device: str = "cpu",
    steps: int | None = None,
) -> JsonObject:
    """Make a scenario of a recorded drive.

    After a quarter of the updates of its fit, a scenario of the street as it is then is written
    beside ``out``: `preview_folder`. It can be driven while the fit goes on.

    Args:
        folder: The recording.
        out: Becomes the scenario's folder, once everything is there; the same call goes on where an
            earlier one stopped.
        camera_height_m: Of the front camera above the ground, for poses without a unit; None
            assumes one.
        lane_map: OpenDRIVE map in the drive's coordinates; None makes a corridor of the driven
            path.
        report: Called as the work goes on.
        device: Where to fit.
        steps: Updates of the fit; None takes those of `SplatRecipe.street`.

    Returns:
        What ``quality.json`` holds.

    Raises:
        InputError: Anything wrong with the recording, its model covers nearly nothing of what the
            cameras see, or ``out`` is something else; nothing is left behind then.
        InfrastructureError: The disk refuses, or there is no such device.
    """
    require_device(device)
    tell = report or (lambda stage, done, all: None)
    with working_folder(out) as work:
        drive, key = read_inputs(folder, camera_height_m, lane_map, device, steps)
        if os.path.exists(out):
            return finished(out, key)
        recipe = SplatRecipe.street()
        recipe = recipe if steps is None else replace(recipe, steps=steps)
        tell(
            f"{len(drive.photographs)} photographs; how long their fit takes is said before it begins",
            0,
            0,
        )
        task = _Import(drive, folder, out, work, key, camera_height_m, lane_map, recipe, device)
        return _built(task, tell)


@dataclass(frozen=True)
class _Import:
    """What is imported, and where to."""

    drive: SourceDrive
    folder: Path
    out: Path
    work: Path
    key: str
    camera_height_m: float | None
    map_file: Path | None
    recipe: SplatRecipe
    device: str


def preview_folder(out: Path) -> Path:
    """Return where an import writes what it has after a quarter of the fit."""
    return out.with_name(f"{out.name}.preview")


def _expected(trial: Trial, device: str) -> str:
    """Say before a fit begins how long it takes, by a trial on this machine."""
    steps = trial.recipe.steps
    minutes = trial.seconds_until(steps) / 60
    return (
        f"the fit: {steps} updates, about {_minutes(minutes)} in all on this machine ({device}), as busy as it is now; "
        "more where many Gaussians are added"
    )


def _minutes(minutes: float) -> str:
    return f"{minutes:.0f} minutes" if minutes >= 1.5 else f"{max(60 * minutes, 1):.0f} seconds"


@contextmanager
def working_folder(out: Path) -> Iterator[Path]:
    """Yield the folder of the unfinished scenario, which becomes ``out`` at the end.

    After an `InputError`, which would come again, it is removed; after an interruption it is kept,
    so that the same import goes on from it.
    """
    work = out.with_name(f".{out.name}.unfinished")
    try:
        yield work
    except InputError:
        shutil.rmtree(work, ignore_errors=True)
        raise
    if not os.path.exists(out):
        work.replace(out)


def _built(task: _Import, tell: Report) -> JsonObject:
    """Place, fit and measure a drive, and write all of it into a working folder."""
    work = task.work
    map_file = task.map_file

    def placed_by(stride: int) -> tuple[SourceDrive, PlacedDrive]:
        tell("correcting poses", 0, 1)
        moved = with_corrected_poses(task.drive, stride)
        points = _points(fitted_part(moved, stride), task.folder, tell)
        return moved, place(moved, points, task.camera_height_m)

    drive, placed, stride = measured(placed_by)
    check_motion(drive, placed)
    roads, notes = (
        given_map(map_file, drive, placed)
        if map_file
        else (corridor(placed.ego, placed.ground), (NO_MAP,))
    )
    drive = replace(drive, notes=(*drive.notes, *notes))
    photographs = placed_photographs(drive, placed, stride)
    through_lens = implementation(task.device, True, False)
    if not through_lens and any(photograph.source.lens.bends for photograph in photographs):
        drive = replace(drive, notes=(*drive.notes, STRAIGHT_ON_GPU))
    begin(work, task.key)
    write_photographs(work, photographs, tell)
    actors = placed.actors
    views = _views_by_use(photographs, actors, through_lens)
    visible_ids = {name for view in views["fitted"] for name in _in_view(view)}

    def preview(street: FittedDrive) -> None:
        noted = replace(drive, notes=(*drive.notes, PREVIEW_NOTE))
        _write_preview(task, noted, placed, roads, street, photographs, views, tell)

    progress = _FitProgress(tell, task.device)
    near = placed.points.chosen(placed.points.spread < np.percentile(placed.points.spread, 90))
    done = fit_drive(
        views["fitted"],
        cloud_from_points(near.xyz, near.rgb),
        kept={view.name: view.camera for view in views["held-out"]},
        boxes={actor.actor_id: actor.box for actor in actors if actor.actor_id in visible_ids},
        scene_id=scene_id_of(drive),
        folder=work / FIT_FOLDER,
        seed=SEED,
        report=progress.show,
        preview=preview,
        trial=progress.say_time,
        recipe=task.recipe,
        device=task.device,
    )
    quality = write_folder(
        work, drive, placed, roads, done.model, photographs, views, done.exposures, tell
    )
    on_path = next(row for row in quality["coverage"] if row["lateral_m"] == 0.0)
    require_covered(task.folder, on_path["share"], THIN_MODEL_HINT)
    shutil.rmtree(work / FIT_FOLDER, ignore_errors=True)
    return quality


def _views_by_use(
    photographs: Sequence[PlacedPhotograph], actors: Sequence[Actor], through_lens: bool
) -> dict[str, list[PosedView]]:
    """Return photographs as views of the width that is fitted, by what they are used for."""
    views: dict[str, list[PosedView]] = {"fitted": [], "held-out": [], "never-fitted": []}
    for photograph in photographs:
        present = actors_at(actors, int(photograph.source.t_us or 0))
        views[photograph.use].append(replace(photograph.view(through_lens), actors=present))
    return views


@dataclass
class _FitProgress:
    """Tells how long a fit takes, and how much of that time has passed.

    Attributes:
        tell: Called with it.
        device: Where the fit is made.
        trial: What its updates take; None where that was not tried.
    """

    tell: Report
    device: str
    trial: Trial | None = None

    def say_time(self, trial: Trial) -> None:
        """Say how long the fit takes."""
        self.trial = trial
        self.tell(_expected(trial, self.device), 0, 0)

    def show(self, stage: str, done: int, all: int, numbers: Mapping[str, float]) -> None:
        """Show how much of a stage is done; of the fit, whose later updates take longer, by time."""
        share = done / max(all, 1)
        if stage == FITTING and self.trial is not None:
            share = self.trial.share_of(done)
        self.tell(stage, round(all * share), all)


def _write_preview(
    task: _Import,
    drive: SourceDrive,
    placed: PlacedDrive,
    roads: LaneMap,
    street: FittedDrive,
    photographs: Sequence[PlacedPhotograph],
    views: Mapping[str, Sequence[PosedView]],
    tell: Report,
) -> None:
    """Write a scenario of a street that is being fitted, and name it and an image of it. One of an
    earlier import is replaced; anything else in its place stays. What keeps a preview from being
    written is said, and the fit goes on.
    """
    target = preview_folder(task.out)
    if os.path.exists(target) and not os.path.isfile(target / KEY_FILE):
        tell(f"no preview is written: {target} is there", 0, 0)
        return
    tell("writing a preview", 0, 1)
    try:
        if os.path.exists(target):
            shutil.rmtree(target)
        _write_preview_folder(target, task, drive, placed, roads, street, photographs, views)
    except (OSError, SimrunError) as error:
        tell(f"no preview is written: {error}", 0, 0)
        return
    images = sorted((target / IMAGES).glob("*.jpg"))
    look = f"look at {images[0]} (photograph above, street below), " if images else ""
    drive_it = f"drive it with: simrun --renderer 3dgs {target / SCENARIO_FILE}"
    tell(f"a quarter of the updates is done: {look}{drive_it}", 0, 0)


def _write_preview_folder(
    target: Path,
    task: _Import,
    drive: SourceDrive,
    placed: PlacedDrive,
    roads: LaneMap,
    street: FittedDrive,
    photographs: Sequence[PlacedPhotograph],
    views: Mapping[str, Sequence[PosedView]],
) -> None:
    """Write the folder of a preview, whose photographs are those of the import."""
    with working_folder(target) as folder:
        begin(folder, f"preview of {task.key}")
        for photograph in photographs:
            _link(task.work / photograph.file, folder / photograph.file)
        write_folder(
            folder,
            drive,
            placed,
            roads,
            street.model,
            photographs,
            views,
            street.exposures,
            lambda stage, done, all: None,
        )


def _link(file: Path, other: Path) -> None:
    """Let a file have a second name, or copy it where the disk has no such names."""
    other.parent.mkdir(parents=True, exist_ok=True)
    if os.path.exists(other):
        return
    try:
        os.link(file, other)
    except OSError:
        shutil.copyfile(file, other)


def write_folder(
    work: Path,
    drive: SourceDrive,
    placed: PlacedDrive,
    roads: LaneMap,
    model: Reconstruction,
    photographs: Sequence[PlacedPhotograph],
    views: Mapping[str, Sequence[PosedView]],
    exposures: Mapping[str, tuple[float, float, float]],
    tell: Report,
) -> JsonObject:
    """Find what stands in a model, measure it, and write everything of an imported drive but its
    photographs.

    Args:
        work: The folder.
        drive, placed: The recording, as read and in the world.
        roads: Its map, or the corridor.
        model: Its reconstruction.
        photographs: The photographs, which lie in the folder.
        views: Use of the photographs to them as views; of the fitted ones only the cameras matter.
        exposures: Of each fitted view by its name.
        tell: Called as the work goes on.

    Returns:
        What ``quality.json`` holds.
    """
    scene_id = scene_id_of(drive)
    model.save(work / MODEL_FOLDER, {"scene_id": scene_id, "views": len(views["fitted"])})
    standing = standing_obstacles(
        model.background, placed.points, placed.ground, placed.ego, drive.vehicle
    )
    log = _log(drive, placed, roads, scene_id)
    write_points(
        work / POINTS_FILE,
        placed.points.xyz,
        np.rint(placed.points.rgb * 255).clip(0, 255).astype(np.uint8),
    )
    _write_transforms(work, photographs, exposures)
    write_drive(work, log, standing.obstacles)
    comparisons, coverage = measure(model, views, exposures, tell)
    written = read_drive(work)
    quality = write_page(
        work,
        drive,
        placed,
        standing,
        len(views["fitted"]),
        comparisons,
        coverage,
        measured_range(written, written.cameras),
    )
    write_text(work / SCENARIO_FILE, _scenario_text(drive, scene_id, int(log.ego_log.t_us[-1])))
    return quality


def _scenario_text(drive: SourceDrive, scene_id: str, length_us: int) -> str:
    """Return the scenario file of an imported drive of a length."""
    timing = ""
    if length_us < SHORT_US:
        timing = "timing: {start_us: 0, warmup_us: 0}  # a short recording: driven from its first pose on\n"
    return (
        f"# A recorded drive, imported from {drive.scene_id}; quality.md says how good it is.\n"
        f"version: 1\nscene_id: {scene_id}\ndescription: A recorded drive of {length_us / 1e6:.1f} s.\nlog: {{drive: .}}\n{timing}"
    )


def read_inputs(
    folder: Path,
    camera_height_m: float | None,
    lane_map: Path | None,
    device: str,
    steps: int | None = None,
) -> tuple[SourceDrive, str]:
    """Return the drive that an import reads, and the key of the import: everything that was read,
    and the options.
    """
    with Inputs() as inputs:
        drive = checked(read_source(folder), folder)
        enter(drive, inputs)
        inputs.setting("camera height", camera_height_m)
        inputs.setting("map", None if lane_map is None else content_of(lane_map))
        inputs.setting("device", device.partition(":")[0])
        if steps is not None:
            inputs.setting("steps", steps)
    return drive, inputs.key


def enter(drive: SourceDrive, inputs: Inputs) -> None:
    """Enter what an import takes from a drive beside the files that name its photographs: these,
    and the name of the scene, which is that of its folder.
    """
    inputs.setting("scene", drive.scene_id)
    for photograph in drive.photographs:
        content_of(photograph.file)


def finished(out: Path, key: str) -> JsonObject:
    """Return the quality of a finished import, or refuse another thing in its place."""
    if not os.path.isfile(out / SCENARIO_FILE) or not os.path.isfile(out / KEY_FILE):
        raise InputError(
            f"{out}: it exists and is no imported drive",
            "name a folder that does not exist yet",
        )
    stated = read_json(out / KEY_FILE)
    if stated.get("key") != key:
        raise InputError(
            f"{out}: it holds another import: of other files, or with other options",
            "name another folder, or remove this one first",
        )
    if stated.get("code") != package_digest():
        raise InputError(
            f"{out}: it was imported by another version of simrun",
            "drive on it as it is, or remove it first: the same command imports it again",
        )
    return read_json(out / "quality.json")


def begin(work: Path, key: str) -> None:
    """Make the working folder, or keep that of the same import by the same code; another one's is
    removed.
    """
    stated = {"key": key, "code": package_digest()}
    if os.path.exists(work) and (
        not os.path.isfile(work / KEY_FILE) or read_json_object(work / KEY_FILE) != stated
    ):
        shutil.rmtree(work)
    work.mkdir(parents=True, exist_ok=True)
    write_json(work / KEY_FILE, stated)


def _points(drive: SourceDrive, folder: Path, tell: Report) -> Points:
    """Return the points of a drive without what is held out, in its frame: given, or triangulated;
    and the road's own, which features miss.
    """
    front = drive.of(drive.front)
    if drive.points is not None:
        return drive.points
    tell("following points", 0, 1)
    points = triangulated(front, str(folder))
    tell("measuring the road", 0, 1)
    rough = place(drive, points)
    if rough.strip is None:
        return points
    T = rough.T_world_source
    return points.joined(
        road_points(front, rough.poses[drive.front], rough.strip).moved(
            np.asarray(np.linalg.inv(T), dtype=np.float64)
        )
    )


def placed_photographs(
    drive: SourceDrive, placed: PlacedDrive, stride: int
) -> list[PlacedPhotograph]:
    """Return all photographs with their names, uses and poses; one of ``stride`` is held out."""
    out = []
    for camera in drive.cameras:
        name = _name_of(drive, camera)
        held = held_out(drive, camera, stride)
        usual = "never-fitted" if camera in drive.never_fitted else "fitted"
        for i, photograph in enumerate(drive.of(camera)):
            use = "held-out" if held[i] else usual
            ending = photograph.file.suffix.lower() if photograph.data is None else ".jpg"
            if photograph.lens.bends or (
                photograph.data is not None and bytes(photograph.data[:4]) == PNG[:4]
            ):
                ending = ".png"
            file = f"photographs/{name}/{i:06d}{ending}"
            out.append(PlacedPhotograph(photograph, name, use, placed.poses[camera][i], file))
    return out


def write_photographs(work: Path, photographs: Sequence[PlacedPhotograph], tell: Report) -> None:
    """Write the photographs without distortion; those that have none are copied as they are."""
    for i, photograph in enumerate(photographs):
        path = work / photograph.file
        tell("writing photographs", i + 1, len(photographs))
        if os.path.isfile(path):
            continue
        path.parent.mkdir(parents=True, exist_ok=True)
        bends = photograph.source.lens.bends
        data = (
            cv2.imencode(".png", photograph.source.rgb()[..., ::-1])[1].tobytes()
            if bends
            else photograph.source.encoded()
        )
        write_bytes(path, data)


def _write_transforms(
    work: Path,
    photographs: Sequence[PlacedPhotograph],
    exposures: Mapping[str, tuple[float, float, float]],
) -> None:
    frames = []
    for photograph in photographs:
        lens = photograph.source.lens
        K = lens.straight_K()
        frame = {
            "file_path": photograph.file,
            "transform_matrix": photograph.T_world_camera.tolist(),
            "w": lens.width,
            "h": lens.height,
            "fl_x": K[0, 0],
            "fl_y": K[1, 1],
            "cx": K[0, 2],
            "cy": K[1, 2],
            "t_us": photograph.source.t_us,
            "camera": photograph.camera,
            "use": photograph.use,
        }
        if photograph.name in exposures:
            frame["exposure"] = list(exposures[photograph.name])
        frames.append(frame)
    document = {"axes": "opencv", "ply_file_path": POINTS_FILE, "frames": frames}
    write_json(work / TRANSFORMS_FILE, document)


def _log(drive: SourceDrive, placed: PlacedDrive, roads: LaneMap, scene_id: str) -> RecordedLog:
    only_moved = drive.metric is not None and np.allclose(placed.T_world_source[:3, :3], np.eye(3))
    # A turned frame has no origin to subtract.
    origin = placed.T_world_source[:3, 3] if only_moved else np.zeros(3)
    x, y, z = np.negative(origin).tolist()
    cameras = [
        _camera(drive, placed, name)
        for name in drive.cameras
        if name not in drive.never_fitted and name in placed.mounts
    ]
    return RecordedLog(
        scene_id,
        "drive",
        roads,
        placed.ground,
        placed.ego,
        drive.vehicle,
        placed.actors,
        tuple(cameras),
        (x, y, z),
        "",
        notes=(*drive.notes, *placed.notes),
    )


def _in_view(view: PosedView) -> list[str]:
    """Return the road users whose middle lies in an image."""
    camera = view.camera
    visible_ids = []
    for name, T in view.actors.items():
        middle = (camera.T_camera_world @ T[:, 3])[:3]
        if isinstance(camera, LensCamera):
            pixel, is_described = projected(camera.spec, middle[None])
            inside = (pixel >= 0) & (pixel < [camera.width, camera.height])
            if is_described[0] and inside.all():
                visible_ids.append(name)
            continue
        x, y, depth = middle
        column = camera.fx * x / depth + camera.cx
        row = camera.fy * y / depth + camera.cy
        if depth > 0 and 0 <= column < camera.width and 0 <= row < camera.height:
            visible_ids.append(name)
    return visible_ids


def _camera(drive: SourceDrive, placed: PlacedDrive, name: str) -> CameraSpec:
    """Return a camera of the rig at the size that it is rendered in: reduced, its height cut at the
    middle.
    """
    lens = drive.of(name)[0].lens
    width = (
        min(RENDER_PX * lens.width // max(lens.width, lens.height), lens.width) // SIDE_PX * SIDE_PX
    )
    scale = width / lens.width
    height = max(SIDE_PX, int(lens.height * scale) // SIDE_PX * SIDE_PX)
    K = np.diag([scale, scale, 1.0]) @ lens.straight_K()
    K[1, 2] -= (lens.height * scale - height) / 2
    return CameraSpec(
        _name_of(drive, name),
        width,
        height,
        K,
        placed.mounts[name],
    )


def _name_of(drive: SourceDrive, camera: str) -> str:
    """Return the name of a camera in the scenario, where the one that looks ahead is a front."""
    is_named = "front" in camera or "front" in drive.cameras
    return "front" if camera == drive.front and not is_named else camera


def scene_id_of(drive: SourceDrive) -> str:
    """Return a name that a scenario may have."""
    letters = "".join(
        character if character.isalnum() or character in "_.-" else "-"
        for character in drive.scene_id
    ).strip("-_.")
    return letters[:80] or "drive"
