"""Seeds make scenes: declared variations and, for other seeds than 0, jitter of the numbers of a scenario file.

Every drawn number has its own stream, keyed by scene, seed and the number's key path, so adding an
actor does not change the others.
"""

import json
import os
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import real
from alpasim_plugin.core.files.config import (
    Document,
    Key,
    apply_overrides,
    apply_values,
    dotted,
    override_locations,
    validate,
)
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.core.seeding import stream
from scenarios.schema import RangeSpec, ScenarioSpec
from scenarios.schema_parts import Part

# Key of a number -> what `JitterSpec` calls its range.
JITTERED = {
    "length_m": "length",
    "curvature_per_m": "curvature",
    "start_curvature_per_m": "curvature",
    "end_curvature_per_m": "curvature",
    "speed_mps": "speed",
    "cruise_mps": "speed",
    "desired_speed_mps": "speed",
    "end_speed_mps": "speed",
    "lane_width_m": "lane_width",
    "s_m": "position_m",
    "at_us": "time_us",
    "brake_at_us": "time_us",
}
AS_WRITTEN = 0  # the scene seed that jitters nothing


@dataclass(frozen=True)
class SceneDraft:
    """A scenario file as a scene seed makes it."""

    document: Document  # with overrides and variations written into it, for the positions of keys
    spec: ScenarioSpec
    scene_id: str
    reseeded: bool  # the seed is another one than the file's
    varied: dict[str, tuple[Any, Any]]  # see `differences`

    @contextmanager
    def at(self, *loc: str | int) -> Iterator[None]:
        """Put the position of a key path in front of what an error of the block names."""
        try:
            yield
        except InputError as e:
            raise InputError(f"{self.document.mark(loc)}: {e.message}", e.hint) from e


def draw(document: Document, seed: int | None, overrides: Sequence[str]) -> SceneDraft:
    """Validate a document and draw its variations and its jitter.

    Args:
        document: Scenario file, or what stands for a recorded log.
        seed: Scene seed; None takes the file's.
        overrides: ``key=value`` with dotted keys; what they fix is neither varied nor jittered.

    Raises:
        InputError: A key or value that the schema refuses, or a name that stands twice, with its
            position.
    """
    as_read = document
    document = apply_overrides(document, overrides)
    own_seed = document.data.get("seed", 0) if isinstance(document.data, dict) else 0
    if seed is not None:
        document = apply_overrides(document, [f"seed={int(seed)}"])
    written = validate(ScenarioSpec, document)
    scene_id = written.scene_id or _default_id(Path(document.path))
    located = override_locations(as_read, overrides)
    ids = {str(i): actor.id for i, actor in enumerate(written.actors)}
    fixed = frozenset(
        _with_id((*loc, *below), written) for loc, value in located for below in _paths_below(value)
    )
    kept = [
        f"{key}={json.dumps(value)}"
        for key, value in _drawn_values(written, scene_id).items()
        if fixed.isdisjoint(_and_above(_by_id(key, ids)))
    ]
    document = apply_overrides(document, kept, origin="variation")
    # A variation of a whole section leaves what the user set in it.
    document = apply_values(document, _lasting(located))
    spec = validate(ScenarioSpec, document)
    _check_actors(document, spec)
    if spec.seed != AS_WRITTEN:
        spec = _jitter(spec, scene_id, fixed)
    return SceneDraft(document, spec, scene_id, spec.seed != own_seed, differences(written, spec))


def _drawn_values(spec: ScenarioSpec, scene_id: str) -> JsonObject:
    """Draw a value for each key that varies, each from a stream of its own."""
    values: JsonObject = {}
    for key, rule in spec.variations.items():
        rng = stream(scene_id, spec.seed, f"scenario/variation/{key}")
        if isinstance(rule, RangeSpec):
            values[key] = float(rng.uniform(rule.low, rule.high))
        else:
            values[key] = rule.choice[int(rng.integers(len(rule.choice)))]
    return values


def _check_actors(document: Document, spec: ScenarioSpec) -> None:
    """Refuse actors of one id, and actors where a log or a map brings the traffic."""
    index_by_id: dict[str, int] = {}
    for i, actor in enumerate(spec.actors):
        if actor.id in index_by_id:
            first = document.mark(("actors", index_by_id[actor.id], "id"))
            raise document.error(
                ("actors", i, "id"),
                f"duplicate actor id {actor.id!r}, first at {first}",
                "give it another id",
            )
        index_by_id[actor.id] = i
    if spec.road is None and spec.actors:
        raise document.error(
            ("actors",),
            "actors beside a recorded log or a map",
            "remove actors; log.actors and map.vehicles choose the traffic",
        )


def _default_id(path: Path) -> str:
    resolved = real(path)
    if path.suffix in (".yaml", ".yml"):
        return f"{resolved.parent.name}-{resolved.stem}"
    return resolved.stem if os.path.isfile(resolved) else resolved.name


def _jitter(spec: ScenarioSpec, scene_id: str, fixed: Collection[str]) -> ScenarioSpec:
    """Return the specification with road, ego and actors changed within the declared ranges."""
    ids = {str(i): actor.id for i, actor in enumerate(spec.actors)}
    touched = {_by_id(key, ids) for key in (*fixed, *spec.variations)}

    def walk(part: Any, loc: tuple[str | int, ...]) -> Any:
        if isinstance(part, Part):
            names = type(part).model_fields
            return part.model_copy(update={k: walk(getattr(part, k), (*loc, k)) for k in names})
        if isinstance(part, tuple) and part and isinstance(part[0], Part):
            # Actors are named by their ids, so that the order of the list does not matter.
            return tuple(walk(item, (*loc, getattr(item, "id", i))) for i, item in enumerate(part))
        kind = JITTERED.get(str(loc[-1]))
        if kind is None or part is None or ".".join(map(str, loc)) in touched:
            return part
        if kind == "length" and loc[0] != "road":
            return part
        # One factor bends the whole road, so that transitions still end with the curvature of the
        # arc after them.
        # An actor's speeds share one factor, so that who slows down still does.
        key = kind if kind == "curvature" else dotted(loc).replace("end_speed_mps", "speed_mps")
        u = float(stream(scene_id, spec.seed, f"scenario/jitter/{key}").uniform(-1.0, 1.0))
        reach = u * getattr(spec.jitter, kind)
        if kind == "time_us":
            return max(0, part + round(reach))
        return part + reach if kind == "position_m" else part * (1.0 + reach)

    update = {name: walk(getattr(spec, name), (name,)) for name in ("road", "ego", "actors")}
    jittered = spec.model_copy(update=update)
    try:
        return ScenarioSpec.model_validate(jittered.model_dump(by_alias=True, exclude_unset=True))
    except ValidationError as error:
        first = error.errors()[0]
        raise InputError(
            f"{scene_id}, seed {spec.seed}: jitter makes {dotted(first['loc'])} = {first['input']}: "
            f"{first['msg']}",
            "lower a range of jitter, or move the number away from its bound",
        ) from None


def differences(written: ScenarioSpec, scene_spec: ScenarioSpec) -> dict[str, tuple[Any, Any]]:
    """Return every key whose value the scene seed has changed, dotted, with the value as written
    (None: absent) and as drawn.
    """
    before = _flat(written, ())
    after = _flat(scene_spec, ())
    return {
        key: (before.get(key), value) for key, value in after.items() if before.get(key) != value
    }


def _flat(part: Any, loc: tuple[str | int, ...]) -> JsonObject:
    """Return dotted keys and plain values of a specification; actors go by their ids."""
    if isinstance(part, Part):
        rules = {"jitter", "variations"} if not loc else set()
        pairs: list[tuple[str | int, Any]] = [
            (name, getattr(part, name)) for name in type(part).model_fields if name not in rules
        ]
    elif isinstance(part, tuple) and part and isinstance(part[0], Part):
        pairs = [(getattr(item, "id", i), item) for i, item in enumerate(part)]
    else:
        return {".".join(map(str, loc)): part}
    return {key: value for name, item in pairs for key, value in _flat(item, (*loc, name)).items()}


def _paths_below(value: Any) -> Iterator[tuple[str | int, ...]]:
    """Yield the path of a plain value itself, and of everything inside it."""
    yield ()
    inside: list[tuple[str | int, Any]] = []
    if isinstance(value, dict):
        inside = [*value.items()]
    elif isinstance(value, list):
        ids = [part.get("id", i) if isinstance(part, dict) else i for i, part in enumerate(value)]
        inside = [*zip(ids, value, strict=True)]
    for key, part in inside:
        yield from ((key, *below) for below in _paths_below(part))


def _and_above(key: str) -> set[str]:
    """Return a dotted key and those that hold it."""
    parts = key.split(".")
    return {".".join(parts[:n]) for n in range(1, len(parts) + 1)}


def _lasting(located: Sequence[tuple[Key, Any]]) -> list[tuple[Key, Any]]:
    """Return the values that no later one replaces, itself or with the section that holds it."""
    return [
        (loc, value)
        for n, (loc, value) in enumerate(located)
        if not any(loc[: len(later)] == later for later, _ in located[n + 1 :])
    ]


def _with_id(loc: Key, spec: ScenarioSpec) -> str:
    """Write a key path with dots, and an actor by its id."""
    parts = [*loc]
    index = parts[1] if len(parts) > 1 and parts[0] == "actors" else None
    if isinstance(index, int) and index < len(spec.actors):  # else a later value took it away
        parts[1] = spec.actors[index].id
    return ".".join(map(str, parts))


def _by_id(key: str, ids: dict[str, str]) -> str:
    """Write ``actors.0.s_m`` as ``actors.lead.s_m``, unless an actor has the id ``0``."""
    head, _, below = key.partition(".")
    item, _, tail = below.partition(".")
    is_index = head == "actors" and item in ids and item not in ids.values()
    return f"actors.{ids[item]}.{tail}" if is_index else key
