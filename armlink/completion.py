"""Completion of commands, options, bundled arms and files in a shell; `armlink completion SHELL` prints the script."""

from collections.abc import Iterable
from importlib.metadata import EntryPoint
from typing import Any

WORD = "--complete"
"""First argument by which the shell's script asks: the words so far follow, the unfinished one last."""
SCRIPTS = {
    "bash": """_armlink() {
    local IFS=$'\\n'
    COMPREPLY=($(armlink --complete "${COMP_WORDS[@]:1:COMP_CWORD}" 2>/dev/null))
}
complete -o default -o bashdefault -F _armlink armlink
""",
    "zsh": """_armlink() {
    local -a found
    found=("${(@f)$(armlink --complete "${(@)words[2,CURRENT]}" 2>/dev/null)}")
    [[ -n "$found" ]] && compadd -a found || _files
}
compdef _armlink armlink
""",
    "fish": """complete -c armlink -a '(armlink --complete (commandline -opc)[2..] (commandline -ct) 2>/dev/null)'
""",
}
USE = {
    "bash": 'eval "$(armlink completion bash)"  # in ~/.bashrc',
    "zsh": 'eval "$(armlink completion zsh)"  # in ~/.zshrc, after compinit',
    "fish": "armlink completion fish > ~/.config/fish/completions/armlink.fish",
}


def candidates(points: dict[str, EntryPoint], words: list[str]) -> list[str]:
    """Candidates for the last of `words`; none where a file is expected."""
    *before, unfinished = words or [""]
    if not before:
        return _starting(unfinished, [*points, "completion", "--help", "--version"])
    if before == ["completion"]:
        return _starting(unfinished, SCRIPTS)
    point = points.get(before[0])
    if point is None:
        return []
    command = _command(point)
    for word in before[1:]:
        command = getattr(command, "commands", {}).get(word, command)
    if getattr(command, "commands", None):
        return _starting(unfinished, [*command.commands, "--help"])
    if unfinished.startswith("-"):
        return _starting(unfinished, sorted({name for each in command.params for name in _names(each)} | {"--help"}))
    if "arm" in {each.name for each in command.params} and before[-1] in (before[0], "--arm"):
        from armlink.arm_file import bundled_arms

        return _starting(unfinished, bundled_arms())
    return []


def _command(point: EntryPoint) -> Any:
    import typer

    target = point.load()
    if isinstance(target, typer.Typer):
        return typer.main.get_command(target)
    app = typer.Typer(add_completion=False)
    app.command(name=point.name)(target)
    return typer.main.get_command(app)


def _names(parameter: Any) -> list[str]:
    if getattr(parameter, "param_type_name", "") != "option":
        return []
    return [*parameter.opts, *parameter.secondary_opts]


def _starting(unfinished: str, words: Iterable[str]) -> list[str]:
    return sorted(word for word in words if word.startswith(unfinished))
