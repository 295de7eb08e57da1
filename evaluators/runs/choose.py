"""Choose runs by what was driven, with what, and when."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from fnmatch import fnmatchcase
from pathlib import Path

from alpasim_plugin.core.errors import InputError
from evaluators.runs.entry import DOING, RunEntry, State

LEAST_DIGITS = 4  # of a commit or a digest: fewer name anything


@dataclass(frozen=True)
class Choice:
    """What a run must be; an empty member asks for nothing. Names may hold ``*`` and ``?``.

    Attributes:
        commits: Beginnings of the project's commit.
        weights: Beginnings of the SHA-256 of a weight file, or names of the file.
        renderers: The run has a renderer that each of these names.
        policies: Likewise.
        scenes: Likewise; a scene's id, or what the command named: a suite, a folder, a file.
        presets: One of them.
        states: One of them.
        since: Begun at or after.
        until: Begun before.
    """

    commits: tuple[str, ...] = ()
    weights: tuple[str, ...] = ()
    renderers: tuple[str, ...] = ()
    policies: tuple[str, ...] = ()
    scenes: tuple[str, ...] = ()
    presets: tuple[str, ...] = ()
    states: tuple[State, ...] = ()
    since: datetime | None = None
    until: datetime | None = None

    def __post_init__(self) -> None:
        for one in (*self.commits, *self.weights):
            if len(one) < LEAST_DIGITS:
                raise InputError(DOING, f"--commit or --weights {one!r}", "too short", f"give at least {LEAST_DIGITS} characters")

    def takes(self, entry: RunEntry) -> bool:
        """Tell whether a run is all that is asked for."""
        info, began = entry.info, entry.started_at
        named = [*entry.scenes, *map(str, info.get("asked") or ())]
        return (
            _any_begins(self.commits, [entry.commit])
            and _any_begins(self.weights, [text for pair in entry.weights for text in pair])
            and _each_is_named(self.renderers, info.get("renderers") or ())
            and _each_is_named(self.policies, info.get("policies") or ())
            and _each_is_named([_scene(one) for one in self.scenes], [_scene(one) for one in named])
            and (not self.presets or info.get("preset") in self.presets)
            and (not self.states or entry.state in self.states)
            and (self.since is None or (began is not None and began >= self.since))
            and (self.until is None or (began is not None and began < self.until))
        )


def chosen(entries: Iterable[RunEntry], choice: Choice) -> tuple[list[RunEntry], list[RunEntry]]:
    """Split runs into those that a choice takes, and those of the rest whose ``run.json`` is lost, so that nothing can be asked of them."""
    taken, lost = [], []
    for entry in entries:
        if choice.takes(entry):
            taken.append(entry)
        elif not entry.info and (not choice.states or entry.state in choice.states):
            lost.append(entry)
    return taken, lost


def _any_begins(asked: Sequence[str], texts: Iterable[str]) -> bool:
    known = [text.lower() for text in texts]
    return not asked or any(text.startswith(one.lower()) for one in asked for text in known)


def _each_is_named(asked: Sequence[str], known: Sequence[str]) -> bool:
    return all(any(fnmatchcase(name, one) for name in known) for one in asked)


def _scene(name: str) -> str:
    """Spell a scene or a suite one way: ``smoke/curve`` has the id ``smoke-curve``, and a suite's file ends with .yaml."""
    return name.removesuffix(".yaml").replace("/", "-").removeprefix("suites-")


def as_day(text: str, option: str, now: datetime) -> datetime:
    """Read a date, a time, or an age such as ``7d`` or ``12h``; without a zone it is UTC, as in ``run.json``.

    Example:
        >>> as_day("2d", "--since", datetime(2026, 3, 10, 12, tzinfo=UTC)).isoformat()
        '2026-03-08T12:00:00+00:00'
        >>> as_day("2026-03-01", "--since", datetime(2026, 3, 10, tzinfo=UTC)).isoformat()
        '2026-03-01T00:00:00+00:00'

    Raises:
        InputError: None of these.
    """
    hours = {"h": 1, "d": 24, "w": 168}.get(text[-1:])
    try:
        if hours is not None:
            return now - timedelta(hours=hours * float(text[:-1]))
        found = datetime.fromisoformat(text)
    except (ValueError, OverflowError):
        raise InputError(DOING, f"{option} {text}", "neither a date nor an age", "write 2026-03-01, 2026-03-01T18:00, 7d or 12h") from None
    return found if found.tzinfo is not None else found.replace(tzinfo=UTC)


def shown_folder(folder: Path, roots: Sequence[Path]) -> str:
    """Return a folder's path below the root that it was found in, where there is one root, else as it was found."""
    if len(roots) == 1 and folder != roots[0] and folder.is_relative_to(roots[0]):
        return folder.relative_to(roots[0]).as_posix()
    return str(folder)
