"""Compare what a rig of large cameras shows behind renderers with the built street, drawn four times
as large and averaged, from beside the logged path.

    python docs/scripts/large_rig.py urban/one_way --rig alpasim-4 --times 2.5,4.0,5.5 --sheet sheet.jpg
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import cv2
import numpy as np

from alpasim_plugin import load_scenario, make_renderer
from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.lens import joined_image, sides_of
from alpasim_plugin.core.lens_cover import LensCover
from alpasim_plugin.fixers.warp import on_boxes, place_boxes
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.renderers.gaussian import scene_of
from alpasim_plugin.runs.cameras import recorded_requests

LARGER, LATERAL_M, BAND_PX = 4, 0.6, 120
PERIOD_US, FRAMES_BEFORE = 100_000, 2
RENDERERS = "clean", "3dgs", "onefixer"


def requests_at(scenario, t_us):
    """The requests of all cameras, the rig `LATERAL_M` to the left of its logged pose."""
    for request in recorded_requests(scenario, t_us):
        T_world_rig = request.T_world_camera[1] @ inverse(request.camera.T_rig_camera)
        shift = np.eye(4)
        shift[:3, 3] = LATERAL_M * T_world_rig[:3, 1]
        yield replace(request, T_world_camera=shift @ request.T_world_camera)


def drawn_large(graph, side, T_world_pinhole, actors):
    """The image of a pinhole with four times as many rows and columns."""
    width, height = side.cover
    K = np.diag([LARGER, LARGER, 1.0]) @ side.K
    camera = PinholeCamera.from_pose(LARGER * width, LARGER * height, K, T_world_pinhole)
    parts = []
    for first in range(0, height, BAND_PX):
        rows = slice(LARGER * first, LARGER * min(first + BAND_PX, height))
        window = camera.window(rows, slice(0, LARGER * width))
        parts.append(graph.render(window, actors).to_uint8())
    return np.concatenate(parts)


def truth_of(graph, request):
    """What the request's lens should show ``(H, W, 3)``: the mean of 16 samples a pixel."""
    camera = request.camera
    out = np.zeros((camera.height, camera.width, 3), np.float32)
    for side in sides_of(camera):
        T = request.T_world_camera[1] @ side.T_lens_pinhole
        large = drawn_large(graph, side, T, request.actors)
        if side.resample is None:
            return cv2.resize(large, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        for first in range(0, camera.height, BAND_PX):
            rows = slice(max(first - 1, 0), min(first + BAND_PX + 1, camera.height))
            count = min(BAND_PX, camera.height - first)
            place = cv2.resize(side.resample[rows], None, fx=LARGER, fy=LARGER)
            place = place[LARGER * (first - rows.start) :][: LARGER * count]
            seen = cv2.remap(
                large,
                (place + 0.5) * LARGER - 0.5,
                None,
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REPLICATE,
            )
            size = seen.shape[1] // LARGER, count
            mean = cv2.resize(seen, size, interpolation=cv2.INTER_AREA).astype(np.float32)
            weight = 1.0 if side.weight is None else side.weight[first : first + count, :, None]
            out[side.part][first : first + count] += weight * mean
    return out


def vehicles_of(scenario, request):
    """Which pixels look at the box of a road user ``(H, W)``."""
    boxes = {actor.actor_id: actor.box for actor in scenario.actors}
    masks, sides = [], sides_of(request.camera)
    for side in sides:
        shape = side.cover[1], side.cover[0]
        T = request.T_world_camera[1] @ side.T_lens_pinhole
        seen = place_boxes(shape, side.K, T, request.actors, boxes).seen
        masks.append(255 * on_boxes(shape, seen).astype(np.uint8))
    return joined_image(sides, masks) > 127


def decibels(error):
    """The PSNR of squared errors in grey levels; '-' of none."""
    return f"{10 * np.log10(255**2 / max(error.mean(), 1e-6)):.1f}" if error.size else "-"


def main():
    """Print one line for each frame, and write the sheet."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("scene")
    parser.add_argument("--rig", default="alpasim-4")
    parser.add_argument("--times", default="3.5", help="Seconds of the log.")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--sheet", help="An image of all frames, by renderer and camera.")
    given = parser.parse_args()
    scenario = load_scenario(given.scene, overrides=[f"cameras={{rig: {given.rig}}}"])
    cover = LensCover(scenario.cameras)
    pinholes = tuple(one for camera in scenario.cameras for one in cover.pinholes(camera))
    graph = scene_of(replace(scenario, cameras=pinholes))
    times_us = [round(float(t_s) * 1e6) for t_s in given.times.split(",")]
    start_us = int(scenario.ego_log.t_us[0])
    asked = {t: list(requests_at(scenario, start_us + t)) for t in times_us}
    truths = {t: [truth_of(graph, one) for one in asked[t]] for t in times_us}
    columns = [[truth for t in times_us for truth in truths[t]]]
    for name in RENDERERS:
        renderer = make_renderer(name, scenario, threads=given.threads)
        columns.append([])
        for t_us in times_us:
            for before in range(FRAMES_BEFORE, 0, -1):
                renderer.render_batch(
                    list(requests_at(scenario, start_us + t_us - before * PERIOD_US))
                )
            for request, truth in zip(asked[t_us], truths[t_us], strict=True):
                began, cpu = time.perf_counter(), time.process_time()
                (frame,) = renderer.render_batch([request])
                took, cpu = time.perf_counter() - began, time.process_time() - cpu
                error = ((frame.rgb.astype(np.float64) - truth) ** 2).mean(axis=2)
                vehicles = vehicles_of(scenario, request)
                print(
                    f"{given.scene} {t_us / 1e6:.1f} s {request.camera.name} {name}: "
                    f"{decibels(error)} dB, vehicles {decibels(error[vehicles])}, "
                    f"rest {decibels(error[~vehicles])}, {took:.2f} s, {cpu:.2f} CPU s",
                    flush=True,
                )
                columns[-1].append(frame.rgb)
        del renderer
    if given.sheet:
        tiles = [
            np.concatenate(
                [cv2.resize(image, (950, 540), interpolation=cv2.INTER_AREA) for image in row],
                axis=1,
            )
            for row in zip(*columns, strict=True)
        ]
        sheet = np.concatenate(tiles).clip(0, 255).astype(np.uint8)
        cv2.imwrite(given.sheet, sheet[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])


if __name__ == "__main__":
    main()
