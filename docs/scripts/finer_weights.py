"""Train how references are weighed in large images (`alpasim_plugin.fixers.network.finer_weights`).

python docs/scripts/finer_weights.py pairs FOLDER            # two to four CPU minutes a scene
python docs/scripts/finer_weights.py train FOLDER head.pt
python docs/scripts/finer_weights.py add head.pt onefixer.safetensors out.safetensors
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from safetensors import safe_open
from safetensors.torch import load_file, save_file

import alpasim_plugin.fixers.pixel_network as pixel_network
from alpasim_plugin import load_scenario, make_renderer
from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.fixers.gather import CPU
from alpasim_plugin.fixers.network.finer_weights import FinerWeights
from alpasim_plugin.fixers.network.reference_blend import (
    FINER_PX,
    HALF,
    BlendHeads,
    in_floats,
    larger,
    smaller,
    sources_of,
)
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.lab.training.scenes import write_scenes
from alpasim_plugin.renderers.gaussian import scene_of
from alpasim_plugin.runs.cameras import recorded_requests

SCENES, VAL = 14, ("avenue_002", "junction_straight_004")
WIDTH, HEIGHT, SCALE, LARGER = 896, 448, 7, 4
CAMERAS = ", ".join(
    f"{{name: {name}, width: {WIDTH}, height: {HEIGHT}, hfov_deg: 52.6, {mount}}}"
    for name, mount in (
        ("front", "x_m: 1.7, z_m: 1.45"),
        ("left", "x_m: 1.7, y_m: 0.9, z_m: 1.2, yaw_deg: 55"),
        ("right", "x_m: 1.7, y_m: -0.9, z_m: 1.2, yaw_deg: -55"),
    )
)
CHANNELS, EPOCHS, RATE, CROP, FLOOR = 16, 12, 4e-3, (224, 448), 3e-5


def requests_beside(scenario, t_us, lateral_m):
    """The requests of all cameras beside the log."""
    for request in recorded_requests(scenario, t_us):
        T_world_rig = request.T_world_camera[1] @ inverse(request.camera.T_rig_camera)
        shift = np.eye(4)
        shift[:3, 3] = lateral_m * T_world_rig[:3, 1]
        yield replace(request, T_world_camera=shift @ request.T_world_camera)


def write_pairs(path, out):
    """Write what is blended in frames of a scene, and what should come of it."""
    scenario = load_scenario(path, overrides=[f"cameras=[{CAMERAS}]"])
    damage = scenario.degradation
    damage = replace(damage, kind="reconstruction", share=max(damage.share, 0.15))
    scenario = replace(scenario, degradation=damage)
    seen = []

    def enlarge(*given):
        seen.append(given)
        return CPU.enlarge(*given)

    pixel_network.CPU = replace(CPU, enlarge=enlarge)
    renderer = make_renderer("onefixer[scale=7]", scenario, threads=1)
    graph = scene_of(scenario)
    start, end = (int(t) for t in scenario.ego_log.t_us[[0, -1]])
    rng = stream(scenario.scene_id, 0, "finer weights")
    pairs = []
    for t_us in range(start + 900_000, end - 300_000, 800_000):
        lateral_m = float(rng.uniform(0.2, 1.0) * rng.choice([-1, 1]))
        for before_us in (200_000, 100_000, 0):
            asked = list(requests_beside(scenario, t_us - before_us, lateral_m))
            renderer.render_batch(asked)
        rgb, change, references, heads, _ = seen[-1]
        image = rgb / HALF - 1 + larger(change, SCALE)[:, :HEIGHT, :WIDTH]
        asked.sort(key=lambda request: request.camera.name)
        for i, request in enumerate(asked):
            K = np.diag([LARGER, LARGER, 1]) @ request.camera.K
            size = LARGER * WIDTH, LARGER * HEIGHT
            camera = PinholeCamera.from_pose(*size, K, request.T_world_camera[1])
            large = graph.render(camera, request.actors).to_uint8()
            truth = cv2.resize(large, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
            blend = {name: part[i] for name, part in heads._asdict().items() if part is not None}
            pairs.append({"image": image[i].half(), "references": references[i], **blend})
            pairs[-1]["truth"] = torch.from_numpy(truth)
    torch.save(pairs, out)


class Pair:
    """One frame: what the head sees, and what it mixes."""

    def __init__(self, part):
        image, references = part["image"].float()[None], part["references"][None]
        heads = BlendHeads(*(part[name][None] for name in BlendHeads._fields[:3]))
        sources = sources_of(image, in_floats(references), heads, SCALE)
        self.colour, self.logit = sources.colour.half(), sources.logit.half()
        self.small = (smaller(image, FINER_PX) + 1) * HALF
        self.references = smaller(references, FINER_PX)
        self.weight, self.truth = heads.weight, part["truth"] / HALF - 1

    def added(self, net):
        """The logarithms that a head adds, (1, K, h, w)."""
        change = torch.zeros(1, HEIGHT // SCALE + 1, WIDTH // SCALE + 1, 3)
        return net(self.small, self.references, change, self.weight, SCALE)


def error(pair, added, part=(slice(0, HEIGHT), slice(0, WIDTH))):
    """The mean squared error of a part of the mixed image, of a range of 2."""
    rows, columns = part
    cells = added[:, :, rows.start // FINER_PX : rows.stop // FINER_PX]
    cells = cells[..., columns.start // FINER_PX : columns.stop // FINER_PX]
    up = F.interpolate(cells, scale_factor=FINER_PX, mode="bilinear")[..., None]
    logit = pair.logit[:, :, rows, columns].float()
    shares = torch.cat([logit[:, :1], logit[:, 1:] + up], dim=1).softmax(dim=1)
    mixed = (shares * pair.colour[:, :, rows, columns].float()).sum(dim=1)[0]
    return (mixed - pair.truth[rows, columns]).square().mean()


def train(folder, out):
    """Minimise the mean logarithm of the error over crops of the training scenes."""
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    parts = {path: torch.load(path) for path in sorted(Path(folder).glob("*.pt"))}
    kept = [Pair(one) for path, some in parts.items() if path.stem not in VAL for one in some]
    val = [Pair(one) for path, some in parts.items() if path.stem in VAL for one in some]
    net = FinerWeights(CHANNELS)
    optimiser = torch.optim.Adam(net.parameters(), lr=RATE)
    steps = EPOCHS * len(kept)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)

    def decibels():
        with torch.no_grad():
            return [-10 * np.log10(float(error(pair, pair.added(net))) / 4) for pair in val]

    before = np.array(decibels())
    for epoch in range(EPOCHS):
        for i in rng.permutation(len(kept)):
            top, left = (
                FINER_PX * int(rng.integers((whole - cut) // FINER_PX + 1))
                for whole, cut in zip((HEIGHT, WIDTH), CROP, strict=True)
            )
            crop = slice(top, top + CROP[0]), slice(left, left + CROP[1])
            loss = torch.log(error(kept[i], kept[i].added(net), crop) + FLOOR)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
        gain = np.array(decibels()) - before
        print(
            f"{epoch}: val {before.mean():.2f} dB, {np.percentile(gain, [0, 50, 100])}", flush=True
        )
    torch.save(net.state_dict(), out)


def add(head, bundle, out):
    """Write a bundle with the head's weights."""
    tensors = load_file(bundle)
    for name, value in torch.load(head).items():
        tensors[f"generator.finer.{name}"] = value.half().contiguous()
    save_file(tensors, out, metadata=safe_open(bundle, "pt").metadata())


if __name__ == "__main__":
    what, *given = sys.argv[1:]
    if what == "pairs":
        (folder,) = map(Path, given)
        for scene in write_scenes(folder / "scenes", "train", SCENES, 6.0):
            if not (folder / f"{scene.stem}.pt").exists():
                write_pairs(scene, folder / f"{scene.stem}.pt")
    else:
        {"train": train, "add": add}[what](*given)
