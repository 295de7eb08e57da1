"""The paper's appearance experiment as a section of the document: its table, ours by style, and the
differences from the controls.
"""

from __future__ import annotations

from collections.abc import Mapping

from alpasim_plugin.lab.learned_metrics.facts import LANE_F1, LANE_XERR, STYLE_ACC, of_seed
from alpasim_plugin.lab.paper.measured import Measured
from alpasim_plugin.lab.paper.published import Published
from alpasim_plugin.lab.paper.tables import (
    differences,
    interval_text,
    markdown_table,
    paper_against_ours,
)

PROTOCOL = "appearance"
OURS = "appearance"  # the arm, as its recipe
TARGET = "target"  # clean frames by the formula
METRICS = (
    STYLE_ACC,
    of_seed(STYLE_ACC, 1),
    LANE_F1,
    of_seed(LANE_F1, 1),
    LANE_XERR,
    of_seed(LANE_XERR, 1),
    "psnr_db",
    "perceptual-syn",
)
ABOUT = """One fixer renders the clear render in the style that its prompt asks for. The controls `V9 + formula` and `3dgs + formula` are
another system's output restyled by the formula that makes the targets, with the simulator's depth and lamps, which no fixer sees. `target`
is the clean frame by the same formula: what the judges say of a perfect output. Lanes are compared with those found on the clear clean
frames; PSNR and `perceptual-syn` with the target. Cosmos3 and Qwen-Video-Edit need weights of others and have no counterpart here.
"""


def control(label: str) -> str:
    """Return the name of a system's output by the formula."""
    return f"{label} + formula"


def protocol_of(style: str) -> str:
    """Return the protocol of one style; `PROTOCOL` is the mean over styles, clip by clip.

    Example:
        >>> protocol_of("fog")
        'appearance-fog'
    """
    return f"{PROTOCOL}-{style}"


def appearance_section(published: Published, measured: Mapping[str, Measured]) -> str:
    """Return the section; empty where it was not run.

    Args:
        published: The paper's numbers.
        measured: PROTOCOL -> what was measured.
    """
    if PROTOCOL not in measured:
        return ""
    parts = [ABOUT, paper_against_ours(published, PROTOCOL, measured[PROTOCOL])]
    styles = [name for name in measured if name.startswith(f"{PROTOCOL}-")]
    rows = [
        [
            f"**{name.removeprefix(f'{PROTOCOL}-')}**, {arm}",
            *(interval_text(measured[name], arm, metric) for metric in METRICS),
        ]
        for name in styles
        for arm in (*measured[name].arms, TARGET)
    ]
    parts.append(markdown_table(["style, arm", *(f"`{metric}`" for metric in METRICS)], rows))
    for name in (PROTOCOL, *styles):
        mine = measured[name]
        rivals = [arm for arm in mine.arms if arm != OURS]
        what = "All styles" if name == PROTOCOL else name.removeprefix(f"{PROTOCOL}-").capitalize()
        parts.append(f"{what}, paired over clips:\n\n" + differences(mine, OURS, rivals, METRICS))
    most = max(len(clips) for clips in measured[PROTOCOL].values.values())
    parts.append(f"{most} clips; 95 % t intervals.\n")
    return "\n".join(parts)
