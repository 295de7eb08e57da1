"""The three completion scripts. Each holds the tables as text and does the rest in its own shell."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from alpasim_plugin.cli.completion import Completed

Names = Mapping[str, str]

_BASH = """# Completion of simrun for bash, made by: simrun completion bash
_simrun() {
    local cur="${COMP_WORDS[COMP_CWORD]}" prev="${COMP_WORDS[COMP_CWORD-1]}" verb=run words="" follows="" i
    local verbs="@VERBS@"
    for ((i = 1; i < COMP_CWORD; i++)); do
        case " $verbs " in *" ${COMP_WORDS[i]} "*) verb="${COMP_WORDS[i]}"
            case "$verb" in @GROUPS@)
                case "${COMP_WORDS[i+1]}" in -*|"$cur") ;; *) verb="$verb ${COMP_WORDS[i+1]}" ;; esac ;;
            esac
            break ;;
        esac
    done
    case "$verb:$prev" in
@VALUES@
        *)
            case "$verb" in
@COMMANDS@
            esac
            if ((COMP_CWORD == 1)); then words="$words $verbs"; fi ;;
    esac
    case "$follows" in
        @renderers) words="$words @RENDERERS@" ;;
        @policies) words="$words @POLICIES@" ;;
        @scenarios) words="$words @SCENARIOS@" ;;
    esac
    local lead=""
    case "$follows" in @renderers|@policies) case "$cur" in *,*) lead="${cur%,*},"; cur="${cur##*,}" ;; esac ;; esac
    COMPREPLY=($(compgen -P "$lead" -W "$words" -- "$cur"))
    case "$follows" in @files|@scenarios) COMPREPLY+=($(compgen -f -- "$cur")) ;; esac
}
complete -o filenames -o bashdefault -F _simrun simrun
"""

_ZSH = """#compdef simrun
# Completion of simrun for zsh, made by: simrun completion zsh
_simrun() {
    local cur="${words[CURRENT]}" prev="${words[CURRENT-1]}" verb=run choices="" follows="" i
    local verbs="@VERBS@"
    for ((i = 2; i < CURRENT; i++)); do
        if [[ " $verbs " == *" ${words[i]} "* ]]; then
            verb="${words[i]}"
            case "$verb" in (@GROUPS@) if ((i + 1 < CURRENT)) && [[ "${words[i+1]}" != -* ]]; then verb="$verb ${words[i+1]}"; fi ;; esac
            break
        fi
    done
    case "$verb:$prev" in
@VALUES@
        (*)
            case "$verb" in
@COMMANDS@
            esac
            if ((CURRENT == 2)); then choices="$choices $verbs"; fi ;;
    esac
    case "$follows" in
        (@renderers) choices="$choices @RENDERERS@" ;;
        (@policies) choices="$choices @POLICIES@" ;;
        (@scenarios) choices="$choices @SCENARIOS@" ;;
    esac
    case "$follows" in (@renderers|@policies) compset -P '*,' ;; esac
    compadd -- ${=choices}
    case "$follows" in (@files|@scenarios) _files ;; esac
}
if [ "$funcstack[1]" = "_simrun" ]; then _simrun "$@"; else compdef _simrun simrun; fi
"""


def bash(commands: Sequence[Completed], names: Names) -> str:
    """Return the script for bash."""
    return _posix(_BASH, commands, names, "words", "{})")


def zsh(commands: Sequence[Completed], names: Names) -> str:
    """Return the script for zsh."""
    return _posix(_ZSH, commands, names, "choices", "({})")


def fish(commands: Sequence[Completed], names: Names) -> str:
    """Return the script for fish."""
    verbs = _verbs(commands)
    lines = [
        "# Completion of simrun for fish, made by: simrun completion fish",
        f"set -l verbs {' '.join(verbs)}",
        'complete -c simrun -n "not __fish_seen_subcommand_from $verbs" -a "$verbs"',
    ]
    for one in commands:
        seen = " ".join(f"; and __fish_seen_subcommand_from {word}" for word in one.words)[6:]
        where = f"not __fish_seen_subcommand_from {' '.join(verb for verb in verbs if verb != 'run')}" if one.words == ("run",) else seen
        condition = f"-n '{where}'"
        if len(one.words) == 2:
            lines.append(f"complete -c simrun -f -n '__fish_seen_subcommand_from {one.words[0]}' -a '{one.words[1]}'")
        words = names.get(one.positional, "" if one.positional.startswith("@") else one.positional)
        if words:
            lines.append(f"complete -c simrun {condition} -a '{words}'")
        for flag, follows in one.options.items():
            option = f"-l {flag[2:]}" if flag.startswith("--") else f"-s {flag[1:]}"
            if follows is None:
                lines.append(f"complete -c simrun {condition} {option}")
            elif follows == "@files":
                lines.append(f"complete -c simrun {condition} {option} -r")
            else:
                lines.append(f"complete -c simrun {condition} {option} -x -a '{names.get(follows, follows)}'")
    return "\n".join(lines) + "\n"


def _posix(script: str, commands: Sequence[Completed], names: Names, variable: str, pattern: str) -> str:
    """Fill a script of ``case`` patterns: what follows an option, and what a command takes."""
    values, taken = [], []
    for one in commands:
        command = " ".join(one.words)
        by_value: dict[str, list[str]] = {}
        for flag, follows in one.options.items():
            if follows is not None:
                by_value.setdefault(follows, []).append(f'"{command}:{flag}"')
        for follows, flags in by_value.items():
            values.append(f"        {pattern.format('|'.join(flags))} {_then(variable, '', follows)} ;;")
        options = " ".join(one.options)
        taken.append(f"                {pattern.format(chr(34) + command + chr(34))} {_then(variable, options, one.positional)} ;;")
    groups = {one.words[0] for one in commands if len(one.words) == 2}
    for group in sorted(groups):
        inner = " ".join(one.words[1] for one in commands if one.words[0] == group and len(one.words) == 2)
        taken.append(f"                {pattern.format(chr(34) + group + chr(34))} {_then(variable, inner, '')} ;;")
    filled = {
        "@VERBS@": " ".join(_verbs(commands)),
        "@GROUPS@": "|".join(sorted(groups)),
        "@VALUES@": "\n".join(values),
        "@COMMANDS@": "\n".join(taken),
        **{f"{mark.upper()}@": text for mark, text in names.items()},
    }
    for mark, text in filled.items():
        script = script.replace(mark, text)
    return script


def _then(variable: str, words: str, follows: str) -> str:
    own, mark = (words, follows) if follows.startswith("@") else (f"{words} {follows}".strip(), "")
    return f'{variable}="{own}"; follows="{mark}"'


def _verbs(commands: Sequence[Completed]) -> list[str]:
    return list(dict.fromkeys(one.words[0] for one in commands))


SCRIPTS: dict[str, Callable[[Sequence[Completed], Names], str]] = {"bash": bash, "zsh": zsh, "fish": fish}
