"""``simrun serve``: AlpaSim's renderer endpoint. ``simrun serve-policy``: a policy of ours as an
AlpaSim driver.
"""

from __future__ import annotations

import json
import logging
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from alpasim_plugin.alpasim.server.assembly import Settings, Upstream, assemble
from alpasim_plugin.alpasim.server.driver_service import ADDRESS, DriverService
from alpasim_plugin.alpasim.server.hosting import Host, HostPolicy
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.core.interfaces import Policy
from alpasim_plugin.core.parts import PartSpec, build, resolve
from alpasim_plugin.core.signals import Stopped
from alpasim_plugin.core.types import Scenario
from alpasim_plugin.runs.score_logs import scenario_finder

DOING = "reading the options of simrun serve"
MIB = 1 << 20

SERVE_EPILOG = """
Examples:

- `simrun serve --scenes scenes/`: our renderer with OneFixer, for every scene of a folder (`*.usdz`, scenario files)

- `simrun serve --upstream 127.0.0.1:6789 --scenes scenes/ --listen 127.0.0.1:50051`: OneFixer between AlpaSim's runtime and its renderer

- `simrun serve --upstream 127.0.0.1:6789 --renderer identity`: hand everything on as it is, bit by bit

- `simrun serve --scenes smoke/straight --renderer 3dgs --prefetch`: no fixer; the scene is built before the port opens

Exit codes: 0 stopped by a signal after running calls were answered; 2 wrong options or scenes; 4 the port or the device cannot be had.
"""


def serve(
    listen: Annotated[
        str, Flag("Address; port 0 takes a free one.", metavar="HOST:PORT")
    ] = "127.0.0.1:50051",
    renderer: Annotated[
        str, Flag("Renderer or fixer as for `run`; identity hands on.")
    ] = "onefixer",
    scenes: Annotated[
        tuple[str, ...], Flag("Folder, scene file or shipped name; repeatable.")
    ] = (),
    upstream: Annotated[
        str | None,
        Flag(
            "Renderer to stand in front of, with ?ca=FILE&token_file=FILE&image=png|as-asked.",
            metavar="HOST:PORT",
        ),
    ] = None,
    set_: Annotated[
        tuple[str, ...], Flag("A setting of the fixer; repeatable.", "--set", metavar="KEY=VALUE")
    ] = (),
    device: Annotated[Literal["cpu", "cuda"], Flag("Where to render and fix.")] = "cpu",
    threads: Annotated[int | None, Flag("Threads of renderer and fixer.", min=1)] = None,
    workers: Annotated[
        int, Flag("Calls handled at a time; further ones wait.", min=1, max=256)
    ] = 32,
    history_mb: Annotated[int, Flag("Most memory of the histories, MiB.", min=16)] = 2048,
    reliability: Annotated[
        float | None, Flag("Fixed trust in upstream frames.", min=0.0, max=1.0)
    ] = None,
    mask: Annotated[
        tuple[str, ...], Flag("Grey picture, white is trusted.", metavar="CAMERA=FILE")
    ] = (),
    render_width: Annotated[
        int | None, Flag("Make wider pictures this wide and enlarge them, pixels.", min=16)
    ] = None,
    shutter: Annotated[
        Literal["asked", "rolling", "global"], Flag("Which shutters roll: as asked, all, or none.")
    ] = "asked",
    prefetch: Annotated[bool, Flag("Load all scenes before the port opens.")] = False,
    policy: HostPolicy = HostPolicy(),
    as_json: Annotated[
        bool, Flag("Print one JSON line when the port is open, and one at the end.", "--json")
    ] = False,
    debug: Annotated[bool, Flag("Log every failed call with its traceback.")] = False,
) -> None:
    """Serve AlpaSim's renderer service: our renderer, or OneFixer in front of any other renderer.

    Frames of all rollouts may come over one connection in any order: each drive's history is found
    by what is asked (docs/alpasim.md).
    """
    logging.basicConfig(
        level=logging.INFO if debug else logging.WARNING,
        format="%(asctime)s %(levelname)s %(message)s",
    )
    masks = dict(parted(item, "--mask") for item in mask)
    settings = Settings(
        renderer=renderer,
        overrides=set_,
        scenes=scenes,
        upstream=None if upstream is None else Upstream.parse(upstream),
        device=device,
        threads=threads,
        history_bytes=history_mb * MIB,
        expiry_s=policy.expiry_s,
        reliability=reliability,
        masks={camera: Path(file) for camera, file in masks.items()},
        shutter=shutter,
        render_width=render_width,
        says_costs=device == "cpu",
    )
    made = assemble(settings)
    if prefetch and made.scenes is not None:
        for scene_id in made.scenes.ids:
            made.scenes.get(scene_id)
    host = Host(made.services, listen, policy, workers, made.expire)
    what = {
        "serving": list(made.services),
        "at": host.address,
        "renderer": renderer,
        "upstream": upstream,
    }
    text = f"serving {', '.join(made.services)} at {host.address}: {made.spec.name}" + (
        f" in front of {upstream}" if upstream else ""
    )
    try:
        host.start()
        print(json.dumps(what) if as_json else text, flush=True)
        host.wait()
    except Stopped:
        host.stop(policy.drain_s)
    finally:
        made.close()
    counts = vars(made.tree.counts) | {
        "events": dict(made.service.frames.events),
        "failed": dict(made.service.statuses),
    }
    print(
        json.dumps(counts)
        if as_json
        else ", ".join(f"{key} {value}" for key, value in counts.items()),
        flush=True,
    )


def parted(text: str, option: str) -> tuple[str, str]:
    """Split ``NAME=VALUE``."""
    name, equals, value = text.partition("=")
    if not (name and equals and value):
        raise InputError(
            f"{option} {text}: no NAME=VALUE",
            "write for example --mask camera_front_wide_120fov=hood.png",
        )
    return name, value


SERVE_POLICY_EPILOG = """
Examples:

- `simrun serve-policy lane-camera`: AlpaSim's runtime drives it with `driver` at 127.0.0.1:50052

- `simrun serve-policy my_package.policies:Mine --listen 0.0.0.0:6000 --scenes scenes/`
"""


def serve_policy(
    policy: Annotated[str, Positional("Policy as for `run --policy`.")],
    listen: Annotated[
        str,
        Flag(
            "Address, or unix:PATH; port 0 takes a free one.", metavar="HOST:PORT", variable=ADDRESS
        ),
    ] = "127.0.0.1:50052",
    scenes: Annotated[
        tuple[str, ...],
        Flag("Scenes by whose id a policy gets map and vehicle; without it, it gets neither."),
    ] = (),
    host_policy: HostPolicy = HostPolicy(),
    as_json: Annotated[
        bool, Flag("Print one JSON line when the port is open, and one at the end.", "--json")
    ] = False,
) -> None:
    """Serve a policy as AlpaSim's EgodriverService, so that AlpaSim's runtime drives it.

    Each session gets a policy of its own, made for the session's cameras, which must be pinholes.
    """
    spec = resolve("policy", policy)
    service = DriverService(
        spec.name, spec.digest, partial(_made, spec), scenario_finder(scenes), host_policy.expiry_s
    )
    host = Host({"EgodriverService": service}, listen, host_policy, every=service.sessions.expire)
    what = {"serving": "EgodriverService", "at": host.address, "policy": policy}
    try:
        host.start()
        print(
            json.dumps(what)
            if as_json
            else f"serving EgodriverService at {host.address}: {policy}",
            flush=True,
        )
        host.wait()
    except Stopped:
        host.stop(host_policy.drain_s)
    ms = np.array(service.drives_s) * 1000
    quantiles = (
        {f"drive_ms_p{q}": round(float(np.percentile(ms, q)), 2) for q in (50, 95, 99)}
        if len(ms)
        else {}
    )
    counts = dict(service.counts) | quantiles
    print(
        json.dumps(counts)
        if as_json
        else ", ".join(f"{key} {value}" for key, value in counts.items()),
        flush=True,
    )


def _made(spec: PartSpec, scenario: Scenario) -> Policy:
    policy: Policy = build(spec, scenario=scenario)
    return policy
