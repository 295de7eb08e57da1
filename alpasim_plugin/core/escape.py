"""Text from scenes, logs and parts made harmless for the place where it is shown: terminal,
Markdown, XML.

HTML is escaped by the report's template engine. None of these functions changes plain words.
"""

import re

MAX_PART = 600  # characters of the message of an error, and of its hint

# What a terminal acts upon: C0 and C1 controls, and the marks that turn the direction of text.
_CONTROLS = re.compile(
    "[\x00-\x1f\x7f-\xa0\u061c\u200e\u200f\u2028\u2029\u202a-\u202e\u2066-\u2069]|[\ud800-\udfff]"
)
# What XML 1.0 has no way to write (section 2.2, production Char).
_NOT_XML = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
# an underscore inside a word means nothing
_MARKDOWN = re.compile(r"([\\`*\[\]|~#!]|(?<![^\W_])_|_(?![^\W_]))")


def shorten(text: str, most: int = MAX_PART) -> str:
    """Return text of at most ``most`` characters: the beginning and the end, where the facts are,
    with how much lies between.

    Example:
        >>> shorten("a" * 50 + "b" * 50, 40)
        'aaaaaaaaaa ... (80 more) ... bbbbbbbbbb'
    """
    if len(text) <= most:
        return text
    mark = f" ... ({len(text)} more) ... "
    head = (most - len(mark)) // 2
    return f"{text[:head]} ... ({len(text) - 2 * head} more) ... {text[-head:]}"


def terminal(text: str) -> str:
    r"""Return text on one line in which nothing makes a terminal act: line ends and no-break spaces
    become spaces, other control characters escapes.

    Example:
        >>> terminal("red\x1b[31m")
        'red\\x1b[31m'
    """
    return _CONTROLS.sub(
        lambda match: " " if match[0] in "\t\n\v\f\r\xa0\u2028\u2029" else _written(match[0]), text
    )


def markdown(text: str) -> str:
    r"""Return text for a cell of a Markdown table: one line, with every character that Markdown or
    HTML reads escaped.

    Example:
        >>> markdown("a|b <i>")
        'a\\|b &lt;i&gt;'
    """
    plain = terminal(text).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return _MARKDOWN.sub(r"\\\1", " ".join(plain.split()))


def xml(text: str) -> str:
    r"""Return text that an XML 1.0 document can hold, before the writer escapes its markup: other
    characters are written as escapes.

    Example:
        >>> xml("a\x00b")
        'a\\x00b'
    """
    return _NOT_XML.sub(lambda match: _written(match[0]), text)


def _written(character: str) -> str:
    code = ord(character)
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}"
