"""The version triple: it changes with everything that changes a picture.

AlpaSim's runtime compares the triples of all replicas, writes them into logs, and may keep forced frames under them.
"""

from __future__ import annotations

from typing import Any

from alpasim_plugin import __version__
from alpasim_plugin.plugins.parts import RendererSpec
from alpasim_plugin.plugins.parts.spec import digest
from alpasim_plugin.wire import api_version, common_pb2


def version_of(spec: RendererSpec, settings: dict[str, Any], upstream: common_pb2.VersionId | None = None) -> common_pb2.VersionId:
    """Return the triple of a service.

    Args:
        spec: Renderer and fixer.
        settings: What else shapes the pictures: device, scenes, reliability, masks.
        upstream: The upstream's own triple.

    Returns:
        ``version_id``: the product, then digests of weights, settings and code, then the upstream's id; ``git_hash``: one digest of all
        of it, followed by the upstream's; the wire version is the upstream's where there is one.
    """
    part = spec.base if spec.fixer is None else spec.fixer
    name = "identity" if spec.fixer is None and upstream is not None else spec.name
    weights = digest(sorted(part.files.values()))
    given = None if part.settings is None else part.settings.model_dump(mode="json")
    base = None if upstream is not None else spec.base.digest
    everything = digest([__version__, name, part.digest, base, given, settings])
    short = f"weights={weights[:12]}" if part.files else "weights=none"
    text = f"simrun-{__version__}+{name} {short} settings={digest([given, settings])[:12]} code={(part.digest or 'remote')[:12]}"
    version = common_pb2.VersionId(version_id=text, git_hash=everything[:40])
    if upstream is None:
        version.grpc_api_version.CopyFrom(api_version())
        return version
    version.version_id = f"{text} over {upstream.version_id}"
    version.git_hash = f"{everything[:40]}+{upstream.git_hash}"
    version.grpc_api_version.CopyFrom(upstream.grpc_api_version)
    return version
