"""``simrun train``: training data and networks."""

from __future__ import annotations

import typer

from alpasim_plugin.lab.cli import (
    adapt,
    train_detector,
    train_fixer,
    train_pairs,
    train_per_frame,
    train_photographs,
    train_policy,
    train_scenes,
)

app = typer.Typer(no_args_is_help=True, help="Make training data and train networks.")


@app.callback()
def train() -> None:
    """Make training data and train networks."""


app.command("scenes", epilog=train_scenes.EPILOG)(train_scenes.scenes)
app.command("pairs", epilog=train_pairs.EPILOG)(train_pairs.pairs)
app.command("photographs", epilog=train_photographs.EPILOG)(train_photographs.photographs)
app.command("per-frame", epilog=train_per_frame.EPILOG)(train_per_frame.per_frame)
app.command("fixer", epilog=train_fixer.EPILOG)(train_fixer.fixer)
app.command("detector", epilog=train_detector.EPILOG)(train_detector.detector)
app.command("policy", epilog=train_policy.EPILOG)(train_policy.policy)
app.command("adapt", epilog=adapt.EPILOG)(adapt.adapt)
