"""``bidnerf completion``: completion of commands and options in a shell, from the declarations of the commands."""

from __future__ import annotations

from typing import Annotated, Literal

from bidnerf.cli.output import print_result
from bidnerf.cli.parameters import Option, SettingsGroup, leaves
from bidnerf.cli.program import COMMANDS

BASH = """_bidnerf() {{
  local words="{commands}"
  [ "$COMP_CWORD" -gt 1 ] && case "${{COMP_WORDS[1]}}" in
{cases}
    *) words="" ;;
  esac
  COMPREPLY=($(compgen -W "$words" -- "${{COMP_WORDS[COMP_CWORD]}}"))
}}
complete -o default -F _bidnerf bidnerf"""
"""A script for bash, and for zsh with its emulation of that completion; -o default completes the names of files."""


def run_completion(
    shell: Annotated[Literal["bash", "zsh", "fish"], Option("SHELL", "bash, zsh or fish", positional=True)],
) -> None:
    """Print a script that completes commands and options in a shell.

    For bash and zsh, put  eval "$(bidnerf completion bash)"  into the file that starts the shell, with zsh in place of bash; for fish,
    bidnerf completion fish | source. Options of a method or a backend, which --help-all describes, are not completed.
    """
    options = {
        name: [
            p.flag for p, _ in leaves(COMMANDS[name], {}) if not p.option.positional and p.note(SettingsGroup) is None
        ]
        for name in COMMANDS
    }
    if shell == "fish":
        lines = [f"complete -c bidnerf -n __fish_use_subcommand -f -a '{' '.join(options)}'"]
        for name, flags in options.items():
            lines += [f"complete -c bidnerf -n '__fish_seen_subcommand_from {name}' -l {flag[2:]}" for flag in flags]
    else:
        cases = "\n".join(f'    {name}) words="{" ".join(flags)}" ;;' for name, flags in options.items())
        lines = BASH.format(commands=" ".join(options), cases=cases).splitlines()
    starts = {"zsh": ["autoload -U +X bashcompinit && bashcompinit"]}
    print_result(None, starts.get(shell, []) + lines, json=False)
