from __future__ import annotations

import contextlib

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from scilab_rl.analysis.whatif import (
    Change,
    FuturePlayer,
    SceneRate,
    decision,
    find_decision,
    rates_of,
)
from scilab_rl.analysis.whatif_page import Report, draw, verdict, write_page, write_tables
from scilab_rl.envs.run_env import RunEnv
from scilab_rl.envs.scenes import start_as_text
from scilab_rl.errors import ConfigError
from scilab_rl.recording.records import Clip, ClipInfo, Record

CLOSES, LENGTH = 10, 16
STAY, GO = 0, 1


class Door(gym.Env):
    """Success is to have gone through a door, which closes before step 10. Observed is the time."""

    action_space = spaces.Discrete(2)
    observation_space = spaces.Box(0.0, 100.0, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time, self.is_through = 0, False
        return self._observe(), {"is_success": False}

    def step(self, action):
        self.is_through |= action == GO and self.time < CLOSES
        self.time += 1
        info = {"is_success": bool(self.is_through)}
        return self._observe(), float(self.is_through), False, self.time == LENGTH, info

    def _observe(self):
        return np.array([self.time, self.is_through], np.float32)


class Coin:
    """A policy that goes with some probability, and values the time."""

    quantities = frozenset({"value", "log_prob"})

    def __init__(self, probability):
        self.probability = probability

    def act(self, observations, *, deterministic):
        n = len(observations)
        return np.zeros(n, int) if deterministic else np.random.binomial(1, self.probability, n)

    def values(self, observations):
        return observations[:, 0]

    @contextlib.contextmanager
    def undisturbed(self):
        state = np.random.get_state()
        yield
        np.random.set_state(state)


def _clip(actions, **changes):
    env = RunEnv(Door())
    observation, _ = env.reset(seed=1)
    records = []
    for step, action in enumerate(actions):
        now, step_observation = np.array(action), observation
        observation, reward, _, truncated, info = env.step(now)
        record = Record("eval", 0, 0, step, step, b"", step_observation, now, reward)
        record.truncated, record.success = truncated, info["is_success"]
        records.append(record)
    records.append(Record("eval", 0, 0, len(actions), len(actions), b"", observation))
    records[0].start = start_as_text(env.episode_start())
    return Clip(ClipInfo("door", "eval", 0, "Door-v0", "coin", 10.0, ()), records)


def _player(clip, probability=0.5):
    return FuturePlayer(Coin(probability), [RunEnv(Door()) for _ in range(5)], clip)


@pytest.mark.parametrize("every", [1, 4, 7])
def test_the_point_of_no_return_is_where_the_door_closes(every):
    clip = _clip([STAY] * LENGTH)
    _, found = find_decision(_player(clip), clip, Change(), n_futures=20, every=every)
    assert (found.scene, found.succeeded) == (CLOSES, False)
    last_open = next(rate for rate in found.rates if rate.scene == CLOSES - 1)
    assert 0 < last_open.n_successes < 20  # half of the futures, with 20 of them: 2 in a million


def test_success_is_certain_from_where_the_door_was_passed():
    clip = _clip([STAY] * 4 + [GO] + [STAY] * (LENGTH - 5))
    futures, found = find_decision(_player(clip, 0.0), clip, Change(), n_futures=3)
    assert (found.scene, found.succeeded) == (5, True)
    assert [r.n_successes for r in rates_of(futures)] == [0] * 5 + [3] * (LENGTH - 5)
    first, second = found.largest_change
    assert (first.scene, second.scene) == (4, 5)


def test_a_future_begins_in_its_scene_and_ends_with_the_episode():
    clip = _clip([STAY] * LENGTH)
    [future] = _player(clip).play([13], Change())
    assert future.values == [13, 14, 15, 16]
    assert future.rewards == [0, 0, 0]
    assert future.success is False


def test_the_same_seed_gives_the_same_futures_and_the_generator_stays():
    clip = _clip([STAY] * LENGTH)
    player = _player(clip)
    np.random.seed(3)
    futures = [player.play([6] * 8, Change(seed=seed)) for seed in (1, 1, 2)]
    outcomes = [[f.rewards for f in some] for some in futures]
    assert outcomes[0] == outcomes[1] != outcomes[2]
    after = np.random.random()
    np.random.seed(3)
    assert after == np.random.random()


def test_another_action_is_done_first():
    clip = _clip([STAY] * LENGTH)
    player = _player(clip, 0.0)
    [future] = player.play([9], Change(action=np.array([GO])))
    [late] = player.play([10], Change(action=np.array([GO])))
    assert future.success is True
    assert late.success is False
    with pytest.raises(ConfigError, match="An action must be one of Discrete"):
        player.play([9], Change(action=np.array([7])))


def test_noise_is_added_where_the_policy_has_none():
    clip = _clip([STAY] * LENGTH)
    player = _player(clip, 0.0)
    assert player.sigma_of(Change()) == 0.0
    player.inspector.quantities = frozenset({"value"})
    assert player.sigma_of(Change()) == 0.1
    futures = player.play([0] * 40, Change(sigma=1.0))  # a random action each time
    assert sum(future.success for future in futures) >= 39  # else 2 of 1000 stay 10 times


def test_the_last_scene_decides_where_all_was_open():
    rates = [SceneRate(scene, 3, 20) for scene in range(5)]
    assert decision(rates, 5, succeeded=False).scene == 5
    assert decision([SceneRate(0, 0, 20)], 5, succeeded=False).scene == 0


def test_the_interval_is_that_of_clopper_and_pearson():
    found = SceneRate(0, 0, 20).estimate
    assert (found.low, found.high) == (0.0, pytest.approx(1 - 0.025 ** (1 / 20)))


def test_an_episode_that_says_no_success_and_one_without_its_start_are_refused():
    clip = _clip([STAY] * LENGTH)
    player = _player(clip)
    for record in clip.records:
        record.success = None
    with pytest.raises(ConfigError, match="does not report success"):
        find_decision(player, clip, Change(), n_futures=2)
    clip.records[0].start = ""
    with pytest.raises(ConfigError, match="of one whole episode"):
        _player(clip)


def test_page_picture_and_tables(tmp_path):
    clip = _clip([STAY] * LENGTH)
    player = _player(clip)
    futures, found = find_decision(player, clip, Change(), n_futures=20)
    report = Report(
        clip, [("outcome", "failure")], "when?", player.happened(clip), {}, futures, found
    )
    path = tmp_path / "door.html"
    write_page(report, path)
    write_tables(report, path.with_suffix(".csv"))
    draw(report, path.with_suffix(".png"))
    page = path.read_text()
    assert "The point of no return is scene 10: from there on, none of 20 futures succeed" in page
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert len((tmp_path / "door.csv").read_text().splitlines()) == 1 + 20 * LENGTH
    rows = (tmp_path / "door_scenes.csv").read_text().splitlines()
    assert rows[0] == "scene,successes,futures,rate,low,high"
    assert rows[11].startswith("10,0,20,0.0,0.0,0.168")
    assert (tmp_path / "door.png").read_bytes().startswith(b"\x89PNG")
    assert verdict(report).startswith("The episode failed.")
