"""``simrun serve-policy``: a policy of ours as an AlpaSim driver."""

from __future__ import annotations

import json
from functools import partial
from typing import Annotated

import numpy as np

from alpasim_plugin.alpasim.server.driver_service import DriverService
from alpasim_plugin.alpasim.server.hosting import Host, HostPolicy
from alpasim_plugin.alpasim.server.one_policy import ADDRESS
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.core.types import Scenario
from alpasim_plugin.plugins.interfaces import Policy
from alpasim_plugin.plugins.parts import PartSpec, build, resolve
from alpasim_plugin.process.signals import Stopped
from alpasim_plugin.runtime.score_logs import scenario_finder

EPILOG = """
Examples:

- `simrun serve-policy lane-camera`: AlpaSim's runtime drives it with `driver` at 127.0.0.1:50052

- `simrun serve-policy my_package.policies:Mine --listen 0.0.0.0:6000 --scenes scenes/`
"""


def serve_policy(
    policy: Annotated[str, Positional("Policy as for `run --policy`.")],
    listen: Annotated[
        str, Flag("Address, or unix:PATH; port 0 takes a free one.", metavar="HOST:PORT", variable=ADDRESS)
    ] = "127.0.0.1:50052",
    scenes: Annotated[tuple[str, ...], Flag("Scenes by whose id a policy gets map and vehicle; without it, it gets neither.")] = (),
    host_policy: HostPolicy = HostPolicy(),
    as_json: Annotated[bool, Flag("Print one JSON line when the port is open, and one at the end.", "--json")] = False,
) -> None:
    """Serve a policy as AlpaSim's EgodriverService, so that AlpaSim's runtime drives it.

    Each session gets a policy of its own, made for the session's cameras, which must be pinholes.
    """
    spec = resolve("policy", policy)
    service = DriverService(spec.name, spec.digest, partial(_made, spec), scenario_finder(scenes), host_policy.expiry_s)
    host = Host({"EgodriverService": service}, listen, host_policy, every=service.sessions.expire)
    what = {"serving": "EgodriverService", "at": host.address, "policy": policy}
    try:
        host.start()
        print(json.dumps(what) if as_json else f"serving EgodriverService at {host.address}: {policy}", flush=True)
        host.wait()
    except Stopped:
        host.stop(host_policy.drain_s)
    ms = np.array(service.drives_s) * 1000
    quantiles = {f"drive_ms_p{q}": round(float(np.percentile(ms, q)), 2) for q in (50, 95, 99)} if len(ms) else {}
    counts = dict(service.counts) | quantiles
    print(json.dumps(counts) if as_json else ", ".join(f"{key} {value}" for key, value in counts.items()), flush=True)


def _made(spec: PartSpec, scenario: Scenario) -> Policy:
    policy: Policy = build(spec, scenario=scenario)
    return policy
