"""``scilab-rl completion bash|zsh``: let the Tab key complete commands, options, keys and runs."""

from __future__ import annotations

import contextlib
import importlib
import io
import re
import shlex
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from scilab_rl.cli.parser import CommandParser
from scilab_rl.cli.tables import write

_MOST_RUNS = 100  # the newest ones
# Bash takes the letters behind the last = or : for a word of their own.
_BASH = r"""
_scilab_rl() {
  local line="${COMP_LINE:0:COMP_POINT}" found
  local word="${line##* }"
  local kept="${word%"${word##*[=:]}"}"
  mapfile -t found < <(scilab-rl completion --line "$line" 2>/dev/null)
  COMPREPLY=("${found[@]#"$kept"}")
  if [[ "${COMPREPLY[0]}" == *= ]]; then compopt -o nospace; fi
}
complete -o default -F _scilab_rl scilab-rl
"""
_ZSH = r"""
_scilab_rl() {
  local -a found open closed
  found=("${(@f)$(scilab-rl completion --line "${(j: :)words[1,CURRENT]}" 2>/dev/null)}")
  open=(${(M)found:#*=})
  closed=(${found:#*=})
  compadd -Q -S '' -a open
  compadd -Q -a closed
}
(( $+functions[compdef] )) || { autoload -Uz compinit && compinit; }
compdef _scilab_rl scilab-rl
"""
_SCRIPTS = {"bash": _BASH, "zsh": _ZSH}
_TAKE_RUNS = (
    "play", "view", "probe", "whatif", "resume", "note", "tag", "delete", "plot", "compare",
    "export", "sync", "goals", "explain",
)  # fmt: skip
_TAKE_GROUPS = ("compare", "plot")
_TAKE_KEYS = ("train", "resume", "experiment", "profile", "explain", "play")


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    parser = CommandParser(
        "completion",
        'Print what lets Tab complete: put into ~/.bashrc: eval "$(scilab-rl completion bash)"',
    )
    parser.add_argument("shell", nargs="?", choices=tuple(_SCRIPTS), help="bash or zsh")
    parser.add_argument("--line", help="print the completions of this line, one a line")
    options = parser.parse_args(arguments)
    if options.line is not None:
        for candidate in candidates(options.line):
            write(candidate)
    elif options.shell is None:
        parser.error("give bash or zsh")
    else:
        write(_SCRIPTS[options.shell].strip())
    return 0


def candidates(line: str) -> list[str]:
    """Return what the last word of a command line may become; nothing where that is unknown.

    Args:
        line: The line up to the cursor, beginning with the program.
    """
    try:
        words = shlex.split(line)
    except ValueError:  # an open quote
        return []
    current = "" if line.endswith(" ") or len(words) < 2 else words.pop()
    earlier = words[1:]
    with contextlib.suppress(Exception):  # Tab must not print errors
        known = _completions(earlier, current)
        return sorted({word for word in known if word.startswith(current) and word != current})
    return []


def _completions(earlier: Sequence[str], current: str) -> Iterable[str]:
    from scilab_rl.cli.main import COMMANDS

    command = earlier[0] if earlier and earlier[0] in COMMANDS else "train"
    key, separator, _ = current.partition("=")
    if separator:
        return [f"{key}={value}" for value in _values(key.lstrip("+"))]
    if not earlier:
        return [*COMMANDS, *_keys(), "--help", "--version"]
    if current.startswith("-"):
        return _options(command) if command in COMMANDS else ["--help", "--multirun"]
    found = _keys() if command in _TAKE_KEYS else []
    if command in _TAKE_RUNS:
        found += _runs()
    if command in _TAKE_GROUPS or command == "study":
        found += _studies()
    if command == "completion":
        found += _SCRIPTS
    return found


def _options(command: str) -> list[str]:
    """Return the options of a command, from its help."""
    help_text = io.StringIO()
    with contextlib.redirect_stdout(help_text), contextlib.suppress(SystemExit):
        importlib.import_module(f"scilab_rl.cli.{command}").main(["--help"])
    return re.findall(r"(?<![\w-])--[a-z][a-z-]*", help_text.getvalue())


def _keys() -> list[str]:
    from scilab_rl.cli.main import config_keys

    return [f"{key}=" for key in config_keys()]


def _values(key: str) -> Iterable[str]:
    """Return the values of a key that are words of a list."""
    from scilab_rl.config.schema import KEYS
    from scilab_rl.config.workspace import config_files

    groups: dict[str, Callable[[], Iterable[str]]] = {
        "algorithm": lambda: config_files("algorithm"),
        "base": lambda: config_files("algorithm"),
        "variant": lambda: config_files("algorithm"),
        "performance": lambda: config_files("performance"),
        "env": _environments,
    }
    if key in groups:
        return groups[key]()
    return next((one.choices for one in KEYS if one.name == key), ())


def _environments() -> Iterable[str]:
    """Return the environments whose spaces are recorded, without importing any."""
    from scilab_rl.envs.catalog import recorded_spaces

    return [re.sub(r"-v\d+$", "", env_id) for env_id in recorded_spaces()]


def _runs() -> list[str]:
    from scilab_rl.run.directory import AGENT, LAST_LINK, all_agents, all_runs

    ids = [run.id for run in list(all_runs(Path("data")))[-_MOST_RUNS:]]
    return [LAST_LINK, *ids, *(f"{AGENT}{name}" for name in all_agents())]


def _studies() -> list[str]:
    from scilab_rl.search.folders import study_names

    return study_names(Path("data"))
