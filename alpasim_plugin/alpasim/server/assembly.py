"""Put the parts of ``simrun serve`` together."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import grpc

from alpasim_plugin import __version__
from alpasim_plugin.alpasim.server.caches import FixerCache, SceneCache, resolve_served
from alpasim_plugin.alpasim.server.frames import Answered, FrameServer
from alpasim_plugin.alpasim.server.history import HistoryTree
from alpasim_plugin.alpasim.server.hosting import read_token
from alpasim_plugin.alpasim.server.sensorsim import Sensorsim
from alpasim_plugin.alpasim.server.sources import (
    FrameSource,
    LocalSource,
    UpstreamSource,
    read_masks,
)
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import file_sha256, read_bytes
from alpasim_plugin.core.parts import RendererSpec
from alpasim_plugin.core.parts.spec import digest
from alpasim_plugin.core.queries import options_of
from alpasim_plugin.core.typed_json import to_plain
from alpasim_plugin.log.wire import api_version, common_pb2
from alpasim_plugin.log.wire.services import Stub, channel_options

RECONNECT = (
    ("grpc.min_reconnect_backoff_ms", 200),
    ("grpc.initial_reconnect_backoff_ms", 200),
    ("grpc.max_reconnect_backoff_ms", 2000),
)


def version_of(
    spec: RendererSpec, settings: dict[str, Any], upstream: common_pb2.VersionId | None = None
) -> common_pb2.VersionId:
    """Return the triple of a service.

    Args:
        spec: Renderer and fixer.
        settings: What else shapes the images: device, scenes, masks.
        upstream: The upstream's own triple.

    Returns:
        ``version_id``: the product, then digests of weights, settings and code, then the upstream's
            id; ``git_hash``: one digest of all
        of it, followed by the upstream's; the wire version is the upstream's where there is one.
    """
    part = spec.base if spec.fixer is None else spec.fixer
    name = "identity" if spec.fixer is None and upstream is not None else spec.name
    weights = digest(sorted(part.files.values()))
    part_settings = to_plain(part.settings)
    base = None if upstream is not None else spec.base.digest
    everything = digest([__version__, name, part.digest, base, part_settings, settings])
    short = f"weights={weights[:12]}" if part.files else "weights=none"
    text = f"simrun-{__version__}+{name} {short} settings={digest([part_settings, settings])[:12]} code={(part.digest or 'remote')[:12]}"
    version = common_pb2.VersionId(version_id=text, git_hash=everything[:40])
    if upstream is None:
        version.grpc_api_version.CopyFrom(api_version())
        return version
    version.version_id = f"{text} over {upstream.version_id}"
    version.git_hash = f"{everything[:40]}+{upstream.git_hash}"
    version.grpc_api_version.CopyFrom(upstream.grpc_api_version)
    return version


@dataclass(frozen=True)
class Upstream:
    """Another server of the renderer service.

    Attributes:
        address: ``HOST:PORT``.
        ca: PEM file: talk TLS and trust what it signed; None: plain text.
        token: Sent as ``authorization: Bearer TOKEN``; only over TLS.
        as_png: Ask for PNG whatever the caller wants, so that nothing is compressed twice.
    """

    address: str
    ca: Path | None = None
    token: str | None = None
    as_png: bool = True

    @classmethod
    def parse(cls, text: str) -> Upstream:
        """Read ``HOST:PORT[?ca=FILE&token_file=FILE&image=png|as-asked]``.

        Raises:
            InputError: Another option, or a file that cannot be read.
        """
        address, _, query = text.partition("?")
        options = options_of(query, ("ca", "token_file", "image"), f"--upstream {text}")
        image = options.get("image", "png")
        if not address or image not in ("png", "as-asked"):
            raise InputError(
                f"--upstream {text}: no address, or an image that is neither png nor as-asked",
                "write HOST:PORT[?ca=FILE&token_file=FILE&image=png|as-asked]",
            )
        ca, token = (Path(options[key]) if key in options else None for key in ("ca", "token_file"))
        return cls(address, ca, read_token(token), image == "png")

    def channel(self) -> Any:
        """Open a channel."""
        options = [*channel_options(self.address), *RECONNECT]
        if self.ca is None:
            if self.token is not None:
                raise InputError(
                    f"upstream {self.address}: a token over plain text",
                    "give ?ca=FILE as well",
                )
            return grpc.insecure_channel(self.address, options)
        credentials = grpc.ssl_channel_credentials(read_bytes(self.ca))
        if self.token is not None:
            credentials = grpc.composite_channel_credentials(
                credentials, grpc.access_token_call_credentials(self.token)
            )
        return grpc.secure_channel(self.address, credentials, options)


@dataclass(frozen=True)
class Settings:
    """Options of `simrun serve`.

    Attributes:
        renderer: ``onefixer``, ``identity``, ``3dgs``, ``onefixer+clean``, ...; over an upstream
            only the fixer counts.
        overrides: ``KEY=VALUE`` of the fixer's settings.
        scenes: Folders, files or shipped names.
        upstream: None: render here.
        device: For renderer and fixer.
        history_bytes, expiry_s: Bounds of the histories.
        masks: Grey masks by camera.
        render_width: Pixels; wider images are made at this width and enlarged. None: all are made
            as asked.
    """

    renderer: str = "onefixer"
    overrides: Sequence[str] = ()
    scenes: Sequence[str] = ()
    upstream: Upstream | None = None
    device: str = "cpu"
    history_bytes: int = 2 << 30
    expiry_s: float = 900.0
    masks: Mapping[str, Path] = field(default_factory=dict)
    render_width: int | None = None


@dataclass(frozen=True)
class Assembled:
    """A service with what belongs to it."""

    service: Sensorsim
    scenes: SceneCache | None
    fixers: FixerCache | None
    tree: HistoryTree[Answered]
    spec: RendererSpec
    channel: Any

    @property
    def services(self) -> dict[str, object]:
        """The service by its name, for one port."""
        return {"SensorsimService": self.service}

    def close(self) -> None:
        """Close the channel to the upstream: its threads must be gone before the interpreter ends,
        which otherwise may abort.
        """
        if self.channel is not None:
            self.channel.close()

    def expire(self) -> None:
        """Forget what nobody used for long."""
        self.tree.expire()


def _check_options(settings: Settings, spec: RendererSpec) -> None:
    """Refuse options that do not fit together.

    Raises:
        InputError: Neither scenes nor an upstream, or an option of the one with the other.
    """
    if settings.upstream is None and not settings.scenes:
        raise InputError(
            "the command: neither --scenes nor --upstream",
            "say what to render, or who renders",
        )
    if settings.upstream is not None and spec.fixer is None and settings.renderer != "identity":
        raise InputError(
            f"--upstream {settings.upstream.address}: {settings.renderer!r} renders itself",
            "give a fixer (onefixer), identity, or no --upstream",
        )
    if settings.upstream is None and settings.masks:
        raise InputError(
            "--mask: our own renderer states its opacity",
            "use them with --upstream",
        )
    if settings.upstream is not None and settings.render_width is not None:
        raise InputError(
            "--render-width: the upstream chooses the size of its images",
            "use it without --upstream",
        )


def assemble(settings: Settings) -> Assembled:
    """Build the renderer service.

    Raises:
        InputError: Settings that do not fit together, an unknown renderer, or scenes that cannot be
            found.
    """
    spec = resolve_served(settings.renderer, settings.overrides)
    _check_options(settings, spec)
    busy = threading.Lock()
    fixers = None if spec.fixer is None else FixerCache(spec, settings.device)
    needs_map = fixers is not None and fixers.needs_map
    scene_spec = spec if settings.upstream is None else None
    scenes = None
    if settings.scenes:
        scenes = SceneCache(settings.scenes, scene_spec, needs_map, settings.device)
    channel = stub = None
    source: FrameSource
    if settings.upstream is None:
        assert scenes is not None
        source = LocalSource(scenes, busy)
    else:
        channel = settings.upstream.channel()
        stub = Stub(channel, "SensorsimService")
        masks = read_masks(settings.masks)
        source = UpstreamSource(
            stub,
            scenes,
            masks,
            settings.upstream.as_png,
        )
    tree: HistoryTree[Answered] = HistoryTree(settings.history_bytes, settings.expiry_s)
    frames = FrameServer(source, fixers, tree, busy, settings.render_width)
    shaping = {
        "device": settings.device,
        "masks": {camera: file_sha256(path) for camera, path in settings.masks.items()},
        "upstream_png": settings.upstream is None or settings.upstream.as_png,
        "maps": needs_map and scenes is not None,
        "render_width": settings.render_width,
    }
    service = Sensorsim(
        frames,
        partial(version_of, spec, shaping),
        scenes,
        stub,
        verbatim=stub is not None and fixers is None,
    )
    return Assembled(service, scenes, fixers, tree, spec, channel)
