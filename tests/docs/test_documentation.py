"""Every page of the documentation, read as a user would: typed, written to files, run.

`docs/contributing/documentation.md` explains the comments that a page can give. What takes time is
shortened by arguments at the end of each command that trains.
"""

from __future__ import annotations

import csv
import json
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import gymnasium
import pytest
import yaml

from scilab_rl.cli.main import COMMANDS, run_command_line

from ..e2e.commands import quiet_environment
from .pages import DOCS, ROOT, Block, blocks_of, insert_after, pages
from .test_story import LOOK

SHORT = {
    "n_epochs": "1",
    "eval_after_n_steps": "60",
    "n_test_rollouts": "1",
    "mlflow": "0",
    "require_updates": "false",
}
# Whatever else an algorithm has that could take long.
SMALL_ALGORITHM = {
    "algorithm.buffer_size": "1000",
    "algorithm.batch_size": "16",
    "algorithm.learning_starts": "30",
    "algorithm.net_arch": "[16,16]",
}
STUDY = {"hydra.sweeper.max_trials": "4", "hydra.sweeper.n_jobs": "2"}
# The project folder's own modules: those of one page must not be found by the next.
PROJECT_MODULES = ("custom_algorithms", "custom_envs", "custom_probes")
EXECUTED = ("bash", "python", "yaml")
STORY = DOCS / "story.md"  # has a test of its own


def executable_pages() -> list[Path]:
    """Return the pages that have something to execute."""
    return [
        page
        for page in pages()
        if page != STORY and any(b.language in EXECUTED for b in blocks_of(page))
    ]


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with a fresh copy of the repository's project."""
    listed = subprocess.run(
        ["git", "-c", "safe.directory=*", "ls-files", "conf", "src/custom_*", "src/main.py"],
        cwd=ROOT, capture_output=True, text=True, check=True,
    )  # fmt: skip
    for name in listed.stdout.split():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path / "src"), *sys.path])
    forget_desk()
    yield tmp_path
    forget_desk()


def forget_desk() -> None:
    """Let the next import of the project folder read its files."""
    for name in list(sys.modules):
        if name.partition(".")[0] in PROJECT_MODULES:
            del sys.modules[name]
    for env_id, spec in list(gymnasium.registry.items()):
        if str(spec.entry_point).startswith(PROJECT_MODULES):
            del gymnasium.registry[env_id]


@pytest.mark.parametrize(
    "page", executable_pages(), ids=lambda p: p.relative_to(DOCS).with_suffix("").as_posix()
)
def test_page(page: Path, project: Path) -> None:
    for block in blocks_of(page):
        if block.language in EXECUTED and block.task is None:
            execute(block, f"{page.relative_to(ROOT)}:{block.line}")


def test_six_tasks(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Those of a newcomer, one after the other, by the blocks that the pages mark as theirs."""
    seconds = {}
    for task, check in TASKS.items():
        began = time.monotonic()
        for page, block in [(p, b) for p in pages() for b in blocks_of(p) if b.task == task]:
            execute(block, f"{page.relative_to(ROOT)}:{block.line}")
        seconds[task] = round(time.monotonic() - began, 1)
        check(capsys.readouterr().out)
    sys.stderr.write(f"6 tasks, {sum(seconds.values()):.0f} s: {json.dumps(seconds, indent=1)}\n")


def test_every_task_has_its_check() -> None:
    assert {block.task for page in pages() for block in blocks_of(page)} == {None, *TASKS}


def check_train_and_watch(printed: str) -> None:
    (run,) = Path("data").glob("*/*FetchReach*")
    played = run / "episodes" / "play_001.html"
    assert "goal_distance" in played.read_text() and played.with_suffix(".mp4").is_file()
    assert re.search(r"success: .*95 % interval", printed)


def check_own_curiosity(printed: str) -> None:
    run = Path("data/last")
    assert "my_curiosity" in (run / "config.yaml").read_text()
    assert "intrinsic_reward" in next((run / "episodes").glob("*.html")).read_text()
    with (run / "trials_step.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 100 and all(float(row["intrinsic_reward"]) > 0 for row in rows)


def check_compare_on_3_seeds(printed: str) -> None:
    (page,) = Path("data/comparisons").glob("*/comparison.json")
    compared = json.loads(page.read_text())
    assert [group["seeds"] for group in compared["groups"]] == [[[1, 2, 3]]] * 2
    assert "3 runs each" in printed


def check_own_environment(printed: str) -> None:
    assert re.search(r"rewards of a batch.*equal on \d+ steps", printed)
    (run,) = Path("data").glob("*/*MyReach-v0*")
    assert json.loads((run / "result.json").read_text())["status"] == "finished"


def check_data_in_pandas(printed: str) -> None:
    assert re.search(r"episode\n0 .*\d\n1 .*\d\nName: value", printed)


def check_policy_in_a_script(printed: str) -> None:
    assert printed.strip() in ("True", "1.0")


TASKS: dict[str, Callable[[str], None]] = {
    "train and watch": check_train_and_watch,
    "own curiosity": check_own_curiosity,
    "compare on 3 seeds": check_compare_on_3_seeds,
    "own environment": check_own_environment,
    "per-step data in pandas": check_data_in_pandas,
    "policy in an own script": check_policy_in_a_script,
}


def test_commands_of_the_readme(project: Path) -> None:
    """What installs, opens a window or continues an interrupted run is tested elsewhere."""
    elsewhere = ("make", "source", "scilab-rl view", "scilab-rl resume")
    readme = ROOT / "README.md"
    typed = [
        (block, command)
        for block in blocks_of(readme)
        if block.language == "bash"
        for command in block.commands
        if not command.startswith(elsewhere)
    ]
    assert len(typed) > 4
    for block, command in typed:
        type_command(command, {}, f"README.md:{block.line}")


@pytest.mark.parametrize("page", pages(), ids=lambda p: p.relative_to(DOCS).as_posix())
def test_reasons_are_given_and_targets_of_make_exist(page: Path) -> None:
    targets = set(re.findall(r"(?m)^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8")))
    for block in blocks_of(page):
        reason = block.said("skip")
        assert reason is None or len(reason) > 5, f"line {block.line}: why is it skipped?"
        if block.language == "bash":
            for command in block.commands:
                if command.startswith("make "):
                    words = [w for w in command.split()[1:] if "=" not in w]
                    assert set(words) <= targets, command


def test_pages_name_only_commands_and_keys_that_exist() -> None:
    """Also in running text: `scilab-rl COMMAND` in backticks."""
    for page in pages():
        text = page.read_text(encoding="utf-8")
        for command in re.findall(r"`scilab-rl ([a-z]+)", text):
            assert command in COMMANDS, f"{page.name}: scilab-rl {command}"


def test_columns_of_a_run_are_explained(project: Path) -> None:
    words = "algorithm=cleansac env=scilab_rl.testing:TinyReach-v0"
    type_command(f"python src/main.py {words}", {}, "here")
    columns = (Path("data/last/metrics.csv").read_text().splitlines()[0]).split(",")
    explained = (DOCS / "explain" / "metrics.md").read_text(encoding="utf-8")
    names = [c for c in columns if c.startswith(("eval/", "rollout/", "train/"))]
    assert len(names) > 5
    assert [name for name in names if f"`{name}`" not in explained] == []


def execute(block: Block, place: str) -> None:
    """Do with a block what a reader would do with it."""
    if block.said("skip") is not None:
        return
    if block.title is not None:
        write(block)
    elif block.language == "yaml":
        assert yaml.safe_load(block.text) is not None, place
    elif block.language == "python":
        exec(compile(block.text, place, "exec"), {"__name__": "__main__"})
    else:
        more = {}
        for comment in block.comments:
            more |= dict(word.split("=", 1) for word in comment.split() if "=" in word)
        for command in block.commands:
            type_command(command, more, place, fails=block.said("fails") is not None)


def write(block: Block) -> None:
    """Write the file that a block names, or change it."""
    path = Path(str(block.title))
    assert not path.is_absolute()
    path.parent.mkdir(parents=True, exist_ok=True)
    after = block.said("after")
    if after is not None:
        path.write_text(insert_after(path.read_text(), after, block.text))
    elif block.said("append") is not None:
        path.write_text(f"{path.read_text()}\n{block.text}")
    else:
        path.write_text(block.text)
    forget_desk()


def type_command(command: str, more: dict[str, str], place: str, *, fails: bool = False) -> None:
    """Run a command line; ours in this process, which spares seconds each."""
    words = shlex.split(command)
    if words[:2] == ["scilab-rl", "view"] and "--list" not in words:
        view = [sys.executable, "-c", LOOK, sys.executable, "-m", "scilab_rl.cli.main", *words[1:]]
        code = subprocess.run(view, env=quiet_environment(DISPLAY=""), check=False).returncode
    elif words[:2] == ["python", "src/main.py"] or words[0] == "scilab-rl":
        arguments = shortened(words[2 if words[0] == "python" else 1 :], more)
        forget_desk()  # a reader starts a new process
        code = run_command_line(arguments)
    elif words[:3] == ["python", "-m", "pytest"] or words[0] == "git" or is_script(words):
        words = [sys.executable, *words[1:]] if words[0] == "python" else words
        done = subprocess.run(words, env=quiet_environment(), capture_output=True, check=False)
        code = done.returncode if words[0] != "git" else int(done.returncode > 1)
    else:
        pytest.fail(f"{place}: '{command}' cannot be tested; say why with a comment")
    assert (code != 0) == fails, f"{place}: exit code {code} of {' '.join(words)}"


def is_script(words: list[str]) -> bool:
    """Return whether a command runs a file that the page has made."""
    return words[0] == "python" and Path(words[1]).is_file()


def shortened(arguments: list[str], more: dict[str, str]) -> list[str]:
    """Return the arguments of a command with those that make a training short."""
    flags = {"--help", "--version", "--cfg"}
    first = arguments[0] if arguments else ""
    if flags & set(arguments) or (first in COMMANDS and first not in ("profile", "experiment")):
        return arguments
    values = SHORT | more
    algorithm = dict(a.split("=", 1) for a in arguments if "=" in a).get("algorithm", "cleansac")
    small = parameters_of(algorithm.split(",")[0])
    if any(a.startswith(("+performance", "+search")) for a in arguments):
        small = {"buffer_size", "batch_size", "learning_starts"}  # of any off-policy algorithm
    values |= {k: v for k, v in SMALL_ALGORITHM.items() if k.partition(".")[2] in small}
    values |= more
    if "--multirun" in arguments:
        values = (STUDY if is_study(arguments) else {}) | values
        arguments = [a for a in arguments if not a.startswith("hydra.sweeper.max_trials=")]
    kept = [a for a in arguments if a.lstrip("+").partition("=")[0] not in values]
    return [*kept, *(f"{key}={value}" for key, value in values.items())]


def parameters_of(algorithm: str) -> set[str]:
    """Return the parameters that the YAML of an algorithm has."""
    shipped = ROOT / "src" / "scilab_rl" / "conf" / "algorithm" / f"{algorithm}.yaml"
    own = Path("conf") / "algorithm" / f"{algorithm}.yaml"
    path = shipped if shipped.is_file() else own
    return set(yaml.safe_load(path.read_text(encoding="utf-8"))) if path.is_file() else set()


def is_study(arguments: list[str]) -> bool:
    """Return whether a multirun searches."""
    searching = ("choice(", "interval(", "+search", "+performance")
    return any(word in argument for argument in arguments for word in searching)
