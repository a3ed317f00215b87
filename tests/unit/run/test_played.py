"""Episodes that people have played demonstrate."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scilab_rl.config.schema import RunConfig
from scilab_rl.errors import ConfigError
from scilab_rl.run.played import play_again, read_played

from .test_demonstrations import build, n_rows
from .test_human import LEFT, RIGHT, play, rows, sessions

N_STEPS = 50  # of an episode of Reach1DOF


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, RunConfig]:
    """Two people play at once: p1 an episode to the goal and one away, p2 a part of one."""
    folder = tmp_path_factory.mktemp("human")
    people = sessions(folder, env="Reach1DOF", n_blocks=2)
    for step in range(N_STEPS):
        people.join("p1")
        now = people._sessions["p1"].observation
        play(people, "p1", [RIGHT if now["achieved_goal"] < now["desired_goal"] else LEFT])
        if step == 20:
            play(people, "p2", [LEFT] * 20)
    play(people, "p1", [RIGHT] * N_STEPS)
    people.close()
    return str(folder), people.cfg


def test_steps_are_those_that_were_played(played: tuple[str, RunConfig]) -> None:
    table = [r for r in rows(Path(played[0]) / "trials.csv") if r["participant_id"] == "p1"]
    episodes = list(play_again(*played))
    assert [len(episode) for episode in episodes] == [N_STEPS, N_STEPS]
    assert [episode[-1].info["is_success"] for episode in episodes] == [True, False]
    steps = [step for episode in episodes for step in episode]
    for step, row in zip(steps, table, strict=True):
        assert (step.reward, step.action) == (float(row["reward"]), float(row["action_0"]))
        goal = float(row["desired_goal_0"])
        np.testing.assert_allclose(step.observation["desired_goal"], goal, rtol=1e-5)


def test_successes_are_demonstrations(played: tuple[str, RunConfig]) -> None:
    model = build("Reach1DOF-v0", "cleansac", f"human:{played[0]}/trials.csv")
    assert n_rows(model.replay_buffer.demos) == N_STEPS + 1


def test_a_table_of_another_task_is_refused(played: tuple[str, RunConfig], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="was played in Reach1DOF-v0, which is not FetchReach-v4"):
        build("FetchReach-v4", "cleansac", f"human:{played[0]}")
    with pytest.raises(ConfigError, match="is no table of `scilab-rl human`"):
        read_played(str(tmp_path), played[1])


def test_an_environment_that_has_changed_is_noticed(
    played: tuple[str, RunConfig], tmp_path: Path
) -> None:
    folder, cfg = played
    for name in ("trials.csv", "settings.json"):
        text = (Path(folder) / name).read_text(encoding="utf-8")
        (tmp_path / name).write_text(text.replace(",-1.0,", ",-2.0,"), encoding="utf-8")
    with pytest.raises(ConfigError, match="does not do again what was played"):
        list(play_again(str(tmp_path), cfg))
