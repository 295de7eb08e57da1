"""Put the parts of ``simrun serve`` together."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import grpc

from alpasim_plugin.alpasim.server.fixing import FixerShelf, resolve_served
from alpasim_plugin.alpasim.server.frames import Answered, FrameServer
from alpasim_plugin.alpasim.server.history import HistoryTree
from alpasim_plugin.alpasim.server.hosting import read_pem
from alpasim_plugin.alpasim.server.reliability import read_masks
from alpasim_plugin.alpasim.server.scenes import SceneShelf
from alpasim_plugin.alpasim.server.sensorsim import Sensorsim
from alpasim_plugin.alpasim.server.sources import FrameSource, LocalSource, UpstreamSource
from alpasim_plugin.alpasim.server.version import version_of
from alpasim_plugin.alpasim.server.world_model import WorldModel
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.plugins.parts import RendererSpec
from alpasim_plugin.plugins.parts.spec import file_digest
from alpasim_plugin.wire.services import OPTIONS, Stub

DOING = "setting up a renderer service"
RECONNECT = (("grpc.min_reconnect_backoff_ms", 200), ("grpc.initial_reconnect_backoff_ms", 200), ("grpc.max_reconnect_backoff_ms", 2000))


@dataclass(frozen=True)
class Upstream:
    """Another server of the renderer service.

    Attributes:
        address: ``HOST:PORT``.
        ca: PEM file: talk TLS and trust what it signed; None: plain text.
        token: Sent as ``authorization: Bearer TOKEN``; only over TLS.
    """

    address: str
    ca: Path | None = None
    token: str | None = None

    def channel(self) -> Any:
        """Open a channel."""
        options = [*OPTIONS, *RECONNECT]
        if self.ca is None:
            if self.token is not None:
                raise InputError(DOING, f"upstream {self.address}", "a token over plain text", "give --upstream-ca as well")
            return grpc.insecure_channel(self.address, options)
        credentials = grpc.ssl_channel_credentials(read_pem(self.ca))
        if self.token is not None:
            credentials = grpc.composite_channel_credentials(credentials, grpc.access_token_call_credentials(self.token))
        return grpc.secure_channel(self.address, credentials, options)


@dataclass(frozen=True)
class Settings:
    """Options of `simrun serve`.

    Attributes:
        renderer: ``onefixer``, ``identity``, ``3dgs``, ``onefixer+clean``, ...; over an upstream only the fixer counts.
        overrides: ``KEY=VALUE`` of the fixer's settings.
        scenes: Folders, files or shipped names.
        upstream: None: render here.
        device, threads: For renderer and fixer.
        history_bytes, expiry_s: Bounds of the histories.
        reliability: Fixed trust in an upstream's frames; None: from the distance to the recorded path.
        masks: Grey masks by camera.
        upstream_png: Ask the upstream for PNG whatever the caller wants.
        kept_scenes: Scenes that stay loaded.
    """

    renderer: str = "onefixer"
    overrides: Sequence[str] = ()
    scenes: Sequence[str] = ()
    upstream: Upstream | None = None
    device: str = "cpu"
    threads: int | None = None
    history_bytes: int = 2 << 30
    expiry_s: float = 900.0
    reliability: float | None = None
    masks: Mapping[str, Path] = field(default_factory=dict)
    upstream_png: bool = True
    kept_scenes: int = 4


@dataclass(frozen=True)
class Assembled:
    """A service with what belongs to it. The video model's is there where we render ourselves."""

    service: Sensorsim
    world_model: WorldModel | None
    shelf: SceneShelf | None
    fixers: FixerShelf | None
    tree: HistoryTree[Answered]
    busy: threading.Lock
    spec: RendererSpec
    channel: Any

    @property
    def services(self) -> dict[str, object]:
        """All services by name, for one port."""
        both = {"SensorsimService": self.service, "WorldModelService": self.world_model}
        return {name: service for name, service in both.items() if service is not None}

    def close(self) -> None:
        """Close the channel to the upstream: its threads must be gone before the interpreter ends, which otherwise may abort."""
        if self.channel is not None:
            self.channel.close()

    def expire(self) -> None:
        """Forget what nobody used for long."""
        self.tree.expire()
        if self.world_model is not None:
            self.world_model.expire()


def assemble(settings: Settings) -> Assembled:
    """Build the renderer service.

    Raises:
        InputError: Settings that do not fit together, an unknown renderer, or scenes that cannot be found.
    """
    spec = resolve_served(settings.renderer, settings.overrides)
    if settings.upstream is None and not settings.scenes:
        raise InputError(DOING, "the command", "neither --scenes nor --upstream", "say what to render, or who renders")
    if settings.upstream is not None and spec.fixer is None and settings.renderer != "identity":
        found = f"{settings.renderer!r} renders itself"
        raise InputError(DOING, f"--upstream {settings.upstream.address}", found, "give a fixer (onefixer), identity, or no --upstream")
    if settings.upstream is None and (settings.masks or settings.reliability is not None):
        raise InputError(DOING, "--reliability, --mask", "our own renderer states its opacity", "use them with --upstream")
    busy = threading.Lock()
    fixers = None if spec.fixer is None else FixerShelf(spec, settings.device, settings.threads)
    needs_map = fixers is not None and fixers.needs_map
    own = spec if settings.upstream is None else None
    shelf = None
    if settings.scenes:
        shelf = SceneShelf(settings.scenes, own, needs_map, settings.device, settings.threads, kept=settings.kept_scenes)
    channel = None if settings.upstream is None else settings.upstream.channel()
    stub = None if channel is None else Stub(channel, "SensorsimService")
    source: FrameSource
    if stub is None:
        assert shelf is not None
        source = LocalSource(shelf, busy, settings.threads)
    else:
        masks = read_masks(settings.masks)
        source = UpstreamSource(stub, shelf, settings.reliability, masks, settings.upstream_png, settings.threads)
    tree: HistoryTree[Answered] = HistoryTree(settings.history_bytes, settings.expiry_s)
    frames = FrameServer(source, fixers, tree, busy)
    shaping = {
        "device": settings.device,
        "reliability": settings.reliability,
        "masks": {camera: file_digest(path, f"mask of {camera}") for camera, path in settings.masks.items()},
        "upstream_png": settings.upstream_png,
        "maps": needs_map and shelf is not None,
    }
    service = Sensorsim(frames, partial(version_of, spec, shaping), shelf, stub, verbatim=stub is not None and fixers is None)
    world_model = None
    if stub is None:
        assert shelf is not None
        version = version_of(spec, shaping)
        world_model = WorldModel(shelf, fixers, busy, version, settings.threads, settings.expiry_s)
    return Assembled(service, world_model, shelf, fixers, tree, busy, spec, channel)
