from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import pytest

from scilab_rl.cli import doctor, new
from scilab_rl.cli.new_environment import TEMPLATES
from scilab_rl.errors import ConfigError

from .conftest import own_modules, read_table


@pytest.mark.parametrize("template", TEMPLATES)
def test_each_template_passes_the_doctor_as_it_is(project, capsys, template) -> None:
    name = f"own_{template.lower()}"
    assert new.main(["environment", name, "--from", template]) == 0
    printed = capsys.readouterr().out
    for module in own_modules():  # the next command is another process
        del sys.modules[module]
    env_id = f"Own{template.lower().capitalize()}-v0"
    try:
        assert f"doctor env={env_id}" in printed
        assert doctor.main([f"env={env_id}", "--steps", "100"]) == 0
        rows = read_table(capsys.readouterr().out)
        assert {row["result"] for row in rows} <= {"ok", "info"}
        assert {"rewards of a batch", "resume"} <= {row["check"] for row in rows}
    finally:
        gym.registry.pop(env_id, None)


def test_a_second_environment_joins_the_first(project) -> None:
    for name in ("first_task", "second_task"):
        new.main(["environment", name])
    package = Path("src/custom_envs/__init__.py").read_text()
    compile(package, "custom_envs", "exec")
    assert package.count("import gymnasium\n") == 1
    assert 'entry_point="custom_envs.first_task:FirstTask"' in package
    assert 'entry_point="custom_envs.second_task:SecondTask"' in package


def test_the_exam_is_taken(project) -> None:
    new.main(["environment", "third_task"])
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "pytest",
            "-q",
            "-p",
            "no:cacheprovider",
            "tests/test_third_task.py",
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    assert "1 passed" in done.stdout, done.stdout + done.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["My-Task"], "is not a valid name for an environment"),
        (["class"], "is a keyword of Python"),
        (["hook", "--from", "Block"], "Did you mean 'Blocks'"),
        (["../outside"], "is not a valid name for an environment"),
    ],
)
def test_wrong_names(project, arguments, message) -> None:
    with pytest.raises(ConfigError, match=message):
        new.main(["environment", *arguments])
    assert not Path("src").exists()


def test_nothing_is_overwritten(project) -> None:
    new.main(["environment", "fourth_task"])
    before = Path("src/custom_envs/fourth_task.py").read_text()
    with pytest.raises(ConfigError, match="already exists"):
        new.main(["environment", "fourth_task", "--from", "Blocks"])
    assert Path("src/custom_envs/fourth_task.py").read_text() == before
