"""The grammar of what names a renderer on the command line; docs/cli.md shows it.

    renderers = renderer { "," renderer }
    renderer  = part | fixer [ "+" part ]
    fixer     = part [ "@" steps ] [ "[" key "=" value { "," key "=" value } "]" ]
    part      = name | module ":" Class | path ".py:" Class | scheme "://" address

A ``+`` stands between two parts only after the name of a fixer or after ``:Class``; any other
belongs to the path in which it stands. A folder that bears the name of a fixer, such as
``onefixer+old``, is written ``./onefixer+old``. Brackets hold settings only where ``KEY=VALUE``
stands in them: those of an IPv6 address belong to the address. Steps and settings may also stand at
the end, after the renderer.
"""

import re
from collections.abc import Collection
from dataclasses import dataclass, field

from alpasim_plugin.core.errors import InputError

NAME = r"[\w.-]+"
TARGET = r"[^\[\],]*[^\[\],:/]:[A-Za-z_]\w*"
STEPS = r"@[^\[\]+:/,]*"
SETTINGS = r"\[[^\[\]]*\]"
_AFTER_PART = rf"(?P<steps>{STEPS})?(?P<settings>{SETTINGS})?\+(?P<base>.+)"
_NAMED_FIXER = re.compile(rf"(?P<part>{NAME}){_AFTER_PART}")
_FIXER_OF_TARGET = re.compile(rf"(?P<part>{TARGET}?){_AFTER_PART}")
_PATH = re.compile(r"[^\[\],:]+\.py:[A-Za-z_]\w*(?=[@\[+]|$)")
_ALONE = re.compile(
    rf"(?P<part>{NAME}|{TARGET})(?P<steps>{STEPS})?(?P<settings>{SETTINGS})?", re.DOTALL
)
_AT_END = re.compile(r"(?P<base>.+?)(?P<steps>@[0-9]+)?(?P<settings>\[[\w.]+=[^\[\]]*\])?")
_SETTING = re.compile(r"[\w.]+=.+")


@dataclass(frozen=True)
class RendererName:
    """What the name of a renderer says.

    Attributes:
        part: The renderer, or the fixer.
        steps: Step count of the fixer, as written; empty where none stands.
        settings: ``KEY=VALUE`` of the fixer.
        base: The renderer below the fixer; empty where none stands.

    Example:
        >>> str(RendererName("onefixer", "2", ("references=0",), "clean"))
        'onefixer@2[references=0]+clean'
    """

    part: str
    steps: str = ""
    settings: tuple[str, ...] = field(default=())
    base: str = ""

    def __str__(self) -> str:
        steps = f"@{self.steps}" if self.steps else ""
        settings = f"[{','.join(self.settings)}]" if self.settings else ""
        base = f"+{self.base}" if self.base else ""
        return f"{self.part}{steps}{settings}{base}"


def parse_renderer(text: str, fixers: Collection[str]) -> RendererName:
    """Parse the name of a renderer.

    Args:
        text: As it is written on the command line.
        fixers: Every registered name of a fixer: what else stands before the ``+`` of a path is a
            part of the path.

    Raises:
        InputError: Brackets without ``KEY=VALUE``, or settings or steps twice.

    Example:
        >>> parse_renderer("onefixer+clean@2[references=0]", ["onefixer"])
        RendererName(part='onefixer', steps='2', settings=('references=0',), base='clean')
        >>> parse_renderer("nre://[::1]:50051", ["onefixer"]).part
        'nre://[::1]:50051'
        >>> parse_renderer("old+new/mine.py:Mine", ["onefixer"]).part
        'old+new/mine.py:Mine'
    """
    match = _NAMED_FIXER.fullmatch(text)
    if match is None or (match["part"] not in fixers and _PATH.match(text)):
        match = _FIXER_OF_TARGET.fullmatch(text)
    if match is None:
        return _without_base(text)
    base = match["base"]
    steps = _steps(match)
    settings = _settings(match["settings"], text)
    end = _AT_END.fullmatch(base)
    if end is not None and (end["steps"] or end["settings"]):
        if (end["steps"] and steps) or (end["settings"] and settings):
            raise _no_settings(text)
        base = end["base"]
        steps = steps or _steps(end)
        settings = settings or _settings(end["settings"], text)
    if _has_stray_bracket(base):
        raise _no_settings(text)
    return RendererName(match["part"], steps, settings, base)


def _without_base(text: str) -> RendererName:
    """Parse the name of one renderer, or of a fixer over the usual one."""
    match = _ALONE.fullmatch(text)
    if match is not None:
        return RendererName(match["part"], _steps(match), _settings(match["settings"], text))
    if _has_stray_bracket(text):
        raise _no_settings(text)
    return RendererName(text)


def _has_stray_bracket(text: str) -> bool:
    """Tell whether a name that should have no settings has brackets; addresses may."""
    return "://" not in text and ("[" in text or "]" in text)


def _steps(match: re.Match[str]) -> str:
    return (match["steps"] or "").removeprefix("@")


def _settings(brackets: str | None, text: str) -> tuple[str, ...]:
    if brackets is None:
        return ()
    settings = tuple(setting.strip() for setting in brackets[1:-1].split(","))
    if not all(_SETTING.fullmatch(setting) for setting in settings):
        raise _no_settings(text)
    return settings


def _no_settings(text: str) -> InputError:
    return InputError(
        f"renderer {text!r}: no settings in its brackets, or some twice",
        "write FIXER[KEY=VALUE,...]: onefixer[references=0]",
    )


def split_label(override: str) -> tuple[str, str]:
    """Split the renderer off an override that is meant for it alone: the label ends at the last
    colon before the key; empty where there is none.

    Example:
        >>> split_label("onefixer[references=0]:steps=2"), split_label("precision=bf16")
        (('onefixer[references=0]', 'steps=2'), ('', 'precision=bf16'))
    """
    match = re.fullmatch(
        r"(?:(?P<label>(?:[^=\[\]]|\[[^\[\]]*\])+?):)?(?P<rest>[\w.]+\s*=.*)", override, re.DOTALL
    )
    if match is None:
        return "", override
    return match["label"] or "", match["rest"]


def split_settings(name: str) -> tuple[str, tuple[str, ...]]:
    """Split the settings in brackets off a name; the brackets of an address belong to it.

    Raises:
        InputError: Brackets without ``KEY=VALUE`` in them, or more than one pair.

    Example:
        >>> split_settings("onefixer[references=0,precision=fp32]+clean")
        ('onefixer+clean', ('references=0', 'precision=fp32'))
        >>> split_settings("nre://[::1]:50051")
        ('nre://[::1]:50051', ())
    """
    brackets = [match for match in re.finditer(SETTINGS, name) if "=" in match[0]]
    if len(brackets) != 1:
        if brackets or _has_stray_bracket(name):
            raise _no_settings(name)
        return name, ()
    outside = name[: brackets[0].start()] + name[brackets[0].end() :]
    if _has_stray_bracket(outside):
        raise _no_settings(name)
    return outside, _settings(brackets[0][0], name)


def split_names(text: str) -> list[str]:
    """Split a list of names at its commas, but for those in brackets.

    Example:
        >>> split_names("3dgs, onefixer[references=0,recording=past]")
        ['3dgs', 'onefixer[references=0,recording=past]']
    """
    return [name.strip() for name in re.split(r",(?![^\[]*\])", text) if name.strip()]


def split_steps(name: str) -> tuple[str, int | None]:
    """Split ``NAME@STEPS``.

    Example:
        >>> split_steps("onefixer@2"), split_steps("a@b/mine.py:Mine")
        (('onefixer', 2), ('a@b/mine.py:Mine', None))
    """
    match = re.fullmatch(rf"(?P<plain>.*?)(?P<steps>{STEPS})?", name, re.DOTALL)
    plain = name if match is None else match["plain"]
    separator, count = name[len(plain) :][:1], name[len(plain) + 1 :]
    if separator and not re.fullmatch("[1-9][0-9]?", count):
        raise InputError(
            f"name {name!r}: {count!r} after @ is no step count",
            "write NAME@STEPS, such as onefixer@2",
        )
    return plain, int(count) if separator else None
