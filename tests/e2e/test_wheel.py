"""A wheel in an empty folder: no project, no repository, and still the whole command line."""

from __future__ import annotations

import re
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from .commands import QUICK, ROOT, TINY, last_run, quiet_environment


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The folder with the installed wheel, and that with its source."""
    folder = tmp_path_factory.mktemp("wheel")
    site, copy = folder / "site", folder / "source"
    subprocess.run(
        ["git", "-c", "safe.directory=*", "clone", "--quiet", "--local", str(ROOT), str(copy)],
        check=True,
    )
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    offline = ["--no-deps", "--no-index", "--no-build-isolation"]
    subprocess.run(
        [*pip, "install", *offline, "--target", str(site), str(copy)], check=True, cwd=folder
    )
    return site, copy


def test_wheel_trains_in_an_empty_folder(wheel: tuple[Path, Path], tmp_path: Path) -> None:
    site, copy = wheel
    assert not (site / "custom_algorithms").exists(), "the project folder belongs to the researcher"
    assert (site / "scilab_rl" / "conf" / "main.yaml").is_file()
    assert (site / "scilab_rl" / "templates" / "style.css").is_file()
    run = partial(
        subprocess.run,
        cwd=tmp_path,
        env=quiet_environment(PYTHONPATH=str(site)),
        capture_output=True,
        text=True,
        check=False,
    )
    program = [sys.executable, "-m", "scilab_rl.cli.main"]
    done = run([*program, "algorithm=sac", TINY, *QUICK, "n_epochs=2"])
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr
    assert (last_run(tmp_path) / "rl_model_finished" / "manifest.json").is_file()
    agents = {p.relative_to(copy / "src") for p in (copy / "src/scilab_rl/agents").rglob("*.*")}
    assert agents and [path for path in agents if not (site / path).exists()] == []
    played = run([*program, "play", "agent:Reach1DOF", "--episodes", "2"])
    assert played.returncode == 0, played.stderr
    assert "success" in played.stdout
    code = (
        "import sys, scilab_rl\n"
        "assert not {'torch', 'numpy', 'gymnasium'} & set(sys.modules)\n"
        "import gymnasium; gymnasium.spec('Blocks-o2-gripper_above-v1')\n"
        "run = scilab_rl.Run('last')\n"
        "agent = scilab_rl.load('agent:Reach1DOF')\n"
        "observation, _ = agent.make_env().reset(seed=1)\n"
        "print(len(run.epochs), agent.predict(observation).shape, agent.evaluate(1).n_episodes)"
    )
    scripted = run([sys.executable, "-c", code])
    assert scripted.returncode == 0, scripted.stderr
    assert scripted.stdout.split("\n")[0] == "2 (1,) 1"


def test_wheel_alone_passes_the_tests_of_the_api(
    wheel: tuple[Path, Path], core_alone: Path, tmp_path: Path
) -> None:
    """Without extras, and without the plug-ins of pytest, which are none of the core."""
    found = [sys.executable, "-c", "import scilab_rl, sys; sys.stdout.write(scilab_rl.__file__)"]
    tests = [str(ROOT / "tests" / "unit" / name) for name in ("api", "test_api.py")]
    run = partial(
        subprocess.run,
        cwd=tmp_path,
        env=quiet_environment(
            PYTHONPATH=f"{core_alone}:{wheel[0]}", PYTEST_DISABLE_PLUGIN_AUTOLOAD="1"
        ),
        capture_output=True,
        text=True,
        check=False,
    )
    assert run(found).stdout.startswith(str(wheel[0]))
    done = run([sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-rA", *tests])
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr
    n_passed = len(re.findall("^PASSED", done.stdout, re.MULTILINE))
    assert n_passed > 30, done.stdout
