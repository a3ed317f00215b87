"""The pages of the reference, written from the code while MkDocs builds the site.

They are never stored, so that they cannot be out of date. MkDocs calls `on_files`.
"""

from __future__ import annotations

import ast
import contextlib
import difflib
import importlib
import inspect
import io
import itertools
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import yaml

from scilab_rl import algorithms
from scilab_rl.acceptance.agents import CARD_FILE, card_page, read_card
from scilab_rl.cli.main import COMMANDS, run_command_line
from scilab_rl.cli.tables import as_typed
from scilab_rl.config.schema import ALIASES, CONDITIONS, KEYS, Key
from scilab_rl.config.workspace import SHIPPED_AGENTS, SHIPPED_CONF, config_files
from scilab_rl.envs import catalog
from scilab_rl.learning.declared import declared_metrics
from scilab_rl.metrics import probes
from scilab_rl.metrics.names import FRAMEWORK_METRICS, INTRINSIC_METRICS

# What people subclass, call or read, by page section.
API = {
    "From Python": (
        "scilab_rl.train",
        "scilab_rl.Run",
        "scilab_rl.runs",
        "scilab_rl.load",
        "scilab_rl.Agent",
        "scilab_rl.EvaluationSummary",
        "scilab_rl.compare",
        "scilab_rl.ComparisonSummary",
        "scilab_rl.goals",
        "scilab_rl.GoalSummary",
    ),
    "Algorithms": (
        "scilab_rl.learning.base.OneFileAlgorithm",
        "scilab_rl.learning.off_policy.OffPolicyAlgorithm",
        "scilab_rl.envs.vec_step.VecStep",
        "scilab_rl.learning.replay.HindsightReplayBuffer",
        "scilab_rl.algorithms.intrinsic.base.IntrinsicReward",
        "scilab_rl.testing.algorithms.AlgorithmContract",
    ),
    "Environments": (
        "scilab_rl.envs.goal.GoalEnv",
        "scilab_rl.envs.mujoco_goal.MujocoGoalEnv",
        "scilab_rl.testing.goal_environments.EnvironmentContract",
    ),
    "Metrics and trackers": (
        "scilab_rl.metrics.logger.MetricLogger",
        "scilab_rl.tracking.base.Tracker",
        "scilab_rl.tracking.base.TrackedRun",
    ),
    "Runs": (
        "scilab_rl.config.schema.RunConfig",
        "scilab_rl.run.run.start_run",
        "scilab_rl.results.RunResult",
    ),
}
# Files of the repository, and where the site shows what they say.
_ELSEWHERE = (
    (
        re.compile(r"\]\(\.\./src/scilab_rl/agents/(\w+)/README\.md\)"),
        lambda match: f"](reference/agents.md#{match[1].lower()})",
    ),
    (re.compile(r"\]\(\.\./baselines/[^)]+\)"), "](environments.md#all-performance-tests)"),
)
_DIFF = re.compile(r"<!-- diff of algorithms: (\w+), (\w+): ([\w, ]+) -->")
_SECTIONS = ("Args", "Attributes", "Returns", "Raises", "Shapes")
ALGORITHMS = Path(algorithms.__file__).parent
_ITEM = re.compile(r"(\*{0,2}[\w, ]+?): (.*)")


def on_files(files: Any, config: Any) -> Any:
    """Add the generated pages; called by MkDocs."""
    from mkdocs.structure.files import File

    for name, write_page in PAGES.items():
        text = "\n".join(write_page()) + "\n"
        files.append(File.generated(config, f"reference/{name}.md", content=text))
    return files


def on_page_markdown(markdown: str, **_: object) -> str:
    """Fill in diffs, and let links to outside of the site lead into it; called by MkDocs."""
    for file, place in _ELSEWHERE:
        markdown = file.sub(place, markdown)
    return _DIFF.sub(
        lambda match: "\n".join(diff_page(match[1], match[2], match[3].split(", "))), markdown
    )


def diff_page(old: str, new: str, functions: Sequence[str]) -> Iterator[str]:
    """Yield some functions of an algorithm's file as they differ from those of another's.

    Args:
        old: Name of an algorithm, one of ours.
        new: Name of the one that it is compared with.
        functions: In the order in which they are shown; one that a file lacks counts as nothing.
    """
    lines = list(diff_of(_functions_of(old), _functions_of(new), functions))
    kept, gone, added = (sum(line[:1] == sign for line in lines) for sign in " -+")
    yield f"{kept} lines of `{old}` stay, {gone} go (-) and {added} come (+):\n"
    yield from fenced("diff", "\n".join(lines))


def diff_of(
    old: Mapping[str, list[str]], new: Mapping[str, list[str]], functions: Sequence[str]
) -> Iterator[str]:
    """Yield lines that begin with a space (in both), a minus (only in the old) or a plus.

    >>> list(diff_of({"f": ["def f():", "    a"]}, {"f": ["def f():", "    b"]}, ["f"]))
    [' def f():', '-    a', '+    b', '']
    """
    for name in functions:
        before, after = old.get(name, []), new.get(name, [])
        matcher = difflib.SequenceMatcher(None, before, after, autojunk=False)
        for kind, i1, i2, j1, j2 in matcher.get_opcodes():
            if kind == "equal":
                yield from (f" {line}" for line in before[i1:i2])
            else:
                yield from (f"-{line}" for line in before[i1:i2])
                yield from (f"+{line}" for line in after[j1:j2])
        yield ""


def _functions_of(algorithm: str) -> dict[str, list[str]]:
    """Return the lines of each function of an algorithm's file, without docstrings."""
    text = (ALGORITHMS / f"{algorithm}.py").read_text(encoding="utf-8")
    lines, found = text.splitlines(), {}
    for node in ast.parse(text).body:
        if isinstance(node, ast.FunctionDef):
            said = node.body[0] if ast.get_docstring(node) else None
            left_out = range(said.lineno, (said.end_lineno or 0) + 1) if said else ()
            numbers = range(node.lineno, (node.end_lineno or 0) + 1)
            found[node.name] = [lines[n - 1] for n in numbers if n not in left_out]
    return found


def keys_page() -> Iterator[str]:
    """Yield the page of all configuration keys, from the schema that checks them."""
    yield "# Configuration keys\n"
    yield (
        "Every key of `main.yaml`, its default and its meaning. Change one on the command line "
        "(`n_epochs=3`) or in a [file of your own](../howto/configuration.md). "
        "`scilab-rl explain KEY` tells where a value came from.\n"
    )
    for heading, keys in itertools.groupby(KEYS, key=lambda key: key.heading):
        rows = [
            (
                f"`{key.name}`",
                f"{_literal(key.meaning)}: `{as_typed(key.default)}` ({_allowed(key)})",
            )
            for key in keys
        ]
        yield f"## {heading}\n"
        yield from table(("key", "meaning: default (what is allowed)"), rows)
    yield "## Wrappers\n"
    yield "With a plus, because they are not in `main.yaml`:\n"
    yield from (f"* `+{alias}=1`" for alias in ALIASES)
    yield "\n## What a run of a performance test has to reach\n"
    yield f"`{CONDITIONS}`, see [the how-to](../howto/testing.md).\n"


def commands_page() -> Iterator[str]:
    """Yield the help of the command line and of each sub-command."""
    yield "# Commands\n"
    yield "`python src/main.py` and `scilab-rl` are the same program.\n"
    yield from fenced(
        "console", f"$ scilab-rl --help\n{help_of()}\n$ scilab-rl --help all\n{help_of('all')}"
    )
    for command, meaning in COMMANDS.items():
        yield f"## {command}\n"
        yield f"{meaning[0].upper()}{meaning[1:]}.\n"
        yield from fenced("console", help_of(command))
    yield "## Exit codes\n"
    codes = inspect.getdoc(run_command_line) or ""
    yield from (f"* {part.strip()}" for part in re.findall(r"\d+: [^.]+", codes))
    yield ""


def algorithms_page() -> Iterator[str]:
    """Yield each algorithm's parameters, which are its YAML, and what its file says."""
    yield "# Algorithms\n"
    yield (
        "`algorithm=NAME` chooses one, `algorithm.PARAMETER=VALUE` changes it. "
        "The boxes are the YAML files, complete with all defaults.\n"
    )
    for name, path in config_files("algorithm").items():
        text = path.read_text(encoding="utf-8")
        yield f"## {name}\n"
        first, _, rest = text.partition("\n")
        yield f"{first.lstrip('# ')}\n"
        yield from fenced("yaml", rest.strip())
        target = yaml.safe_load(text)["_target_"]
        module = _try_import(target.rpartition(".")[0])
        if module is not None and not target.startswith(("stable_baselines3", "sb3_contrib")):
            yield '??? note "What its file says"\n'
            yield from indented(fenced("text", inspect.getdoc(module) or ""))
            yield ""


def environments_page() -> Iterator[str]:
    """Yield the environments that the building machine has, by package, and the other packages."""
    yield "# Environments\n"
    yield (
        "The newest version of each; `env=NAME` without version means it. "
        "[Pictures](../gallery.md). `scilab-rl envs NAME` shows one in detail.\n"
    )
    yield "## Packages\n"
    suites = catalog.list_suites()
    columns = ("suite", "contents", "install", "conflicts", "note")
    yield from table(columns, [[str(s[c] or "") for c in columns] for s in suites])
    rows = catalog.list_all()
    for suite in suites:
        own = [row for row in rows if row["suite"] == suite["suite"]]
        if own:
            yield f"## {suite['suite']}\n"
            lines = table(
                ("environment", "steps", "goals", "action", "observation"),
                [
                    (f"`{r['env']}`", r["steps"], "yes" if r.get("goal") else "", r.get("action"),
                     r.get("observation"))
                    for r in own
                ],
            )  # fmt: skip
            if len(own) > 40:
                yield f'??? note "{len(own)} environments"\n'
                lines = indented(lines)
            yield from lines


def metrics_page() -> Iterator[str]:
    """Yield the probes and what each algorithm records."""
    yield "# Metrics and probes\n"
    yield "How to read them: [what each metric means](../explain/metrics.md).\n"
    yield "## Probes\n"
    yield (
        "For any algorithm that can answer, computed for the very step that is shown. Use them in "
        "`render_metrics_train`, `render_metrics_test`, `play --metrics` and `probe --metrics`.\n"
    )
    rows = []
    for name in probes.PROBE_NAMES:
        function, needs = probes._PROBES[name]
        meaning = " ".join((inspect.getdoc(function) or "").split())
        rows.append((f"`{name}`", meaning, ", ".join(sorted(needs)) or "nothing"))
    yield from table(("probe", "meaning", "needs of the algorithm"), rows)
    yield "## What each algorithm records\n"
    rows = []
    for name, path in config_files("algorithm").items():
        module_name, _, cls_name = yaml.safe_load(path.read_text(encoding="utf-8"))[
            "_target_"
        ].rpartition(".")
        if (module := _try_import(module_name)) is None:
            continue
        metrics = declared_metrics(getattr(module, cls_name))
        said = (
            f"`{m.name}`" + (f" (only when {m.condition})" if m.condition else "") for m in metrics
        )
        rows.append((f"`{name}`", ", ".join(said) or "nothing"))
    yield from table(("algorithm", "metrics"), rows)
    yield "Every run has, besides: " + ", ".join(f"`{n}`" for n in FRAMEWORK_METRICS) + ".\n"
    yield (
        "With an intrinsic reward: `train/intrinsic_reward`, `train/intrinsic_loss` (where it "
        "learns models), " + ", ".join(f"`{n}`" for n in INTRINSIC_METRICS) + ".\n"
    )


def search_page() -> Iterator[str]:
    """Yield the settings of studies, the launchers, and the shipped search spaces."""
    yield "# Search and launchers\n"
    yield "How to use them: [search hyperparameters](../howto/search.md).\n"
    yield "## Settings of a study, `hydra.sweeper.NAME=VALUE`\n"
    folder = SHIPPED_CONF / "hydra"
    yield from fenced("yaml", (folder / "sweeper" / "study.yaml").read_text(encoding="utf-8"))
    yield "## Launchers, `hydra/launcher=NAME`\n"
    for path in sorted((folder / "launcher").glob("*.yaml")):
        yield f"### {path.stem}\n"
        yield from fenced("yaml", path.read_text(encoding="utf-8"))
    yield "## Shipped search spaces, `+search=NAME`\n"
    for name, path in config_files("search").items():
        yield f"### {name}\n"
        yield from fenced("yaml", path.read_text(encoding="utf-8"))


def agents_page() -> Iterator[str]:
    """Yield the cards of the shipped agents."""
    yield "# Trained agents\n"
    yield (
        "They are in the package. Play, record, probe or compare them as `agent:NAME`, or start a "
        "run from one with `restore_policy=agent:NAME`: [how](../howto/resume.md#trained-agents).\n"
    )
    for file in sorted(SHIPPED_AGENTS.glob(f"*/{CARD_FILE}")):
        yield from (re.sub(r"^#", "##", line) for line in card_page(read_card(file.parent)))
        yield ""


def api_page() -> Iterator[str]:
    """Yield the classes and functions that are meant to be used from code."""
    yield "# Classes and functions\n"
    for section, targets in API.items():
        yield f"## {section}\n"
        for target in targets:
            module, _, name = target.rpartition(".")
            yield from documented(getattr(importlib.import_module(module), name), target)


def documented(thing: Any, target: str) -> Iterator[str]:
    """Yield the signature and docstring of a class or function, and of a class's methods."""
    yield f"### {thing.__name__}\n"
    yield from fenced("python", f"from {target.rpartition('.')[0]} import {thing.__name__}")
    yield from markdown_of(inspect.getdoc(thing) or "")
    if not inspect.isclass(thing):
        return
    for name, member in vars(thing).items():
        if name.startswith("_") or not member.__doc__:
            continue
        if not inspect.isfunction(member) and not isinstance(member, property):
            continue
        signature = _short_signature(member) if inspect.isfunction(member) else ""
        yield f"#### `{name}{signature}`\n"
        yield from markdown_of(inspect.getdoc(member) or "")


def markdown_of(docstring: str) -> Iterator[str]:
    r"""Yield a Google docstring as Markdown: sections become lists, examples become code.

    >>> list(markdown_of("Say it.\n\nArgs:\n    word: What\n        to say."))
    ['Say it.', '', '**Args**', '', '* `word`: What to say.', '']
    """
    for block in re.split(r"\n{2,}", docstring):
        heading, _, body = block.partition("\n")
        if heading.rstrip(":") in _SECTIONS:
            yield from (f"**{heading.rstrip(':')}**", "")
            for item in re.sub(r"\n {5,}", " ", body).splitlines():
                parts = _ITEM.fullmatch(item.strip())
                yield f"* `{parts[1]}`: {parts[2]}" if parts else f"* {item.strip()}"
            yield ""
        elif ">>>" in block or block.startswith((" ", "..")):
            yield from fenced("text", block)
        else:
            yield from (block.replace("\n", " "), "")


def table(heading: Iterable[str], rows: Iterable[Iterable[Any]]) -> Iterator[str]:
    """Yield a Markdown table."""
    heading = list(heading)
    yield f"| {' | '.join(heading)} |"
    yield f"|{'---|' * len(heading)}"
    for row in rows:
        cells = ("" if cell is None else str(cell).replace("|", "\\|") for cell in row)
        yield f"| {' | '.join(cells)} |"
    yield ""


def fenced(language: str, text: str) -> Iterator[str]:
    """Yield a block of code."""
    yield from (f"```{language}", text.rstrip("\n"), "```", "")


def indented(lines: Iterable[str]) -> Iterator[str]:
    """Yield the lines as the inside of a folded note."""
    for line in "\n".join(lines).splitlines():
        yield f"    {line}" if line else ""


def help_of(command: str | None = None) -> str:
    """Return what ``--help`` prints, as narrow as the page."""
    printed = io.StringIO()
    width = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "80"
    try:
        with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
            words = ["--help", "all"] if command == "all" else [command or "", "--help"]
            run_command_line([word for word in words if word])
    finally:
        os.environ.pop("COLUMNS") if width is None else os.environ.update(COLUMNS=width)
    return printed.getvalue()


def _literal(text: str) -> str:
    """Return the text with words such as ``_target_`` as code, which Markdown would slant."""
    return re.sub(r"\b_\w+_\b", r"`\g<0>`", text)


def _allowed(key: Key) -> str:
    words = [*key.allowed, *["null"] * key.optional]
    return f"{', '.join(words)}{f', from {key.low:g}' if key.low > float('-inf') else ''}"


def _short_signature(function: Callable[..., Any]) -> str:
    names = [name for name in inspect.signature(function).parameters if name != "self"]
    return f"({', '.join(names)})"


def _try_import(name: str) -> ModuleType | None:
    try:
        return importlib.import_module(name)
    except ImportError:  # an optional package that the building machine lacks
        return None


PAGES: dict[str, Callable[[], Iterator[str]]] = {
    "keys": keys_page,
    "commands": commands_page,
    "algorithms": algorithms_page,
    "environments": environments_page,
    "agents": agents_page,
    "metrics": metrics_page,
    "search": search_page,
    "api": api_page,
}
