"""The baseline's side of a decision, where it was driven earlier: only the renderer in question is driven."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.plugins.parts import digest
from alpasim_plugin.run_folder.sides import Row, is_ok
from evaluators.gate.rows import of_policy, policies_of

DOING = "comparing with a stored baseline"
NAMED = 3  # missing rollouts in an error


@dataclass(frozen=True)
class StoredSide:
    """Rollouts of the baseline that were driven earlier.

    Attributes:
        renderer: Its renderer.
        name: What it is, in words.
        rows: One a rollout, of one renderer and policy.
    """

    renderer: str
    name: str
    rows: tuple[Row, ...]

    @property
    def digest(self) -> str:
        """Give a digest of all values."""
        return digest([[key, row[key]] for row in self.rows for key in sorted(row)])

    def of_cells(self, driven: Collection[tuple[str, int]]) -> list[Row]:
        """Return the rows of the scenes and seeds that are driven on the other side."""
        return [row for row in self.rows if (str(row["scene"]), int(row["seed"])) in driven]


def stored_side(
    rows: Sequence[Row], renderer: str, policy: str, planned: Collection[tuple[str, int]], max_missing: float, path: Path
) -> StoredSide:
    """Return the side of a renderer from the rows of a stored baseline.

    Args:
        rows: All of the baseline.
        renderer: Whose rows are wanted.
        policy: The policy that is driven.
        planned: Scenes and seeds that may be driven.
        max_missing: Share of them that it may lack.
        path: The baseline's file or folder.

    Raises:
        InputError: It lacks the renderer or the policy, or more of the planned rollouts than allowed.
    """
    mine = of_policy(rows, policy)
    if not mine:
        raise InputError(DOING, str(path), f"no rollout of policy {policy}", f"drive one of {', '.join(policies_of(rows))}")
    known = sorted({str(row["renderer"]) for row in mine})
    if renderer not in known:
        raise InputError(
            DOING,
            str(path),
            f"no rollout of renderer {renderer}",
            f"name one of {', '.join(known)}: `baseline` of a gate, --baseline of decide",
        )
    side = StoredSide(renderer, f"{renderer} of {path}", tuple(row for row in mine if row["renderer"] == renderer))
    there = {(str(row["scene"]), int(row["seed"])) for row in side.rows if is_ok(row)}
    lacking = sorted(set(planned) - there)
    if len(lacking) > max_missing * len(planned):
        named = ", ".join(f"{scene} seed {seed}" for scene, seed in lacking[:NAMED])
        found = f"{len(lacking)} of the {len(planned)} scenes and seeds that may be driven are not in it: {named}"
        raise InputError(DOING, str(path), found, "make the baseline on all scenes and seeds of the suite, or name a smaller suite")
    return side
