import logging
import threading
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv

from scilab_rl.config.schema import RunConfig
from scilab_rl.envs.stability import guard
from scilab_rl.envs.threads import ThreadsVecEnv
from scilab_rl.envs.vectorize import make_train_env, observed_layer
from scilab_rl.errors import ConfigError
from tests.unit.envs.test_shares import Numbered, limited
from tests.unit.envs.test_stability import Exploding

TASKS = (
    "FetchPush-v4", "Blocks-o1-gripper_none-v1", "Hook-o1-v1", "ButtonUnlock-o1-v1",
    "Reach1DOF-v0", "PointObjGym-sparse-o4-0.5-small_open_dgr-c1-rt0-s500-v0",
)  # fmt: skip


class Threaded(Numbered):
    """Remembers in which threads it was used."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.threads = {threading.get_ident()}

    def reset(self, *, seed=None, options=None):
        self.threads.add(threading.get_ident())
        return super().reset(seed=seed, options=options)

    def step(self, action):
        self.threads.add(threading.get_ident())
        if action[0] > 100:
            raise ValueError(f"{self.number} is too weak")
        return super().step(action)

    def render(self):
        self.threads.add(threading.get_ident())
        return super().render()

    def close(self):
        self.threads.add(threading.get_ident())


def threaded(n_envs: int, n_threads: int) -> ThreadsVecEnv:
    return ThreadsVecEnv([partial(Threaded, i) for i in range(n_envs)], n_threads)


def test_each_environment_stays_in_one_thread_and_the_first_in_that_of_the_caller():
    env = threaded(5, 3)
    env.reset()
    for t in range(5):
        env.step(np.full((5, 1), 3.0 * t))  # from the fourth on, each ends its episode
    env.render()
    used = env.get_attr("threads")
    env.close()
    assert all(len(threads) == 1 for threads in used)
    assert used[0] == used[1] == {threading.get_ident()}
    assert used[2] == used[3] != used[0]
    assert len(set().union(*used)) == 3


@pytest.mark.parametrize("broken", [[0], [4], [1, 3, 4]])
def test_an_error_is_raised_as_it_is_and_all_threads_end(broken):
    before = threading.active_count()
    env = threaded(5, 3)
    env.reset()
    actions = np.zeros((5, 1))
    actions[broken] = 101.0
    with pytest.raises(ValueError, match=f"^{broken[0]} is too weak$"):
        env.step(actions)
    env.close()
    env.close()
    assert threading.active_count() == before


def test_closing_in_the_middle_of_a_step():
    before = threading.active_count()
    env = ThreadsVecEnv([partial(limited, i) for i in range(3)], 2)
    env.reset()
    env.step_async(np.zeros((3, 1)))
    env.close()
    assert threading.active_count() == before


@pytest.fixture
def two_cores(monkeypatch):
    monkeypatch.setattr("scilab_rl.envs.vectorize.n_cores", lambda: 2)


@pytest.mark.parametrize("task", TASKS)
def test_tasks_do_the_same_as_in_one_process(task, two_cores):
    inside, threads = (
        make_train_env(RunConfig(task, n_envs=3, seed=1, vector=vector))
        for vector in ("inprocess", "threads")
    )
    assert isinstance(observed_layer(threads).venv, ThreadsVecEnv)
    random = np.random.default_rng(0)
    np.testing.assert_equal(inside.reset(), threads.reset())
    for _ in range(55):  # beyond the end of Fetch's episodes
        actions = random.uniform(-1, 1, (3, *inside.action_space.shape)).astype(np.float32)
        np.testing.assert_equal(threads.step(actions), inside.step(actions))
    threads.close(), inside.close()


def test_episodes_continue_in_other_threads_and_elsewhere(two_cores):
    make = partial(RunConfig, "FetchPush-v4", n_envs=3, seed=1)
    env = make_train_env(make(vector="threads"))
    env.reset()
    for i in range(4):
        seen = env.step(np.full((3, 4), np.sin(i), np.float32))[0]
    states = env.env_method("episode_state")
    after = env.step(np.full((3, 4), 0.3, np.float32))[0]
    for vector in ("threads", "inprocess"):
        other = make_train_env(make(vector=vector))
        other.reset()
        for i in (2, 0, 1):
            (there,) = other.env_method("replay_episode", states[i], indices=i)
            assert there["observation"].tolist() == seen["observation"][i].tolist()
        np.testing.assert_equal(other.step(np.full((3, 4), 0.3, np.float32))[0], after)
        other.close()
    env.close()


def test_f11_unstable_simulations_say_the_same(tmp_path, monkeypatch, caplog):
    monkeypatch.chdir(tmp_path)
    makers = [lambda: guard(Exploding())] * 4
    seen, messages = [], []
    for env in (DummyVecEnv(makers), ThreadsVecEnv(makers, 2)):
        caplog.clear()
        env.seed(0)
        with caplog.at_level(logging.DEBUG, "scilab_rl.envs.stability"):
            env.reset()
            seen.append([env.step(np.zeros((4, 4))) for _ in range(4)])
        messages.append(sorted(record.message for record in caplog.records))
        assert env.get_attr("n_unstable") == [1] * 4
        env.close()
    np.testing.assert_equal(seen[0], seen[1])
    assert messages[0] == messages[1]
    assert sum("became unstable and MuJoCo reset it" in text for text in messages[0]) == 4
    assert any("Nan, Inf or huge value" in text for text in messages[0])  # MuJoCo's own
    assert list(tmp_path.iterdir()) == []  # no MUJOCO_LOG.TXT


def test_other_simulators_are_refused():
    gym.register("Numbered-v0", entry_point=lambda **_: Numbered(0))
    with pytest.raises(ConfigError, match=r"simulated by MuJoCo.*Use vector=workers"):
        make_train_env(RunConfig("Numbered-v0", n_envs=2, vector="threads", seed=1))
