"""The grammar of what names a renderer on the command line; docs/cli.md shows it.

    renderers = renderer { "," renderer }
    renderer  = part | fixer [ "+" part ]
    fixer     = part [ "@" steps ] [ "[" key "=" value { "," key "=" value } "]" ]
    part      = name | module ":" Class | path ".py:" Class | scheme "://" address

A ``+`` stands between two parts only after a whole name or ``:Class``: the ``+`` of a path belongs
to the path. Brackets hold settings only where ``KEY=VALUE`` stands in them: those of an IPv6
address belong to the address. Steps and settings may also stand at the end, after the renderer.
"""

import re
from dataclasses import dataclass, field

from alpasim_plugin.core.errors import InputError

NAME = r"[\w.-]+"
TARGET = r"[^\[\],]*[^\[\],:/]:[A-Za-z_]\w*"
STEPS = r"@[^\[\]+:/,]*"
SETTINGS = r"\[[^\[\]]*\]"
_FIXER = re.compile(
    rf"(?P<part>{NAME}|{TARGET}?)(?P<steps>{STEPS})?(?P<settings>{SETTINGS})?\+(?P<base>.+)"
)
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


def parse_renderer(text: str) -> RendererName:
    """Parse the name of a renderer.

    Raises:
        InputError: Brackets without ``KEY=VALUE``, or settings or steps twice.

    Example:
        >>> parse_renderer("onefixer+clean@2[references=0]")
        RendererName(part='onefixer', steps='2', settings=('references=0',), base='clean')
        >>> parse_renderer("nre://[::1]:50051").part
        'nre://[::1]:50051'
    """
    match = _FIXER.fullmatch(text)
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
    settings = tuple(part.strip() for part in brackets[1:-1].split(","))
    if not all(_SETTING.fullmatch(part) for part in settings):
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
