"""``simrun serve``: AlpaSim's renderer endpoint."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Annotated, Literal

from alpasim_plugin.alpasim.server.assembly import Settings, Upstream, assemble
from alpasim_plugin.alpasim.server.hosting import Host, Security, is_loopback
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.flags import Flag
from alpasim_plugin.process.signals import Stopped

DOING = "reading the options of simrun serve"
MIB = 1 << 20

EPILOG = """
Examples:

- `simrun serve --scenes scenes/`: our renderer with OneFixer, for every scene of a folder (`*.usdz`, scenario files)

- `simrun serve --upstream 127.0.0.1:6789 --scenes scenes/ --listen 127.0.0.1:50051`: OneFixer between AlpaSim's runtime and its renderer

- `simrun serve --upstream 127.0.0.1:6789 --renderer identity`: hand everything on as it is, bit by bit

- `simrun serve --scenes smoke/straight --renderer 3dgs --prefetch`: no fixer; the scene is built before the port opens

Exit codes: 0 stopped by a signal after running calls were answered; 2 wrong options or scenes; 4 the port or the device cannot be had.
"""


def serve(
    listen: Annotated[str, Flag("Address; port 0 takes a free one.", metavar="HOST:PORT")] = "127.0.0.1:50051",
    renderer: Annotated[str, Flag("Renderer or fixer as for `run`; identity hands on.")] = "onefixer",
    scenes: Annotated[tuple[str, ...], Flag("Folder, scene file or shipped name; repeatable.")] = (),
    upstream: Annotated[str | None, Flag("Renderer to stand in front of.", metavar="HOST:PORT")] = None,
    set_: Annotated[tuple[str, ...], Flag("A setting of the fixer; repeatable.", "--set", metavar="KEY=VALUE")] = (),
    device: Annotated[Literal["cpu", "cuda"], Flag("Where to render and fix.")] = "cpu",
    threads: Annotated[int | None, Flag("Threads of renderer and fixer.", min=1)] = None,
    workers: Annotated[int, Flag("Calls handled at a time; further ones wait.", min=1, max=256)] = 32,
    history_mb: Annotated[int, Flag("Most memory of the histories, MiB.", min=16)] = 2048,
    expiry_s: Annotated[float, Flag("Histories unused for so long are forgotten.", min=1.0)] = 900.0,
    reliability: Annotated[float | None, Flag("Fixed trust in upstream frames.", min=0.0, max=1.0)] = None,
    mask: Annotated[tuple[str, ...], Flag("Grey picture, white is trusted.", metavar="CAMERA=FILE")] = (),
    upstream_image: Annotated[Literal["png", "as-asked"], Flag("Format to ask the upstream for.")] = "png",
    prefetch: Annotated[bool, Flag("Load all scenes before the port opens.")] = False,
    drain_s: Annotated[float, Flag("At the end, wait so long for running calls.", min=0.0)] = 30.0,
    tls_cert: Annotated[Path | None, Flag("PEM certificate of this server.")] = None,
    tls_key: Annotated[Path | None, Flag("PEM key of this server.")] = None,
    tls_client_ca: Annotated[Path | None, Flag("Callers must show a certificate signed by it.")] = None,
    token_file: Annotated[Path | None, Flag("File with the token that callers must send.")] = None,
    upstream_ca: Annotated[Path | None, Flag("Talk TLS to the upstream and trust this PEM.")] = None,
    upstream_token_file: Annotated[Path | None, Flag("File with the token for the upstream.")] = None,
    as_json: Annotated[bool, Flag("Print one JSON line when the port is open, and one at the end.", "--json")] = False,
    debug: Annotated[bool, Flag("Log every failed call with its traceback.")] = False,
) -> None:
    """Serve AlpaSim's renderer service: our renderer, or OneFixer in front of any other renderer.

    Frames of all rollouts may come over one connection in any order: each drive's history is found by what is asked (docs/alpasim.md).
    """
    logging.basicConfig(level=logging.INFO if debug else logging.WARNING, format="%(asctime)s %(levelname)s %(message)s")
    masks = dict(parted(item, "--mask") for item in mask)
    settings = Settings(
        renderer=renderer,
        overrides=set_,
        scenes=scenes,
        upstream=None if upstream is None else Upstream(upstream, upstream_ca, read_token(upstream_token_file)),
        device=device,
        threads=threads,
        history_bytes=history_mb * MIB,
        expiry_s=expiry_s,
        reliability=reliability,
        masks={camera: Path(file) for camera, file in masks.items()},
        upstream_png=upstream_image == "png",
    )
    made = assemble(settings)
    if prefetch and made.shelf is not None:
        for scene_id in made.shelf.ids:
            made.shelf.get(scene_id)
    security = Security(tls_cert, tls_key, tls_client_ca, read_token(token_file))
    host = Host(made.services, listen, security, workers, every=made.expire)
    if not is_loopback(listen) and security.token is None and security.client_ca is None:
        warning = "%s is open to everybody who can reach it; see --token-file and --tls-client-ca"
        logging.getLogger("simrun.serve").warning(warning, host.address)
    what = {"serving": list(made.services), "at": host.address, "renderer": renderer, "upstream": upstream}
    text = f"serving {', '.join(made.services)} at {host.address}: {made.spec.name}" + (f" in front of {upstream}" if upstream else "")
    try:
        host.start()
        print(json.dumps(what) if as_json else text, flush=True)
        host.wait()
    except Stopped:
        host.stop(drain_s)
    finally:
        made.close()
    counts = vars(made.tree.counts) | {"events": dict(made.service.frames.events), "failed": dict(made.service.statuses)}
    print(json.dumps(counts) if as_json else ", ".join(f"{key} {value}" for key, value in counts.items()), flush=True)


def parted(text: str, option: str) -> tuple[str, str]:
    """Split ``NAME=VALUE``."""
    name, equals, value = text.partition("=")
    if not (name and equals and value):
        raise InputError(DOING, f"{option} {text}", "no NAME=VALUE", "write for example --mask camera_front_wide_120fov=hood.png")
    return name, value


def read_token(path: Path | None) -> str | None:
    """Return the token in a file, without the space around it."""
    if path is None:
        return None
    try:
        token = path.read_text().strip()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(DOING, str(path), f"{error}", "name a readable text file") from error
    if not token:
        raise InputError(DOING, str(path), "an empty file", "write the token into it")
    return token
