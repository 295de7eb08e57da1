"""How a job's dataclass is given on the command line: its fields are annotated with `Flag`, from
which the options are made.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Flag:
    """One option: a field ``look_every: Annotated[int, Flag("Scenes between looks.", min=1)] = 5``
    is ``--look-every``.

    Attributes:
        help: One sentence.
        name: Its name; by default the field's. ``--report/--no-report`` for both states of a field
            that is true or false.
        also: A second name, ``-o``.
        min: Least value.
        max: Largest value.
        metavar: What stands for the value in the help.
        names: Kind of parts, or ``scenario`` or ``preset``, whose names a Tab offers; empty: none.
    """

    help: str
    name: str = ""
    also: str = ""
    min: float | None = None
    max: float | None = None
    metavar: str | None = None
    names: str = ""


@dataclass(frozen=True)
class Positional:
    """One argument without a name of its own; the attributes are those of `Flag`."""

    help: str
    metavar: str | None = None
    names: str = ""
