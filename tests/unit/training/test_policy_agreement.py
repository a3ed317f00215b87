"""The numbers of one policy agree, whichever command asks: eval/, measure, play, export, probe."""

from __future__ import annotations

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from scilab_rl.config import recorded as recorded_module
from scilab_rl.config.compose import compose
from scilab_rl.config.recorded import load_recorded
from scilab_rl.config.schema import ALIASES
from scilab_rl.errors import ConfigError
from scilab_rl.learning.inspector import AgentInspector
from scilab_rl.metrics.probes import resolve_metrics
from scilab_rl.run import player as player_module
from scilab_rl.run.directory import CONFIG_FILE, RunDirectory
from scilab_rl.run.player import load_player, measure_run
from scilab_rl.run.run import start_run
from scilab_rl.seeding import derive_seed
from scilab_rl.training.evaluation import evaluate
from scilab_rl.training.trajectory_table import by_episode, collect

N_EPOCHS, N_EPISODES = 2, 3


class Centered(gym.ObservationWrapper):
    """Takes away the mean of all observations so far: it learns over episodes."""

    def __init__(self, env):
        super().__init__(env)
        self.observation_space = gym.spaces.Box(-9, 9, env.observation_space.shape, np.float32)
        self.total, self.n = np.zeros(env.observation_space.shape), 0

    def observation(self, observation):
        self.total, self.n = self.total + observation, self.n + 1
        return (observation - self.total / self.n).astype(np.float32)


_STACK = "{_target_: stable_baselines3.common.vec_env.VecFrameStack, n_stack: 3}"
KINDS = {
    "none": [],
    **{alias: [f"+{alias}=1"] for alias in ALIASES},
    "own": [f"+wrappers=[{{_target_: {__name__}.Centered}}]"],
    "delay": ["+wrappers=[{_target_: gymnasium.wrappers.DelayObservation, delay: 2}]"],
    "stack": [f"+wrappers=[{_STACK}]"],
    "normalized_stack": [f"+wrappers=[{_STACK}]", "+normalize_obs=1"],
}
HIDDEN = ("stack", "normalized_stack")


@pytest.fixture(params=KINDS)
def finished(request, tmp_path, monkeypatch):
    """A run, the reward and seed of its last evaluation, and a player of its policy."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "conf").mkdir()  # Hydra warns where a project folder has none
    cfg = compose(
        ["env=scilab_rl.testing:TinyBox-v0", "algorithm=cleansac", f"n_epochs={N_EPOCHS}",
         "seed=3", "mlflow=0",
         "eval_after_n_steps=60", f"n_test_rollouts={N_EPISODES}", "tuned=false",
         "algorithm.net_arch=[8]", "algorithm.batch_size=8", "algorithm.learning_starts=20",
         "++tracking.console.enabled=false", *KINDS[request.param]]
    )  # fmt: skip
    # `Centered` is of here
    monkeypatch.setattr(recorded_module, "refuse_untrusted_code", lambda *_: None)
    result = start_run(cfg)
    run = RunDirectory(Path(result.run_dir))
    recorded = load_recorded(run / CONFIG_FILE)
    env, model = load_player(recorded, run / "rl_model_finished", record=False)
    reward = result.metrics["eval/mean_reward"]
    yield request.param, run, reward, derive_seed(3, "eval", N_EPOCHS - 1), env, model
    env.close()


def test_all_commands_agree_with_the_evaluation(finished, monkeypatch) -> None:
    kind, run, reward, seed, env, model = finished
    monkeypatch.setattr(
        player_module,
        "derive_seed",
        lambda s, *w: seed if w == ("measure",) else derive_seed(s, *w),
    )
    assert measure_run(run, N_EPISODES)["eval/mean_reward"] == reward
    reload = lambda: load_player(  # noqa: E731 - what a wrapper learns in one use is not for others
        load_recorded(run / CONFIG_FILE), run / "rl_model_finished", record=False
    )
    player_env, player = reload()
    assert evaluate(player, player_env, N_EPISODES, seed).metrics()["eval/mean_reward"] == reward
    rows = collect(model, env, N_EPISODES, seed)
    returns = [episode["return"] for episode in by_episode(rows)]
    assert np.mean(returns) == pytest.approx(reward, abs=1e-9)
    player_env.close()
    if kind in HIDDEN:
        assert "q_value" not in rows[0] and "entropy" not in rows[0]
        with pytest.raises(ConfigError, match=r"VecFrameStack.*FrameStackObservation"):
            resolve_metrics(
                ["q_value"], AgentInspector(model), (), key="--metrics", algorithm_name="cleansac"
            )
        return
    seen_env, algorithm = reload()
    seen_env.seed(seed)
    seen = seen_env.reset()
    for row in rows:
        action = algorithm.predict(seen, deterministic=True)[0]
        answer = algorithm.q_values(seen, action).detach().numpy()
        assert row["q_value"] == pytest.approx(answer.mean(), abs=1e-5)
        seen = seen_env.step(action)[0]
    seen_env.close()
