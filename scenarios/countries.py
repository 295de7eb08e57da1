"""What the country of a map decides where the map itself does not say it: the colour of the line
between lanes of opposite directions, and who goes first where roads cross without a sign.
"""

import re
from collections.abc import Iterable

from alpasim_plugin.core.types import LaneMarkType

CODE = re.compile("[A-Za-z]{2,3}")

# Codes of ISO 3166 of countries whose lines between opposite directions are yellow.
YELLOW = frozenset(
    [
        "AR",
        "ARG",
        "BR",
        "BRA",
        "CA",
        "CAN",
        "CL",
        "CHL",
        "CN",
        "CHN",
        "CO",
        "COL",
        "KR",
        "KOR",
        "MX",
        "MEX",
        "NO",
        "NOR",
        "PE",
        "PER",
        "TH",
        "THA",
        "TW",
        "TWN",
        "US",
        "USA",
    ]
)
# West, south, east and north of boxes that cover Japan and no other country, degrees.
JAPAN = (
    (122.9, 24.0, 131.5, 30.5),
    (129.6, 30.0, 142.0, 34.8),
    (132.0, 33.5, 142.2, 41.6),
    (139.3, 41.3, 146.0, 45.6),
)


def country_of(codes: Iterable[str]) -> str | None:
    """Return the country that the roads of a map name; None where they name none, or countries with
    different lines. What has not two or three letters is no code of ISO 3166.
    """
    named = sorted({code.upper() for code in codes if CODE.fullmatch(code)})
    lines = {centre_line(code) for code in named}
    return named[0] if len(lines) == 1 else None


def centre_line(country: str | None) -> LaneMarkType:
    """Return the line between opposite directions where a map does not know it; without a country
    that of the streets that are built here, double yellow.

    Args:
        country: A code of ISO 3166 of two or three letters.
    """
    if country is None or country.upper() in YELLOW:
        return "double_yellow"
    return "dashed_white"


def first_from_right(country: str | None) -> bool:
    """Return whether, where no sign stands, who comes from the right goes first; in Japan who comes
    from the left does (Road Traffic Act, article 36).
    """
    return country is None or country.upper() not in ("JP", "JPN")


def country_at(lat_deg: float, lon_deg: float) -> str | None:
    """Return the country of a place; None for all but Japan."""
    is_japan = any(
        west <= lon_deg <= east and south <= lat_deg <= north for west, south, east, north in JAPAN
    )
    return "JP" if is_japan else None
