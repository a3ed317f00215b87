"""Every wrapper: play equals the evaluation, a resumed run equals the other, or it is refused."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium import wrappers as gw
from stable_baselines3.common import vec_env as sb3

from scilab_rl.config.schema import ALIASES, RunConfig
from scilab_rl.envs.clipping import ClipAction
from scilab_rl.envs.vectorize import make_eval_env, make_train_env
from scilab_rl.errors import ConfigError
from scilab_rl.seeding import derive_seed
from scilab_rl.tracking.base import TrackerGroup
from scilab_rl.training import checkpoint, resume
from scilab_rl.training.evaluation import evaluate
from scilab_rl.training.loop import Trainer
from scilab_rl.training.policy import load_policy, policy_state
from scilab_rl.training.snapshot import capture


class Walk(gym.Env):
    """A point in three dimensions that noise moves; each step costs more the farther it is."""

    def __init__(self) -> None:
        self.observation_space = spaces.Box(-50, 50, (3,), np.float32)
        self.action_space = spaces.Box(-1, 1, (3,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.np_random.uniform(-1, 1, 3)
        return self.x.astype(np.float32), {}

    def step(self, action):
        self.x = self.x + action + self.np_random.normal(0, 0.1, 3)
        done = bool(np.abs(self.x).max() > 6)
        return self.x.astype(np.float32), -float(np.abs(self.x).sum()), done, False, {}


class RunningMean(gym.ObservationWrapper):
    """A user's own: remembers over episodes, in kinds of attributes that people use."""

    def __init__(self, env):
        super().__init__(env)
        self.mean, self.n, self.rng = np.zeros(3), 0, np.random.default_rng(0)
        self.visits, self.newest = {}, []
        self.part = SimpleNamespace(scale=np.float32(1))

    def observation(self, observation):
        self.n += 1
        self.mean = self.mean + (observation - self.mean) / self.n
        place = int(observation[0])
        self.visits[place] = self.visits.get(place, 0) + 1
        self.newest = [*self.newest[-3:], observation]
        self.part.scale *= np.float32(0.99)
        noise = self.rng.normal(0, 0.01, 3) * self.part.scale / self.visits[place]
        return (observation - self.mean + noise).astype(np.float32)


class InDict(gym.ObservationWrapper):
    """Puts the observation into a dictionary."""

    def __init__(self, env):
        super().__init__(env)
        self.observation_space = spaces.Dict({"x": env.observation_space})

    def observation(self, observation):
        return {"x": observation}


class Picture(gym.ObservationWrapper):
    """Makes the observation a picture whose rows differ."""

    def __init__(self, env):
        super().__init__(env)
        self.observation_space = spaces.Box(0, 255, (36, 40, 3), np.uint8)

    def observation(self, observation):
        rows = np.arange(36)[:, None, None] * (10 + observation)
        return np.broadcast_to(rows % 255, (36, 40, 3)).astype(np.uint8)


class Summing(sb3.VecEnvWrapper):
    """A user's own vector wrapper: the observation is a sum that fades, the reward doubled."""

    def __init__(self, venv):
        super().__init__(venv)
        self.total = np.zeros((venv.num_envs, 3), np.float32)

    def reset(self):
        self.total = self.venv.reset().copy()
        return self.total.copy()

    def step_wait(self):
        observations, rewards, dones, infos = self.venv.step_wait()
        self.total = np.where(dones[:, None], observations, 0.5 * self.total + observations)
        return self.total.copy(), 2 * rewards, dones, infos


gym.register("Walk-v0", f"{__name__}:Walk", max_episode_steps=9, disable_env_checker=True)

_BY_NAME = {"scilab_rl.envs.clipping.ClipAction": ClipAction}


def _of_alias(alias: str) -> list:
    made = []
    algorithm = {"_target_": "module.Class"}
    for entry in RunConfig.from_values({alias: 1, "algorithm": algorithm}).wrappers:
        entry = dict(entry)
        target = entry.pop("_target_")
        name = target.rpartition(".")[2]
        cls = _BY_NAME.get(target) or getattr(gw, name, None) or getattr(sb3, name)
        made.append(partial(cls, **entry))
    return made


KINDS = {alias: _of_alias(alias) for alias in ALIASES} | {
    "frame_stack": [partial(gw.FrameStackObservation, stack_size=3)],
    "delay": [partial(gw.DelayObservation, delay=2)],
    "sticky": [partial(gw.StickyAction, repeat_action_probability=0.4)],
    "repeat": [partial(gw.RepeatAction, num_repeats=2)],
    "max_and_skip": [partial(gw.MaxAndSkipObservation, skip=2)],
    "statistics": [gw.RecordEpisodeStatistics],
    "clip_reward": [partial(gw.ClipReward, min_reward=-1, max_reward=0)],
    "own_running_mean": [RunningMean],
    "own_vector": [Summing],
    "vec_frame_stack": [partial(sb3.VecFrameStack, n_stack=3)],
    "vec_monitor": [sb3.VecMonitor],
    "vec_check_nan": [sb3.VecCheckNan],
    "transform_reward": [partial(gw.TransformReward, func=lambda reward: reward / 9)],
    "transform_observation": [
        partial(gw.TransformObservation, func=lambda x: x / 2, observation_space=None)
    ],
    "extract": [InDict, partial(sb3.VecExtractDictObs, key="x")],
    "transpose_image": [Picture, sb3.VecTransposeImage],
    "normalized_stack": [partial(sb3.VecFrameStack, n_stack=2), sb3.VecNormalize],
}


class Model:
    """Acts by what it sees, so that any difference in an observation shows."""

    def __init__(self, env) -> None:
        self.env, self.num_timesteps, self._last_obs = env, 0, None
        self.observation_space = env.observation_space

    def get_env(self):
        return self.env

    def set_logger(self, logger):
        self.logger = logger

    def predict(self, observation, **_):
        rows = np.asarray(observation, float).reshape(len(observation), -1)
        return np.tanh(np.stack([rows.mean(1), rows[:, -1], rows[:, 0]], 1)).astype("f4"), None

    def act(self, n_steps: int) -> list:
        if self._last_obs is None:
            self._last_obs = self.env.reset()
        seen = []
        for _ in range(n_steps):
            self._last_obs, rewards, dones, _ = self.env.step(self.predict(self._last_obs)[0])
            seen.append((self._last_obs.tobytes(), rewards.tobytes(), dones.tobytes()))
        return seen


def _settings(wrappers, n_envs=1) -> RunConfig:
    return RunConfig(f"{__name__}:Walk-v0", wrappers=wrappers, n_envs=n_envs, seed=5)


def _trainer(model, path, eval_env=None):
    cfg = RunConfig(
        eval_after_n_steps=1, n_epochs=9, n_test_rollouts=3, early_stop_data_column="eval/x",
        early_stop_threshold=1.0, early_stop_last_n=1, save_model_freq=0, seed=5,
    )  # fmt: skip
    return Trainer(cfg, model, eval_env, TrackerGroup([]), path)


def _rewards(evaluation) -> list:
    return [episode.rewards for episode in evaluation.episodes]


@pytest.mark.parametrize("kind", KINDS)
def test_play_equals_evaluation_in_the_tasks_reward(kind, tmp_path):
    model = Model(make_train_env(_settings(KINDS[kind])))
    eval_env = make_eval_env(_settings(KINDS[kind]))
    trainer = _trainer(model, tmp_path, eval_env)
    model.act(31)
    trainer.evaluate()
    model.act(20)
    metrics = trainer.evaluate()
    checkpoint.save(capture(policy_state(model), with_buffers=False), tmp_path / "p", step=1)
    player = Model(make_eval_env(_settings(KINDS[kind])))
    load_policy(player, tmp_path / "p")
    played = evaluate(player, player.env, 3, derive_seed(5, "eval", 0))
    assert played.metrics()["eval/mean_reward"] == metrics["eval/mean_reward"]
    assert played.metrics()["eval/mean_reward"] < -9  # not clipped, doubled or normalised


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("kind", KINDS)
def test_a_resumed_run_goes_on_to_the_bit(kind, n_envs, tmp_path):
    model = Model(make_train_env(_settings(KINDS[kind], n_envs)))
    model.act(31)
    snapshot = _trainer(model, tmp_path).state.capture().copy()
    checkpoint.save(snapshot, tmp_path / "c", step=31)
    expected = model.act(40)
    other = Model(make_train_env(_settings(KINDS[kind], n_envs)))
    resume.continue_from(checkpoint.load(tmp_path / "c"), _trainer(other, tmp_path).state)
    assert other.act(40) == expected


@pytest.mark.parametrize(
    ("wrapper", "way"),
    [
        (gw.NormalizeObservation, r"\+normalize_obs=1"),
        (partial(gw.NormalizeReward, gamma=0.9), r"\+normalize_reward=1"),
        (gw.Autoreset, "ends of episodes"),
        (gw.RecordVideo, "render=record"),
        (sb3.VecVideoRecorder, "render=record"),
        (gw.vector.NormalizeObservation, "gymnasium.wrappers"),
    ],
)
@pytest.mark.parametrize("make", [make_train_env, make_eval_env])
def test_what_would_be_wrong_is_refused_with_the_way_that_works(wrapper, way, make):
    with pytest.raises(ConfigError, match=way):
        make(_settings([wrapper]))


@pytest.mark.parametrize("above", [Summing, partial(sb3.VecFrameStack, n_stack=2)])
def test_what_changes_normalized_observations_is_refused(above):
    make_train_env(_settings([above, sb3.VecNormalize, sb3.VecMonitor])).close()
    with pytest.raises(ConfigError, match="List VecNormalize last"):
        make_train_env(_settings([sb3.VecNormalize, above]))


def test_what_a_users_vector_wrapper_learns_is_said_not_to_be_shared(caplog):
    make_train_env(_settings([sb3.VecMonitor])).close()
    assert not caplog.messages
    make_train_env(_settings([Summing])).close()
    assert "The state of Summing is in checkpoints" in caplog.text
