"""What people choose is stored once, and leads to the same place after a crash."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from scilab_rl.analysis.fitting.panel import read_panel
from scilab_rl.config.compose import compose
from scilab_rl.envs.registration import resolve_env_id
from scilab_rl.errors import ConfigError
from scilab_rl.run.human import HumanSessions, OtherWindowError, StorageError

LEFT, RIGHT = "ArrowLeft", "ArrowRight"


def sessions(
    folder: Path, *words: str, env: str = "TwoStep", n_practice: int = 0, n_blocks: int = 1
) -> HumanSessions:
    cfg = compose(["tuned=false", f"env={resolve_env_id(env)[0]}", "seed=7", *words])
    return HumanSessions(cfg, folder, n_practice=n_practice, n_blocks=n_blocks)


def play(people: HumanSessions, code: str, keys: list[str]) -> dict:
    now = people.join(code)
    for key in keys:
        now = people.choose(code, now["window"], now["number"], key, "key", 412.34)
    return now


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_choices_are_a_table_that_fit_reads(tmp_path: Path) -> None:
    people = sessions(tmp_path, "env_kwargs.n_trials=3", n_practice=1)
    now = play(people, "p1", [LEFT, RIGHT])
    assert (now["phase"], now["number"], now["pauses"]) == ("trials", 2, True)
    assert len(now["pictures"]) == 2  # the last one of practice, and the first one that counts
    now = play(people, "p1", [LEFT, RIGHT, RIGHT])
    assert now["progress"] == pytest.approx(1 / 3)
    play(people, "p1", [RIGHT, LEFT, LEFT])
    now = play(people, "p2", [RIGHT])
    people.close()
    assert [row["key"] for row in rows(tmp_path / "practice.csv")] == [LEFT, RIGHT, RIGHT]
    table = rows(tmp_path / "trials.csv")
    assert [(r["trial"], r["stage"], r["response"]) for r in table] == [
        ("0", "0", "0"), ("0", "1", "1"), ("1", "0", "1"),
        ("1", "1", "1"), ("2", "0", "0"), ("2", "1", "0"),
    ]  # fmt: skip
    assert {(r["participant_id"], r["rt_ms"], r["env"]) for r in table} == {
        ("p1", "412.3", "TwoStep-v0")
    }
    panel = read_panel(tmp_path / "trials.csv")
    assert panel.participants == ("p1",)
    assert panel.n_stages == 2
    np.testing.assert_array_equal(panel.responses[0], [0, 1, 1, 1, 0, 0])


def test_a_session_continues_after_a_crash_and_loses_half_a_line(tmp_path: Path) -> None:
    keys = [LEFT, LEFT, RIGHT, LEFT, RIGHT, RIGHT, LEFT, RIGHT]
    people = sessions(tmp_path / "whole", "env_kwargs.n_trials=6")
    play(people, "p1", keys)
    people.close()
    people = sessions(tmp_path / "broken", "env_kwargs.n_trials=6")
    play(people, "p1", keys[:3])
    people.close()
    with (tmp_path / "broken" / "trials.csv").open("a") as file:
        file.write("broken,TwoStep")
    people = sessions(tmp_path / "broken", "env_kwargs.n_trials=6")
    assert people.join("p1")["number"] == 3
    play(people, "p1", keys[3:])
    people.close()
    whole, broken = (rows(tmp_path / name / "trials.csv") for name in ("whole", "broken"))
    for row in (*whole, *broken):
        del row["run"], row["n_shown"]
    assert whole == broken


def test_a_choice_is_made_once_and_in_one_window(tmp_path: Path) -> None:
    people = sessions(tmp_path, "env_kwargs.n_trials=6")
    old = people.join("p1")
    after = people.choose("p1", old["window"], 0, LEFT, "key", 300.0)
    again = people.choose("p1", old["window"], 0, LEFT, "key", 300.0)  # its answer was lost
    assert (after["number"], again["number"]) == (1, 1)
    new = people.join("p1")
    with pytest.raises(OtherWindowError, match="another window"):
        people.choose("p1", old["window"], 1, LEFT, "key", 300.0)
    for bad in ((2, LEFT, "key", 1.0), (1, "x", "key", 1.0), (1, LEFT, "key", float("nan"))):
        with pytest.raises(ConfigError, match="no such choice"):
            people.choose("p1", new["window"], *bad)
    people.choose("p1", new["window"], 1, RIGHT, "mouse", 300.0)
    people.close()
    assert [row["n_shown"] for row in rows(tmp_path / "trials.csv")] == ["1", "3"]


def test_a_full_disk_keeps_the_choice_open(tmp_path: Path, monkeypatch) -> None:
    people = sessions(tmp_path, "env_kwargs.n_trials=6")
    now = people.join("p1")
    monkeypatch.setenv("SCILAB_FAULT", "human.before_row:1:ENOSPC")
    with pytest.raises(StorageError, match="could not be stored"):
        people.choose("p1", now["window"], 0, LEFT, "key", 300.0)
    now = people.choose("p1", now["window"], 0, LEFT, "key", 300.0)
    people.close()
    assert now["number"] == len(rows(tmp_path / "trials.csv")) == 1


def test_a_folder_has_one_task_and_one_server(tmp_path: Path) -> None:
    people = sessions(tmp_path, "env_kwargs.n_trials=6")
    for name in ("Ann Smith", "a@b.org", "", "x" * 33):
        with pytest.raises(ConfigError, match="no personal data"):
            people.join(name)
    with pytest.raises(ConfigError, match="is in use"):
        sessions(tmp_path, "env_kwargs.n_trials=6")
    people.close()
    with pytest.raises(ConfigError, match="env_kwargs"):
        sessions(tmp_path, "env_kwargs.n_trials=5")


def test_games_have_forced_choices_and_several_blocks(tmp_path: Path) -> None:
    people = sessions(tmp_path, "env_kwargs.horizon=1", env="Horizon", n_blocks=2)
    now = people.join("p1")
    while now["phase"] != "end":
        key = next(option["key"] for option in now["options"] if option["enabled"])
        now = people.choose("p1", now["window"], now["number"], key, "key", 1.0)
    people.close()
    table = rows(tmp_path / "trials.csv")
    assert [row["forced"] for row in table] == ["1", "1", "1", "1", "0"] * 2
    assert [row["episode"] for row in table] == ["0"] * 5 + ["1"] * 5
    assert now["progress"] == 1.0


def test_an_arm_moves_by_keys_and_drawing_changes_nothing(tmp_path: Path) -> None:
    people = sessions(tmp_path, env="Reach1DOF")
    play(people, "p1", [LEFT, LEFT, RIGHT])
    people.close()
    table = rows(tmp_path / "trials.csv")
    assert [row["action_0"] for row in table] == ["-1.0", "-1.0", "1.0"]
    again = sessions(tmp_path, env="Reach1DOF")
    session = again._make("p1")  # the same without pictures
    for key, row in zip([LEFT, LEFT, RIGHT], table, strict=True):
        assert str(session.choose(key, draws=False)[0]["observation_0"]) == row["observation_0"]
    again.close()


def test_keys_must_suffice(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="keys can choose"):
        sessions(tmp_path, env="FetchReach")
