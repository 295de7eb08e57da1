"""``simrun serve``: AlpaSim's renderer endpoint, or a policy as an AlpaSim driver."""

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from alpasim_plugin.alpasim.server.assembly import Settings, Upstream, assemble
from alpasim_plugin.alpasim.server.driver_service import ADDRESS, DriverService
from alpasim_plugin.alpasim.server.hosting import RENDER_BYTES, Host, HostPolicy
from alpasim_plugin.cli.output import show
from alpasim_plugin.core.errors import InputError, Stopped
from alpasim_plugin.core.flags import Flag
from alpasim_plugin.core.interfaces import Policy
from alpasim_plugin.core.json_types import JsonView
from alpasim_plugin.core.parts import build, resolve
from alpasim_plugin.core.types import Scenario
from alpasim_plugin.runs.score_logs import scenario_finder

RENDERER_ADDRESS = "127.0.0.1:50051"
DRIVER_ADDRESS = "127.0.0.1:50052"
CALLS_AT_A_TIME = 32  # further ones wait
MIB = 1 << 20

EPILOG = """
Examples:

- `simrun serve --scenes scenes/`: our renderer with OneFixer, for every scene of a folder (`*.usdz`, scenario files)

- `simrun serve --upstream 127.0.0.1:6789 --scenes scenes/ --listen 127.0.0.1:50051`: OneFixer between AlpaSim's runtime and its renderer

- `simrun serve --upstream 127.0.0.1:6789 --renderer identity`: hand everything on as it is, bit by bit

- `simrun serve --policy lane-camera`: AlpaSim's runtime drives it with `driver` at 127.0.0.1:50052

- `simrun serve --policy my_package.policies:Mine --listen 0.0.0.0:6000 --scenes scenes/`

Exit codes: 0 stopped by a signal after running calls were answered; 2 wrong options or scenes; 4 the port or the device cannot be had.
"""


@dataclass(frozen=True)
class ServedRenderer:
    """The renderer behind AlpaSim's renderer service."""

    renderer: Annotated[str, Flag("Renderer or fixer as for `run`; identity hands frames on.")] = (
        "onefixer"
    )
    scenes: Annotated[tuple[str, ...], Flag("Folder, scene file or shipped name; repeatable.")] = ()
    upstream: Annotated[
        str | None,
        Flag(
            "Renderer to stand in front of, with ?ca=FILE&token_file=FILE&image=png|as-asked.",
            metavar="HOST:PORT",
        ),
    ] = None
    set_: Annotated[
        tuple[str, ...], Flag("A setting of the fixer; repeatable.", "--set", metavar="KEY=VALUE")
    ] = ()
    device: Annotated[str, Flag("Where to compute: cpu, cuda or cuda:N.")] = "cpu"
    history_mb: Annotated[
        int,
        Flag("Most memory for callers' histories or images, MiB.", min=16),
    ] = 2048
    mask: Annotated[
        tuple[str, ...], Flag("Grey image, white is trusted; repeatable.", metavar="CAMERA=FILE")
    ] = ()
    render_width: Annotated[
        int | None, Flag("Render wider images at this width, pixels, and enlarge them.", min=16)
    ] = None

    def settings(self, expiry_s: float) -> Settings:
        """Return the settings of the service, which forgets histories after ``expiry_s``."""
        masks = dict(parted(item, "--mask") for item in self.mask)
        return Settings(
            renderer=self.renderer,
            overrides=self.set_,
            scenes=self.scenes,
            upstream=None if self.upstream is None else Upstream.parse(self.upstream),
            device=self.device,
            history_bytes=self.history_mb * MIB,
            expiry_s=expiry_s,
            masks={camera: Path(file) for camera, file in masks.items()},
            render_width=self.render_width,
        )


def serve(
    policy: Annotated[
        str | None, Flag("Serve this policy as a driver, instead of a renderer.", names="policy")
    ] = None,
    listen: Annotated[
        str | None,
        Flag(
            "Address, or unix:PATH; port 0: a free one. Default: 127.0.0.1:50051, of a policy 50052.",
            metavar="HOST:PORT",
        ),
    ] = None,
    renderer: ServedRenderer = ServedRenderer(),
    host_policy: HostPolicy = HostPolicy(),
    as_json: Annotated[
        bool,
        Flag("Print one JSON line when the port is open, and one at the end.", "--json"),
    ] = False,
    debug: Annotated[bool, Flag("Log every failed call with its traceback.")] = False,
) -> None:
    """Serve AlpaSim's renderer service, or with `--policy` a policy as AlpaSim's driver.

    The renderer is ours, or OneFixer in front of any other. Frames of all rollouts may come over one
    connection in any order: the history of each is found by what is asked (docs/alpasim.md). Each
    session of a driver gets a policy of its own, made for the session's cameras.
    """
    level = logging.INFO if debug else logging.WARNING
    logging.basicConfig(level=level, format="%(asctime)s %(levelname)s %(message)s")
    if policy is not None:
        address = listen or os.environ.get(ADDRESS, DRIVER_ADDRESS)
        budget = renderer.history_mb * MIB
        _serve_policy(policy, address, renderer.scenes, host_policy, budget, as_json)
    else:
        _serve_renderer(renderer, listen or RENDERER_ADDRESS, host_policy, as_json)


def _serve_renderer(
    renderer: ServedRenderer, listen: str, host_policy: HostPolicy, as_json: bool
) -> None:
    """Serve AlpaSim's renderer service until a signal stops it, then print what was counted."""
    made = assemble(renderer.settings(host_policy.expiry_s))
    host = Host(made.services, listen, host_policy, CALLS_AT_A_TIME, made.expire, RENDER_BYTES)
    text = f"serving {', '.join(made.services)} at {host.address}: {made.spec.name}"
    if renderer.upstream:
        text += f" in front of {renderer.upstream}"
    facts = {
        "serving": list(made.services),
        "at": host.address,
        "renderer": renderer.renderer,
        "upstream": renderer.upstream,
    }
    try:
        _host(host, facts, text, host_policy, as_json)
    finally:
        made.close()
    counts = {
        **vars(made.tree.counts),
        "events": dict(made.service.frames.events),
        "failed": dict(made.service.statuses),
    }
    _print_counts(counts, as_json)


def _serve_policy(
    policy: str,
    listen: str,
    scenes: Sequence[str],
    host_policy: HostPolicy,
    budget: int,
    as_json: bool,
) -> None:
    """Serve a policy as AlpaSim's driver; ``budget``: bytes of callers' images that are kept."""
    spec = resolve("policy", policy)

    def make(scenario: Scenario) -> Policy:
        return build(spec, scenario=scenario)

    finder = scenario_finder(scenes)
    service = DriverService(
        spec.name, spec.digest, make, finder, host_policy.expiry_s, budget=budget
    )
    host = Host(
        {"EgodriverService": service}, listen, host_policy, on_interval=service.sessions.expire
    )
    facts = {"serving": "EgodriverService", "at": host.address, "policy": policy}
    text = f"serving EgodriverService at {host.address}: {policy}"
    _host(host, facts, text, host_policy, as_json)
    counts = dict(service.counts)
    counts["sessions closed for room"] = len(service.sessions.crowded_out)
    _print_counts(counts, as_json)


def _host(host: Host, facts: JsonView, text: str, host_policy: HostPolicy, as_json: bool) -> None:
    """Serve until a signal stops the process."""
    try:
        host.start()
        show(as_json, facts, text)
        host.wait()
    except Stopped:
        host.stop(host_policy.drain_s)


def _print_counts(counts: JsonView, as_json: bool) -> None:
    show(as_json, counts, ", ".join(f"{key} {value}" for key, value in counts.items()))


def parted(text: str, option: str) -> tuple[str, str]:
    """Split ``NAME=VALUE``.

    Raises:
        InputError: Name or value is missing.
    """
    name, equals, value = text.partition("=")
    if not (name and equals and value):
        raise InputError(
            f"{option} {text}: no NAME=VALUE",
            "Write for example --mask camera_front_wide_120fov=hood.png.",
        )
    return name, value
