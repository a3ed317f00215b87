import numpy as np
import pytest
from gymnasium.wrappers import FlattenObservation, TransformReward
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from scilab_rl.config.schema import RunConfig
from scilab_rl.envs.vectorize import (
    make_eval_env,
    make_single_env,
    make_train_env,
    observed_layer,
)
from scilab_rl.errors import ConfigError, EnvironmentFailure

REACH = "scilab_rl.testing:TinyReach-v0"
BOX = "scilab_rl.testing:TinyBox-v0"


def course(env, n=40):
    seen = [dict(env.reset())]
    for i in range(n):
        actions = np.full((env.num_envs, 2), np.sin(i), np.float32)
        observations, rewards, dones, _ = env.step(actions)
        seen.append((dict(observations), rewards.tolist(), dones))
    env.close()
    return repr(seen)


def test_a_seed_fixes_the_whole_course_and_environments_differ():
    one, two, other = (
        course(make_train_env(RunConfig(REACH, n_envs=2, seed=s))) for s in (1, 1, 2)
    )
    assert one == two != other
    goals = make_train_env(RunConfig(REACH, n_envs=3, seed=1)).reset()["desired_goal"]
    assert len({tuple(goal) for goal in goals.tolist()}) == 3


def test_evaluation_has_its_own_stream_and_one_environment():
    settings = RunConfig(REACH, n_envs=3, seed=1, vector="subprocess")
    evaluation = make_eval_env(settings)
    assert evaluation.num_envs == 1
    training = make_train_env(RunConfig(REACH, seed=1))
    assert evaluation.reset()["desired_goal"].tolist() != training.reset()["desired_goal"].tolist()


@pytest.mark.parametrize(("vector", "n_processes"), [("subprocess", 3), ("workers", 2)])
def test_processes_do_the_same_as_one_process(vector, n_processes, monkeypatch):
    """Also shows that workers can import environments that are named by their module."""
    monkeypatch.setattr("scilab_rl.envs.vectorize.n_cores", lambda: 2)
    inside = make_train_env(RunConfig(REACH, n_envs=3, seed=1))
    outside = make_train_env(RunConfig(REACH, n_envs=3, seed=1, vector=vector))
    assert isinstance(observed_layer(inside).venv, DummyVecEnv)
    assert len(observed_layer(outside).venv.processes) == n_processes
    assert course(inside, 20) == course(outside, 20)


def test_episodes_continue_in_other_workers(monkeypatch):
    monkeypatch.setattr("scilab_rl.envs.vectorize.n_cores", lambda: 2)
    settings = RunConfig(REACH, n_envs=3, seed=1, vector="workers")
    env = make_train_env(settings)
    env.reset()
    for i in range(4):
        seen = env.step(np.full((3, 2), np.sin(i), np.float32))[0]
    states = env.env_method("episode_state")
    other = make_train_env(settings)
    for i in (2, 0, 1):
        (there,) = other.env_method("replay_episode", states[i], indices=i)
        assert there["observation"].tolist() == seen["observation"][i].tolist()
    act = np.full((3, 2), 0.3, np.float32)
    for _ in range(12):  # beyond the end of the episode, so that the goals are drawn alike
        one, two = env.step(act)[0], observed_layer(other).venv.step(act)[0]
        assert repr(dict(one)) == repr(dict(two))
    env.close(), other.close()


def test_no_more_workers_than_environments(monkeypatch):
    monkeypatch.setattr("scilab_rl.envs.vectorize.n_cores", lambda: 8)
    env = make_train_env(RunConfig(REACH, n_envs=2, vector="workers", seed=1))
    assert len(observed_layer(env).venv.processes) == 2
    env.close()
    alone = make_train_env(RunConfig(REACH, n_envs=1, vector="workers", seed=1))
    assert isinstance(observed_layer(alone).venv, DummyVecEnv)


def test_wrappers_apply_in_order_to_environments_and_to_the_vector():
    wrappers = [
        FlattenObservation,
        lambda env: TransformReward(env, lambda reward: 10 * reward),
        lambda env: TransformReward(env, lambda reward: reward + 1),
        VecNormalize,
    ]
    env = make_train_env(RunConfig(REACH, wrappers=wrappers, seed=1))
    assert env.observation_space.shape == (6,)
    assert isinstance(env, VecNormalize)
    seen = []
    observed_layer(env).observers.append(
        type("Seen", (), {"on_step": lambda _, b: seen.append(b)})()
    )
    env.reset()
    for _ in range(15):
        env.step(np.zeros((1, 2), np.float32))
    # 10 * -1 + 1 or 10 * 0 + 1, and not normalised where observers look
    assert {float(batch.rewards[0]) for batch in seen} <= {-9.0, 1.0}


def test_evaluation_measures_true_rewards_and_does_not_adapt():
    env = make_eval_env(RunConfig(BOX, wrappers=[VecNormalize], seed=1))
    assert (env.training, env.norm_reward, env.norm_obs) == (False, False, True)
    env = make_train_env(RunConfig(BOX, wrappers=[VecNormalize], seed=1))
    assert (env.training, env.norm_reward) == (True, True)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"reward_typ": "dense"}, r"takes no env_kwargs.reward_typ. Did you mean 'reward_type'"),
        ({"zzz": 1}, r"takes no env_kwargs.zzz. It takes: .*reward_type"),
    ],
)
def test_an_unknown_keyword_is_named_with_those_that_exist(kwargs, message):
    with pytest.raises(ConfigError, match=message):
        make_single_env(RunConfig("FetchReach-v4", env_kwargs=kwargs))


def test_keywords_reach_the_environment():
    env = make_single_env(RunConfig("Pendulum-v1", env_kwargs={"g": 3.0}))
    assert env.unwrapped.g == 3.0


def test_an_environment_that_cannot_be_made_is_one_line(monkeypatch):
    def explode(self):
        raise OSError("no simulator here")

    monkeypatch.setattr("scilab_rl.testing.environments.TinyBox.__init__", explode)
    with pytest.raises(EnvironmentFailure, match="cannot be made: OSError: no simulator here"):
        make_train_env(RunConfig(BOX, seed=1))


def test_environments_are_only_drawn_when_somebody_looks():
    assert make_single_env(RunConfig("Pendulum-v1")).render_mode is None
    env = make_single_env(RunConfig("Pendulum-v1"), "rgb_array")
    assert env.render_mode == "rgb_array"


@pytest.mark.parametrize("vector", ["inprocess", "subprocess"])
def test_records_hold_what_the_environment_got_and_gave(vector):
    """The algorithm counts from 0; who observes the steps sees the environment's own values."""
    odd = "tests.faults.archetypes:OddPartsChoice-v0"
    env = make_train_env(RunConfig(odd, n_envs=2, seed=1, vector=vector))
    batches = []
    observed_layer(env).observers.append(Memory(batches))
    given = env.reset()
    for _ in range(10):
        given, _, _, infos = env.step(np.array([0, 2]))
    last = batches[-1]
    assert last.actions.tolist() == [-1, 1]
    assert (last.reset_observations["hour"] - given["hour"]).tolist() == [2, 2]
    assert last.reset_observations["dice"].shape == (2, 1, 2)
    assert (last.reset_observations["dice"].reshape(2, 2) - given["dice"]).tolist() == [[1, 1]] * 2
    for own, info in zip(last.infos, infos, strict=True):
        assert own["terminal_observation"]["hour"] - info["terminal_observation"]["hour"] == 2
        assert info["terminal_observation"]["light"].shape == (1,)
    env.close()


class Memory:
    def __init__(self, batches):
        self.batches = batches

    def on_step(self, batch):
        self.batches.append(batch)


@pytest.mark.parametrize("vector", ["inprocess", "workers"])
def test_what_no_algorithm_reads_is_refused_also_in_workers(vector):
    text = "tests.faults.archetypes:TextChoice-v0"
    with pytest.raises(ConfigError, match="TextChoice-v0: the observation is a Text space"):
        make_train_env(RunConfig(text, n_envs=2, vector=vector, seed=1))
