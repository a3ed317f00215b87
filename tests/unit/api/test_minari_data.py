"""Data sets for offline learning: Minari itself reads what the agent did."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import scilab_rl
from scilab_rl.api.minari_data import default_id, write_minari
from scilab_rl.cli.main import run_command_line
from scilab_rl.errors import ConfigError, ScilabRLError


@pytest.fixture(scope="module")
def reach() -> Iterator[scilab_rl.Agent]:
    with scilab_rl.load("agent:Reach1DOF") as agent:
        yield agent


@pytest.fixture(autouse=True)
def _own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "sets"))


def test_minari_reads_the_episodes_that_the_agent_plays(reach: scilab_rl.Agent) -> None:
    minari = pytest.importorskip("minari")
    folder, summary = write_minari(reach, "Reach1DOF/good-v0", 3, seed=7)
    assert folder.is_dir() and not list(folder.parent.glob(".*.unfinished"))
    loaded = minari.load_dataset("Reach1DOF/good-v0")
    assert (loaded.total_episodes, loaded.total_steps) == (3, summary.lengths.sum())
    card = loaded.storage.metadata["description"]
    assert str(summary.mean_return) in card and "Fingerprint" in card
    assert np.isclose([episode.rewards.sum() for episode in loaded], summary.returns).all()
    env = loaded.recover_environment()
    for episode in loaded:
        assert episode.truncations[-1] and not episode.truncations[:-1].any()
        assert not episode.terminations.any()
        states = episode.observations
        assert len(states["observation"]) == len(episode.actions) + 1
        for step, reward in enumerate(episode.rewards):  # the reward of where the step has led
            pair = states["achieved_goal"][step + 1], states["desired_goal"][step + 1]
            assert env.unwrapped.compute_reward(*pair, {}) == reward
            reached = bool(episode.infos["success"][step + 1])
            assert reached == (reward == 0)
    env.close()


def test_a_data_set_is_never_replaced(reach: scilab_rl.Agent) -> None:
    pytest.importorskip("minari")
    assert default_id(reach) == "Reach1DOF/cleansac-v0"
    write_minari(reach, default_id(reach), 1)
    with pytest.raises(ConfigError, match=r"already.*--minari Reach1DOF/cleansac-v1"):
        write_minari(reach, default_id(reach), 1)
    for wrong in ("Reach1DOF", "a b-v0"):
        with pytest.raises(ConfigError, match="must be the id of a data set"):
            write_minari(reach, wrong, 1)


def test_what_minari_reads_otherwise_is_not_kept(
    reach: scilab_rl.Agent, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    minari = pytest.importorskip("minari")
    read = minari.load_dataset
    monkeypatch.setattr(minari, "load_dataset", lambda name: list(read(name))[:1])
    with pytest.raises(ScilabRLError, match="reads 1 of 2 episodes"):
        write_minari(reach, "Reach1DOF/torn-v0", 2)
    assert not (tmp_path / "sets" / "Reach1DOF" / "torn-v0").exists()


def test_without_minari_it_says_how_to_install_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = importlib.util.find_spec

    def find(name: str, *more: str) -> object:
        return None if name == "minari" else found(name, *more)

    monkeypatch.setattr(importlib.util, "find_spec", find)
    monkeypatch.chdir(tmp_path)
    assert run_command_line(["export", "agent:Reach1DOF", "--minari"]) == 2
    assert 'pip install "scilab-rl[minari]"' in capsys.readouterr().err
