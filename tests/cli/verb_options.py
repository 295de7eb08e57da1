"""The verbs of the core and their options."""

from alpasim_plugin.cli.main import PANELS, load_verb

OWN = [verb for panel in PANELS.values() for verb in panel]


def verbs_below(command, path=()):
    """Yield every command that does something, with the words that call it."""
    if hasattr(command, "commands"):
        for name, inner in command.commands.items():
            yield from verbs_below(inner, (*path, name))
    else:
        yield path, command


CORE = dict(item for verb in OWN for item in verbs_below(load_verb(verb), (verb,)))


def options_of(command):
    """Return the long name of every option of a command; of one with two states the second, which
    is not the default.
    """
    names = [
        [name for name in (*parameter.opts, *parameter.secondary_opts) if name.startswith("--")]
        for parameter in command.params
    ]
    return [found[-1] for found in names if found and found[0] != "--help"]
