"""What differs between two runs that could have moved a result: code, weights, settings, scenes' content, versions, machine."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from evaluators.runs.entry import RunEntry

# Options that change nothing in a rollout or its scores: what is kept, what is compared, and how many processes work.
NO_EFFECT = frozenset(("workers", "threads_per_worker", "baseline", "video", "preset", "fixer"))  # the last two stand elsewhere
RECONSTRUCTED = "3dgs"
MOST_LETTERS = 60


@dataclass(frozen=True)
class Change:
    """One fact that differs.

    Attributes:
        what: Its name, such as ``policy lane-camera: code``.
        before: In the earlier run; "" where it had none.
        after: In the later run.
    """

    what: str
    before: str
    after: str

    def __str__(self) -> str:
        return self.what if self.before == self.after else f"{self.what} {self.before or 'none'} \u2192 {self.after or 'none'}"

    def as_dict(self) -> dict[str, str]:
        """Return the fields, for JSON."""
        return asdict(self)


def changes(before: RunEntry, after: RunEntry, renderer: str, policy: str) -> tuple[Change, ...]:
    """List what differs between two runs of one renderer and policy, the likeliest cause first.

    A part is named where its digest differs, which covers its code, the code that it imports, its settings and its files; so a commit that
    differs without anything else changed nothing that these rollouts use. Where settings or weights of a part differ, its digest does not
    tell whether its code does too. Parts of other renderers and policies are left out.

    Args:
        before: The earlier run.
        after: The later one.
        renderer: Whose line it is.
        policy: Behind what it drives.
    """
    sides = (before, after)
    found = [
        *_differences("weights", *(_weights(one, renderer, policy) for one in sides)),
        *(one for key in ("settings", "digest") for one in _parts(*sides, renderer, policy, key)),
        *_differences("code of the", *(one.info.get("code") or {} for one in sides)),
        *_differences("", *(_scenes(one, renderer) for one in sides)),
        *_differences("", *(_options(one) for one in sides)),
        *_differences("", *(_project(one) for one in sides)),
        *_differences("version of", *(one.info.get("versions") or {} for one in sides)),
        *_differences("machine:", *(one.info.get("hardware") or {} for one in sides)),
    ]
    return tuple(found)


def _differences(prefix: str, before: Mapping[str, Any], after: Mapping[str, Any]) -> list[Change]:
    names = [*before, *(name for name in after if name not in before)]
    pairs = ((name, _text(before.get(name)), _text(after.get(name))) for name in names if before.get(name) != after.get(name))
    return [Change(f"{prefix} {name}".strip(), *pair) for name, *pair in pairs]


def _text(value: Any) -> str:
    text = "" if value is None else value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= MOST_LETTERS else f"{text[: MOST_LETTERS - 1]}\u2026"


def _own_parts(entry: RunEntry, renderer: str, policy: str) -> dict[str, Mapping[str, Any]]:
    """Return the parts that shape one line: its renderer, the one below it and the fixer, the policy, all controllers and evaluators."""
    parts: Mapping[str, Mapping[str, Any]] = entry.info.get("parts") or {}
    fixer = ((entry.info.get("fixers") or {}).get(renderer) or {}).get("name")
    base = (entry.info.get("bases") or {}).get(renderer) or renderer
    wanted = {f"renderer {base}", f"policy {policy}", *([f"fixer {fixer}"] if fixer else [])}
    return {name: part for name, part in parts.items() if name in wanted or name.startswith(("controller ", "evaluator "))}


def _weights(entry: RunEntry, renderer: str, policy: str) -> dict[str, str]:
    """Return file name -> beginning of its SHA-256, of the parts of one line; of all where ``run.json`` has no parts."""
    parts = _own_parts(entry, renderer, policy)
    files = (
        [pair for part in parts.values() for pair in (part.get("files") or {}).items()]
        if parts
        else (entry.info.get("weights") or {}).items()
    )
    named: dict[str, set[str]] = {}
    for path, digest in files:
        named.setdefault(str(path).replace("\\", "/").rpartition("/")[2], set()).add(str(digest)[:12])
    return {name: ", ".join(sorted(digests)) for name, digests in sorted(named.items())}


def _parts(before: RunEntry, after: RunEntry, renderer: str, policy: str, key: str) -> Iterable[Change]:
    """List parts whose settings differ, one change a setting, or whose digest does although settings and files are the same."""
    here, there = (_own_parts(one, renderer, policy) for one in (before, after))
    for name in [*here, *(name for name in there if name not in here)]:
        old, new = here.get(name) or {}, there.get(name) or {}
        settings = [_flat(one.get("settings") or {}) for one in (old, new)]
        if key == "settings":
            yield from _differences(f"{name}:", *settings)
        elif old.get("digest") != new.get("digest") and settings[0] == settings[1] and _digests(old) == _digests(new):
            yield Change(f"{name}: code", *(str(one.get("digest") or "")[:12] for one in (old, new)))


def _digests(part: Mapping[str, Any]) -> list[str]:
    return sorted(map(str, (part.get("files") or {}).values()))


def _flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return dotted key -> value; paths of weight files are left out, since their digests tell."""
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{name}.")
        elif not (isinstance(value, str) and ("/" in value or "\\" in value)):
            flat[name] = value
    return flat


def _scenes(entry: RunEntry, renderer: str) -> dict[str, Any]:
    """Return the content of the scenes, and for `3dgs` which reconstruction of it was drawn: it is fitted to the scene's content."""
    found: dict[str, Any] = {f"content of {name}": digest[:12] for name, digest in entry.scenes.items()}
    if ((entry.info.get("bases") or {}).get(renderer) or renderer) == RECONSTRUCTED:
        scenes = entry.info.get("scenes") or {}
        found |= {f"reconstruction of {name}": (facts.get("reconstruction") or "")[:12] or None for name, facts in scenes.items()}
    return found


def _options(entry: RunEntry) -> dict[str, Any]:
    config = entry.info.get("config") or {}
    return {f"--{name}": value for name, value in config.items() if name not in NO_EFFECT} if entry.kind == "run" else dict(config)


def _project(entry: RunEntry) -> dict[str, Any]:
    return {"commit": entry.commit_text or None, "simrun": entry.info.get("version")}
