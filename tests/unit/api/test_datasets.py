"""Data sets of a task: four policies, one command, and Minari reads them all."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scilab_rl.cli.main import run_command_line

pytest.importorskip("jax")  # the agent's algorithm
minari = pytest.importorskip("minari")


@pytest.fixture(autouse=True)
def _own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "sets"))
    monkeypatch.chdir(tmp_path)


def test_one_command_writes_all_sets_of_a_task(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command_line(["dataset", "FetchReach", "--episodes", "3", "--seed", "5"]) == 0
    actions = {}
    for kind in ("expert", "medium", "scripted", "random"):
        data = minari.load_dataset(f"FetchReach/{kind}-v0")
        assert (data.total_episodes, data.total_steps) == (3, 150)
        assert data.storage.metadata["algorithm_name"] == kind
        page = (tmp_path / "sets" / "FetchReach" / f"{kind}-v0" / "README.md").read_text()
        env = data.recover_environment()
        successes = 0
        for episode in data:
            states = episode.observations
            pairs = states["achieved_goal"][1:], states["desired_goal"][1:]
            rewards = env.unwrapped.compute_reward(*pairs, {})
            np.testing.assert_array_equal(rewards, episode.rewards)
            successes += bool(episode.infos["success"][-1])
        env.close()
        assert f"success | {successes / 3:.3g}"[:12] in page
        assert "| fingerprint | `" in page and "| license | MIT |" in page and "mujoco==" in page
        actions[kind] = np.concatenate([episode.actions for episode in data])
    # The script goes straight to the goal: 5 cm per step and unit.
    first = next(iter(minari.load_dataset("FetchReach/scripted-v0")))
    way = (first.observations["desired_goal"] - first.observations["achieved_goal"])[:-1]
    np.testing.assert_allclose(first.actions[:, :3], (way / 0.05).clip(-1, 1), atol=1e-6)
    assert abs(actions["random"].mean()) < 0.2 and np.ptp(actions["random"]) > 1.9
    # The same seed: where the goals are differs, since kinds have seeds of their own.
    capsys.readouterr()
    assert run_command_line(["dataset", "FetchReach", "random", "--episodes", "3"]) == 2
    assert "already" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["FetchReach", "exprt"], "There is no data set 'exprt'; there are expert, medium"),
        (["FetchReach", "--random-share", "1"], "--random-share must be between 0 and 1"),
        (["Reach1DOF", "scripted"], "no scripted controller"),
        (["FetchReach", "expert", "--agent", "agent:Reach1DOF"], "which is not FetchReach"),
        (["FetchReach", "expert", "--agent", "agent:FetchRech"], "Did you mean 'FetchReach'"),
    ],
)
def test_what_cannot_be_is_refused(
    words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command_line(["dataset", *words, "--episodes", "1"]) == 2
    assert message in capsys.readouterr().err
    assert not list((tmp_path / "sets").rglob("*-v0"))


def test_a_share_of_mediums_actions_is_random() -> None:
    words = ["dataset", "Reach1DOF", "medium", "--random-share", "0.25", "--episodes", "20"]
    assert run_command_line(words) == 0
    assert run_command_line(["dataset", "Reach1DOF", "expert", "--episodes", "20"]) == 0
    medium, expert = (minari.load_dataset(f"Reach1DOF/{k}-v0") for k in ("medium", "expert"))
    page = medium.storage.metadata["description"]
    assert "0.25 of them replaced by uniformly random ones" in page
    assert np.mean([e.rewards.sum() for e in medium]) < np.mean([e.rewards.sum() for e in expert])
