"""Which scenes one of several machines drives: ``--shard I/N``."""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from alpasim_plugin.core.errors import InputError
from scenarios.load import load_scenario, scene_id_of
from scenarios.suite import ScenarioRef
from scenarios.usdz import usdz_scene_id


def shard_of(refs: Sequence[ScenarioRef], shard: str) -> list[ScenarioRef]:
    """Return every N-th scene, from the I-th on, for a shard ``I/N``.

    Scenes are counted by their ids: in which shard one is follows from which scenes there are, not
    from the order in which they are named, nor from how.

    Raises:
        InputError: ``shard`` is not I/N with 1 <= I <= N, there are fewer than I scenes, or two
            scenes have one id.
    """
    match = re.fullmatch(r"([0-9]+)/([0-9]+)", shard)
    number, count = (int(match[1]), int(match[2])) if match else (0, 0)
    if not 1 <= number <= count:
        raise InputError(f"--shard {shard}: not I/N with 1 <= I <= N", "Write for example 3/16.")
    by_id = _by_id(refs)
    if number > len(by_id):
        raise InputError(
            f"--shard {shard}: there are only {len(by_id)} scenes", "Use at most as many shards."
        )
    return [by_id[scene_id] for scene_id in sorted(by_id)[number - 1 :: count]]


def _by_id(refs: Iterable[ScenarioRef]) -> dict[str, ScenarioRef]:
    """Return scenes by id; of two spellings of one scene the first.

    Raises:
        InputError: Two scenes have one id.
    """
    by_id: dict[str, ScenarioRef] = {}
    for ref in refs:
        is_archive = ref.path.endswith(".usdz") and ref.seed is None
        scene_id = usdz_scene_id(Path(ref.path)) if is_archive else scene_id_of(ref)
        other = by_id.setdefault(scene_id, ref)
        if other != ref and _content(other) != _content(ref):
            raise InputError(
                f"{other.path} and {ref.path}: both have the scene id {scene_id!r}",
                "give one of them another id, or name it once",
            )
    return by_id


def _content(ref: ScenarioRef) -> str:
    return load_scenario(ref.path, ref.seed, ref.overrides, ref.source).content_hash
