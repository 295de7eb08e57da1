"""Write the table of the stages of every recipe into docs/lab/arms.md, from the code.

    python docs/scripts/recipe_table.py [--check]

With ``--check`` nothing is written, and the exit code is 1 where the page is stale.
"""

from __future__ import annotations

from pathlib import Path

from pages import DOCS, replaced, table, write

from alpasim_plugin.lab.training.recipes.recipe import INIT, INIT_BI, Stage
from alpasim_plugin.lab.training.recipes.registry import RECIPES

CLIPS = (12, 24)  # latents of the clips here, and of the paper's
SOURCES = {INIT: "`--init`", INIT_BI: "`--weights init-bi`"}
PARTS = {
    "dit": "transformer",
    "vae": "autoencoder",
    "vae.decoder": "decoder",
    "real": "teacher's score",
    "fake": "fake score",
    "head": "adversarial head",
}


def starts(stage: Stage) -> str:
    """Return where the parts of a stage begin: an option, or an earlier stage."""
    parts_of: dict[str, list[str]] = {}
    for part, source in stage.start.items():
        parts_of.setdefault(source.partition(".")[0], []).append(PARTS[part])
    if list(parts_of.values()) == [[PARTS["dit"]]]:
        (source,) = parts_of
        return SOURCES.get(source, f"`{source}`")
    return "; ".join(
        f"{SOURCES.get(source, f'`{source}`')}: {', '.join(parts)}"
        for source, parts in parts_of.items()
    )


def trains(stage: Stage) -> str:
    """Return the parts that a stage trains, each with its learning rate over the run's."""
    return ", ".join(
        f"{PARTS[part]} x {fraction(schedule.rate)}" for part, schedule in stage.trained.items()
    )


def fraction(rate: float) -> str:
    """Return a rate as a fraction of small numbers."""
    for below in (1, 3, 15, 75):
        above = round(rate * below)
        if above and abs(above / below - rate) < 1e-9:
            return str(above) if below == 1 else f"{above}/{below}"
    return f"{rate:g}"


def sees(stage: Stage) -> str:
    """Return block, window and sink of a stage, in latents, for both lengths of clips."""
    by_clip = {}
    for clip in CLIPS:
        latents = stage.latents or clip
        attention = stage.attention(latents)
        is_whole = attention.block_latents == attention.window == latents and latents > 1
        if is_whole:
            by_clip[clip] = "the clip" if stage.latents is None else f"{latents} at once"
        else:
            numbers = (attention.block_latents, attention.window, attention.sink)
            by_clip[clip] = ", ".join(map(str, numbers))
    if len(set(by_clip.values())) == 1:
        return by_clip[CLIPS[0]]
    return "; ".join(f"{text} of {clip}" for clip, text in by_clip.items())


def stage_table() -> str:
    """Return one row for each stage of each recipe; recipes whose stages are alike share theirs."""
    recipes_of: dict[tuple[tuple[str, ...], ...], list[str]] = {}
    for recipe in RECIPES.values():
        rows = tuple(
            (
                f"`{stage.name}`" if len(recipe.stages) > 1 else "",
                starts(stage),
                trains(stage),
                f"{stage.share:g} U",
                sees(stage),
            )
            for stage in recipe.stages
        )
        recipes_of.setdefault(rows, []).append(f"`{recipe.name}`")
    head = ("recipe", "stage", "starts from", "trains, x `--lr`", "updates")
    lines = []
    for rows, names in recipes_of.items():
        named = ", ".join(names)
        lines += [(named if row is rows[0] else "", *row) for row in rows]
    return table((*head, "block, window, sink"), lines)


def written() -> dict[Path, str]:
    """Return the page as it should be."""
    page = DOCS / "lab" / "arms.md"
    return {page: replaced(page.read_text(encoding="utf-8"), "stages", stage_table())}


if __name__ == "__main__":
    write(written())
