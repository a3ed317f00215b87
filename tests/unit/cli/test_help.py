import os
import re
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from scilab_rl.cli.help import print_help, print_short_help
from scilab_rl.cli.main import COMMANDS
from scilab_rl.config.schema import ALIASES, KEYS

MAIN = Path(__file__).parents[3] / "src" / "main.py"
HEAVY = {
    "torch",
    "gymnasium",
    "mujoco",
    "stable_baselines3",
    "mlflow",
    "wandb",
    "gymnasium_robotics",
}


@pytest.fixture
def text(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    print_help(COMMANDS)
    return capsys.readouterr().out


def test_all_commands_keys_and_wrappers_are_explained(text):
    for command, meaning in COMMANDS.items():
        assert re.search(rf"^  {command} +{re.escape(meaning)}$", text, re.MULTILINE)
    for key in KEYS:
        assert re.search(rf"^  {key.name}=", text, re.MULTILINE), key.name
    for alias in ALIASES:
        assert f"  +{alias}=1\n" in text


@pytest.mark.parametrize(
    "line",
    [
        r"algorithm=\w+ +one of \w+, .*",
        r"n_epochs=60 +most epochs \(whole number from 1\)",
        r"tuned=true +.*",
        r"info='' +a note .*",
        r"render_freq=5 +.* \(whole number from 1\)",
        r"restore_policy=null +.* \(text \| null\)",
        r"mlflow=auto +.* \(0 \| 1 \| auto\)",
    ],
)
def test_defaults_and_kinds(text, line):
    assert re.search(rf"^  {line}$", text, re.MULTILINE)


def test_keys_stand_below_the_headings_of_main_yaml(text):
    order = [
        "\nWhat learns where\n",
        "  env=",
        "\nHow long,",
        "  n_epochs=",
        "\nThe machine\n",
        "  device=",
    ]
    positions = [text.index(part) for part in order]
    assert positions == sorted(positions)


@pytest.mark.parametrize("flag", ["--debug", "--version", "--cfg job", "--multirun"])
def test_flags_are_explained(text, flag):
    assert f"  {flag}" in text


def test_the_short_help_names_all_commands_on_one_screen(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    print_short_help(COMMANDS)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 30 and max(map(len, lines)) <= 80
    named = {word.strip(",") for line in lines for word in line.split()}
    assert set(COMMANDS) <= named
    assert "--help all" in lines[-1]


@pytest.mark.parametrize("columns", [20, 80])
def test_lines_fit_the_terminal(capsys, monkeypatch, columns):
    monkeypatch.setenv("COLUMNS", str(columns))
    print_help(COMMANDS)
    for line in capsys.readouterr().out.splitlines():
        # what cannot be broken, such as a key with its default, may be longer
        assert len(line) <= columns or " " not in line.strip() or line.startswith("  scilab-rl")


def test_help_is_quick_and_imports_nothing_heavy(tmp_path):
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, "-X", "importtime", str(MAIN), "--help", "all"],
        cwd=tmp_path,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    imported = {
        line.rpartition("|")[2].strip().partition(".")[0] for line in done.stderr.splitlines()
    }
    assert "yaml" in imported  # the list of imports has been read
    assert not HEAVY & imported
    assert "n_epochs=60" in done.stdout
    # processor time, which does not depend on what else runs here
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 1.0
