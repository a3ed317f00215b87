from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scilab_rl.cli.main import run_command_line
from scilab_rl.config.schema import RunConfig
from scilab_rl.envs.scenes import start_as_text
from scilab_rl.envs.vectorize import make_single_env
from scilab_rl.recording.records import Clip, ClipInfo, Record, save_clip

OUTPUTS = Path("data/agents/CartPole")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Return a folder in which 30 steps of CartPole were recorded and asked about."""
    folder = tmp_path_factory.mktemp("project")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        (OUTPUTS / "episodes").mkdir(parents=True)
        save_clip(_clip(30), OUTPUTS / "episodes" / "play_001.npz")
        words = ["--at", "3", "--action", "0", "--steps", "25", "--futures", "2"]
        assert run_command_line(["whatif", "agent:CartPole", *words]) == 0
    return folder


def _clip(n_steps):
    env = make_single_env(RunConfig("CartPole-v1", {}))
    observation, _ = env.reset(seed=5)
    records = []
    for step in range(n_steps + 1):
        last = step == n_steps
        action = None if last else np.array(step % 2)
        record = Record("eval", 0, 0, step, step, b"", observation, action)
        if not last:
            observation, record.reward, *_ = env.step(action)
        records.append(record)
    records[0].start = start_as_text(env.episode_start())
    return Clip(ClipInfo("play_001", "eval", 0, "CartPole-v1", "cleanppo", 50.0, ()), records)


def test_another_action_ends_the_episode(recorded):
    folder = recorded / OUTPUTS / "whatif"
    rows = (folder / "play_001_at_3_action_0_25.csv").read_text().splitlines()
    assert rows[0] == "scene,success,steps,return,final_distance"
    # Pushed to one side only, a pole falls within 8 to 10 steps from rest (Barto et al., 1983).
    assert all(int(row.split(",")[2]) < 15 for row in rows[1:])
    page = (folder / "play_001_at_3_action_0_25.html").read_text()
    assert "CartPole-v1: what if it did 0 for 25 steps?" in page
    assert (folder / "play_001_at_3_action_0_25.png").is_file()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--decided"], "does not report success"),
        (["--at", "100000"], "scene 100000 has no future"),
        (["--action", "7"], "An action must be one of Discrete(2)"),
        (["--action", "left"], "must be numbers separated by commas"),
        (["--goal", "1"], "has no goals"),
        (["--at", "-1"], "a scene has a number from 0"),
        (["--episode", "play_002"], "There is no episode 'play_002'. Did you mean 'play_001'?"),
    ],
)
def test_questions_that_do_not_fit_are_refused(recorded, monkeypatch, capsys, words, said):
    monkeypatch.chdir(recorded)
    assert run_command_line(["whatif", "agent:CartPole", "--futures", "2", *words]) == 2
    assert said in capsys.readouterr().err
