"""Measure what `simrun serve` does to a frame: rolling shutters, batches of cameras, and the truth
gate of the map.

python docs/scripts/served_frames.py shutter SCENARIO WIDTH HEIGHT [--turn DEG_S]    bands against rows: time and error
python docs/scripts/served_frames.py batch                                          cameras one by one and in one pass
python docs/scripts/served_frames.py gate SCENARIO...                               agreement of right and wrong maps
python docs/scripts/served_frames.py truth AlpaSim_RUN CLEAN_PORT PORT...           served frames of its requests against the truth
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np

from alpasim_plugin.alpasim.bridge.client import RendererClient
from alpasim_plugin.alpasim.server import map_gate
from alpasim_plugin.core.geometry import interpolate, se2
from alpasim_plugin.core.image_metrics import psnr_db
from alpasim_plugin.core.shutter import bands, bands_of, rolling
from alpasim_plugin.core.types import (
    F64,
    CameraSpec,
    Degradation,
    Exposure,
    Frame,
    RenderRequest,
    Scenario,
)
from alpasim_plugin.fixers import fixer_settings, make_fixer
from alpasim_plugin.fixers.semantic_map.draw import draw_map
from alpasim_plugin.fixers.semantic_map.prepare import (
    ActorBox,
    PreparedMap,
    actor_boxes,
    prepare_map,
)
from alpasim_plugin.gaussians.raster.output import RasterOutput
from alpasim_plugin.log.asl import AslReader
from alpasim_plugin.log.images import decode_image
from alpasim_plugin.log.wire import sensorsim_pb2
from alpasim_plugin.renderers import rolling as drawing
from alpasim_plugin.renderers.gaussian import CleanRenderer, SurrogateRenderer, clear_cache
from scenarios.load import load_scenario

SHUTTER_US = 30_000
Placed = tuple[PreparedMap, F64, list[ActorBox]]


def best_ms(call: Callable[[], object], times: int = 3) -> float:
    """Return the shortest of some times."""
    took = []
    for _ in range(times):
        began = time.perf_counter()
        call()
        took.append(time.perf_counter() - began)
    return 1000 * min(took)


def sized(scenario: Scenario, width: int, height: int) -> CameraSpec:
    """Return the scenario's camera at another size, as wide."""
    camera = scenario.cameras[0]
    K = camera.K.copy()
    K[:2] *= width / camera.width
    K[1, 2] = height / 2
    return CameraSpec(camera.name, width, height, K, camera.T_rig_camera)


def boxes_at(scenario: Scenario, t_us: int, before_us: int = 0) -> dict[str, F64]:
    """Return the road users that are there at a time and ``before_us`` earlier, as they were
    then.
    """
    present = [
        a
        for a in scenario.actors
        if a.track.t_us[0] <= t_us - before_us and t_us <= a.track.t_us[-1]
    ]
    return {a.actor_id: interpolate(a.track, t_us - before_us) for a in present}


def shutter(name: str, width: int, height: int, turn_deg_s: float) -> None:
    """Print a row for every number of bands."""
    scenario = load_scenario(name)
    spec, scene = sized(scenario, width, height), CleanRenderer(scenario, 0, "cpu", 1).scene
    t_us = scenario.start_us + 2_000_000
    turn = np.deg2rad(turn_deg_s) * SHUTTER_US * 1e-6
    start = interpolate(scenario.ego_log, t_us - SHUTTER_US) @ se2(0, 0, -turn) @ spec.T_rig_camera
    end = interpolate(scenario.ego_log, t_us) @ spec.T_rig_camera
    early = {key: T for key, T in boxes_at(scenario, t_us, SHUTTER_US).items()}
    exposure = Exposure(rolling(width, height, "rows", backwards=False), early)
    users = {key: T for key, T in boxes_at(scenario, t_us).items() if key in early}
    request = RenderRequest(t_us, spec, np.stack([start, end]), users, exposure=exposure)

    def draw(camera: drawing.PinholeCamera, actors: drawing.Mapping[str, F64]) -> RasterOutput:
        return scene.render(camera, actors, 1, sky_in_alpha=True)

    truth = drawing.plain_draw_request(request, draw)

    def row(label: str, asked: RenderRequest) -> None:
        out = drawing.draw_request(asked, draw, "cpu")
        error = np.abs(out.rgb - truth.rgb) * 255
        psnr = 20 * np.log10(255 / np.sqrt(np.mean(error**2)))
        ms = best_ms(lambda: drawing.draw_request(asked, draw, "cpu"))
        print(f"| {label} | {ms:.0f} | {psnr:.1f} | {np.quantile(error, 0.999):.1f} |", flush=True)

    row("the shutter's end", replace(request, exposure=None))
    chosen = len(bands(request))
    for count in sorted({1, 2, 4, 8, 16, 32, chosen}):
        drawing.bands = lambda r, n=count: list(bands_of(r, n))
        row(f"{count} bands" + (" (chosen)" if count == chosen else ""), request)


def batch() -> None:
    """Print how long some cameras take one by one and together, and how far the pictures lie
    apart.
    """
    for precision in ("fp32", "bf16"):
        for cameras in (2, 4):
            for height, width in ((90, 160), (144, 256), (320, 576), (540, 960)):
                for references in (0, 2):
                    print(batch_row(precision, cameras, height, width, references), flush=True)


def batch_row(precision: str, cameras: int, height: int, width: int, references: int) -> str:
    """Return a row of the table of `batch`."""
    fixer = make_fixer(
        "onefixer",
        fixer_settings("onefixer", ["noise=content", f"precision={precision}"]),
        scene_id="x",
        threads=1,
    )
    rng = np.random.default_rng(0)
    block = []
    for i in range(cameras):
        coarse = rng.integers(0, 256, (height // 8 + 1, width // 8 + 1, 3), dtype=np.uint8)
        rgb = np.ascontiguousarray(coarse.repeat(8, 0).repeat(8, 1)[:height, :width])
        valid = np.full((height, width, 1), 255, np.uint8)
        beside = tuple(
            np.concatenate([np.roll(rgb, k + 1, 1), valid], axis=2) for k in range(references)
        )
        block.append(
            Frame(
                0,
                f"c{i}",
                rgb,
                np.minimum(2 * rng.random((height, width), dtype=np.float32), 1),
                references=beside,
            )
        )
    maps = [np.zeros((height, width, 3), np.uint8)] * cameras
    pasts = [None] * cameras
    alone = []
    together = []
    apart = 0
    for step in range(16):  # a shape is recorded after eight
        block = [
            replace(frame, t_us=1000 * (step + 1), rgb=np.roll(frame.rgb, 3, 1)) for frame in block
        ]
        began = time.perf_counter()
        single = []
        for i, frame in enumerate(block):
            fixed, pasts[i] = fixer.advance(frame, maps[i], pasts[i])
            single.append(fixed)
        alone.append(time.perf_counter() - began)
        began = time.perf_counter()
        joint = fixer.step(block, maps)
        together.append(time.perf_counter() - began)
        apart = max(
            apart,
            *(
                int(np.abs(a.rgb.astype(int) - b.rgb).max())
                for a, b in zip(single, joint, strict=True)
            ),
        )
    times = [1000 * min(took[10:]) for took in (alone, together)]
    return f"| {precision} | {cameras} | {width} x {height} | {references} | {times[0]:.0f} | {times[1]:.0f} | {apart} |"


def truth(run: Path, ports: list[str]) -> None:
    """Ask services at ``ports`` for what AlpaSim's runtime asked in the first drive of each scene;
    the first one has the truth.
    """
    with ExitStack() as stack:
        clients = [stack.enter_context(RendererClient(f"127.0.0.1:{port}")) for port in ports]
        for scene in sorted((run / "rollouts").iterdir()):
            log = AslReader(min(scene.rglob("rollout.asl")))
            calls = [
                e.batch_render_request
                for e in log
                if e.WhichOneof("log_entry") == "batch_render_request"
            ]
            found = []
            for call in calls:
                for item in call.items:
                    item.request.image_format = sensorsim_pb2.PNG
                right, *shown = (
                    client.render([item.request for item in call.items]) for client in clients
                )
                found.append(
                    [
                        [
                            psnr_db(decode_image(one[name]), decode_image(right[name]))
                            for name in right
                        ]
                        for one in shown
                    ]
                )
            gains = np.array(found).mean(axis=2)
            print(
                f"| {scene.name} | {len(calls)} | {' | '.join(f'{mean:.2f}' for mean in gains.mean(axis=0))} |",
                flush=True,
            )


def gate(names: list[str]) -> None:
    """Print shares of frames in which the map is contradicted, by renderer and by what is wrong
    with the map.
    """
    counts: dict[tuple[str, str], list[str]] = {}
    for renderer, case, found in gate_cases(names):
        counts.setdefault((renderer, case), []).append(found)
    for (renderer, case), found in counts.items():
        shares = [found.count(what) / len(found) for what in ("off", "unsure")]
        print(f"| `{renderer}` | {case} | {len(found)} | {shares[0]:.0%} | {shares[1]:.0%} |")


def gate_cases(names: list[str]) -> Iterator[tuple[str, str, str]]:
    """Yield renderer, what is wrong with the map, and ``on``, ``off`` or ``unsure``: its lines are
    found nowhere.
    """
    other: Placed | None = None
    for name in names:
        scenario = load_scenario(name)
        spec, scene_map = sized(scenario, 480, 270), prepare_map(scenario.lane_map)
        surrogate = SurrogateRenderer(
            replace(scenario, degradation=Degradation(kind="surrogate")), 0, "cpu", 1
        )
        renderers = {"clean": CleanRenderer(scenario, 0, "cpu", 1), "3dgs": surrogate}
        for share in (0.15, 0.5, 0.85):
            t_us = int(scenario.start_us + share * (scenario.ego_log.t_us[-1] - scenario.start_us))
            rig, users = interpolate(scenario.ego_log, t_us), boxes_at(scenario, t_us)
            boxes = list(actor_boxes(users, scenario.actors))
            for aside_m in (0.0, 1.0):

                def seen(
                    left_m: float,
                    yaw_deg: float = 0.0,
                    rig: F64 = rig,
                    aside_m: float = aside_m,
                    spec: CameraSpec = spec,
                ) -> F64:
                    return rig @ se2(0, aside_m + left_m, np.deg2rad(yaw_deg)) @ spec.T_rig_camera

                maps: dict[str, Placed] = {
                    "right": (scene_map, seen(0), boxes),
                    "half a lane to the right": (scene_map, seen(1.75), boxes),
                    "half a lane to the left": (scene_map, seen(-1.75), boxes),
                    "0.9 m aside": (scene_map, seen(0.9), boxes),
                    "turned by 6 degrees": (scene_map, seen(0, 6), boxes),
                } | ({} if other is None else {"of another street": other})
                request = RenderRequest(t_us, spec, np.stack([seen(0)] * 2), users)
                for label, renderer in renderers.items():
                    rgb = renderer.render(request).rgb
                    for case, (drawn, T, there) in maps.items():
                        yield label, case, verdict(drawn, spec, T, there, rgb, aside_m)
        other = scene_map, seen(0), boxes
        clear_cache()


def verdict(
    scene_map: PreparedMap,
    spec: CameraSpec,
    T: F64,
    boxes: list[ActorBox],
    rgb: np.ndarray,
    beside_m: float,
) -> str:
    """Return what the gate says of a map; the picture was taken ``beside_m`` to the left of the
    recorded path.
    """
    if map_gate.contradiction(scene_map, spec, T, boxes, rgb, beside_m, 1):
        return "off"
    lines = map_gate.line_pixels(draw_map(scene_map, spec, T, threads=1))
    here = map_gate.agreement(map_gate.pieces_of(lines), map_gate.top_hat(rgb))
    return "unsure" if here is None or here < map_gate.DOUBT else "on"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=["shutter", "batch", "gate", "truth"])
    parser.add_argument("rest", nargs="*")
    parser.add_argument("--turn", type=float, default=0.0)
    given = parser.parse_args()
    if given.what == "shutter":
        shutter(given.rest[0], int(given.rest[1]), int(given.rest[2]), given.turn)
    elif given.what == "batch":
        batch()
    elif given.what == "truth":
        truth(Path(given.rest[0]), given.rest[1:])
    else:
        gate(given.rest)
