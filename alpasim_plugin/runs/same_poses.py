"""Store what the other renderers of a run show at the last poses of its first failures."""

import base64
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

from alpasim_plugin.core.errors import InputError, SimrunError
from alpasim_plugin.core.files import read_json_object
from alpasim_plugin.core.files.atomic import write_json
from alpasim_plugin.core.files.inputs import Inputs
from alpasim_plugin.core.parts import RendererSpec
from alpasim_plugin.core.parts.source import package_digest
from alpasim_plugin.core.types import RolloutLog
from alpasim_plugin.log import encode_image, read_asl
from alpasim_plugin.log.debug import WIDTH_PX
from alpasim_plugin.log.images import smaller
from alpasim_plugin.log.run_folder.manifests import read_manifest
from alpasim_plugin.log.run_folder.records import Manifest
from alpasim_plugin.log.run_folder.schema import LOG_NAME, SAME_POSES
from alpasim_plugin.runs.cameras import logged_request
from alpasim_plugin.runs.guards import checked_frames
from alpasim_plugin.runs.local_executor import apart
from alpasim_plugin.runs.plan import Cell, RunPlan
from alpasim_plugin.runs.renderer import make_renderer
from evaluators.metrics.outcomes import first_failure

MOST_FAILURES = 3
FRAMES = 10  # before the failure, one after the other: a fixer has a history


def store_same_poses(
    plan: RunPlan, root: Path, manifests: Sequence[Manifest], threads: int
) -> None:
    """Write ``same_poses.json`` for the first failures of a run with several renderers: by renderer,
    time and JPEG of each image in base64, of the policy's first camera. A file that was made of the
    same log and renderers is kept.

    A renderer that works in blocks of frames, or that fails, is left out.
    """
    if len(plan.renderers) < 2:
        return
    cells = {cell.folder.as_posix(): cell for cell in plan.cells}
    # As they are stored: with the digests of the rollouts' files, which belong to the key.
    stored = [read_manifest(root / manifest.path) for manifest in manifests]
    failures = [manifest for manifest in stored if manifest.ok]
    failures = [manifest for manifest in failures if first_failure(manifest.events)]
    for manifest in failures[:MOST_FAILURES]:
        cell = cells[manifest.path]
        path = root / cell.folder / SAME_POSES
        key = images_key(plan, cell, manifest, stored)
        if _key_in(path) == key:
            continue
        log = read_asl(root / cell.folder / LOG_NAME)
        failure = first_failure(manifest.events)
        failed_us = 0 if failure is None else failure.t_us
        work = partial(_images, plan, cell, log=log, failed_us=failed_us, threads=threads)
        others = [spec for spec in plan.renderers if spec.name != cell.renderer.name]
        images_by_renderer = {spec.name: _images_apart(work, spec, threads) for spec in others}
        images = {name: images for name, images in images_by_renderer.items() if images}
        write_json(path, {"key": key, "images": images})


def _images_apart(
    work: Callable[[RendererSpec], list[tuple[int, str]]], spec: RendererSpec, threads: int
) -> list[tuple[int, str]]:
    """Return the images of a renderer, a user's in a process of its own; none where it fails: its
    own rollouts show the error.
    """
    is_users = any(part is not None and part.is_users for part in (spec.base, spec.fixer))
    with suppress(SimrunError):
        return apart(work, spec, spec.name if is_users else "", threads)
    return []


def images_key(
    plan: RunPlan,
    cell: Cell,
    manifest: Manifest,
    manifests: Sequence[Manifest],
) -> str:
    """Return the key of the images of a failure: of the log, of what the other renderers are and
    read, and of the rollouts of those that have no digest.
    """
    inputs = Inputs()
    inputs.setting("simrun", package_digest())
    inputs.setting("scene", cell.content_hash)
    inputs.setting("device", plan.options.device)
    inputs.setting("log", manifest.files[LOG_NAME]["sha256"])
    inputs.setting("renderers", {spec.name: spec.digest for spec in plan.renderers})
    remote = {spec.name for spec in plan.renderers if spec.digest is None}
    driven = [
        (other.path, other.files[LOG_NAME]["sha256"] if LOG_NAME in other.files else None)
        for other in manifests
        if other.renderer in remote and other.scene == cell.scene
    ]
    inputs.setting("rollouts of remote renderers", driven)
    # What renderers read by themselves is known from their rollouts of the scene.
    read = [sorted(other.inputs.values()) for other in manifests if other.scene == cell.scene]
    inputs.setting("files that rollouts read", read)
    return inputs.key


def _key_in(path: Path) -> str | None:
    """Return the key of the images in a file; None where there are none, or it is damaged."""
    if not os.path.exists(path):
        return None
    with suppress(InputError):
        return str(read_json_object(path).get("key"))
    return None


def _images(
    plan: RunPlan, cell: Cell, spec: RendererSpec, log: RolloutLog, failed_us: int, threads: int
) -> list[tuple[int, str]]:
    """Return time and image of a renderer at the last logged frames up to an instant."""
    scenario = plan.scenarios[cell.scene]
    cameras = {camera.name: camera for camera in scenario.cameras}
    first = next((image.camera for image in log.images), None)
    until = [image for image in log.images if image.camera == first and image.end_us <= failed_us]
    if not until:
        return []  # the policy has no camera, or the log no images
    images = []
    renderer = make_renderer(spec, scenario, cell.seed, plan.options.device, threads)
    for image in until[-FRAMES:] if renderer.block is None else ():
        request = logged_request(log, cameras[image.camera], image.end_us)
        frame = checked_frames(renderer, [request])[0]
        data = encode_image(smaller(frame.rgb, WIDTH_PX), "jpeg", 85)
        images.append((image.end_us, base64.b64encode(data).decode()))
    return images
