"""A wheel in an empty folder: no project, no repository, and still the whole command line."""

from __future__ import annotations

import subprocess
import sys
from functools import partial
from pathlib import Path

from .commands import QUICK, ROOT, TINY, last_run, quiet_environment


def test_wheel_trains_in_an_empty_folder(tmp_path: Path) -> None:
    site, project = tmp_path / "site", tmp_path / "project"
    project.mkdir()
    copy = tmp_path / "source"
    subprocess.run(
        ["git", "-c", "safe.directory=*", "clone", "--quiet", "--local", str(ROOT), str(copy)],
        check=True,
    )
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    offline = ["--no-deps", "--no-index", "--no-build-isolation"]
    subprocess.run(
        [*pip, "install", *offline, "--target", str(site), str(copy)], check=True, cwd=tmp_path
    )
    assert not (site / "custom_algorithms").exists(), "the project folder belongs to the researcher"
    assert (site / "scilab_rl" / "conf" / "main.yaml").is_file()
    assert (site / "scilab_rl" / "templates" / "style.css").is_file()
    run = partial(
        subprocess.run,
        cwd=project,
        env=quiet_environment(PYTHONPATH=str(site)),
        capture_output=True,
        text=True,
        check=False,
    )
    program = [sys.executable, "-m", "scilab_rl.cli.main"]
    done = run([*program, "algorithm=sac", TINY, *QUICK, "n_epochs=2"])
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr
    assert (last_run(project) / "rl_model_finished" / "manifest.json").is_file()
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
