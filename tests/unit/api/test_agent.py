"""Trained agents in Python: what they do, say and measure, from the environment's own units."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import scilab_rl
from scilab_rl.analysis.estimates import success_interval
from scilab_rl.analysis.goals import GoalSettings
from scilab_rl.api.agent import as_batch
from scilab_rl.config.compose import compose
from scilab_rl.errors import ConfigError
from scilab_rl.run.run import start_run


@pytest.fixture(scope="module")
def reach() -> Iterator[scilab_rl.Agent]:
    with scilab_rl.load("agent:Reach1DOF") as agent:
        yield agent


@pytest.fixture(scope="module")
def normalized(tmp_path_factory: pytest.TempPathFactory) -> Iterator[scilab_rl.Agent]:
    """An agent that has learned from normalized observations."""
    folder = tmp_path_factory.mktemp("normalized")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        (folder / "conf").mkdir()
        start_run(
            compose(
                ["env=scilab_rl.testing:TinyBox-v0", "algorithm=cleansac", "+normalize_obs=1",
                 "n_epochs=1", "eval_after_n_steps=60", "n_test_rollouts=1", "seed=3", "mlflow=0",
                 "algorithm.net_arch=[32]", "algorithm.batch_size=8",
                 "algorithm.learning_starts=10",
                 "tracking.console.enabled=false"]
            )
        )  # fmt: skip
        with scilab_rl.load("last") as agent:
            yield agent


def observations(agent: scilab_rl.Agent, n: int) -> list:
    env = agent.make_env()
    env.action_space.seed(0)
    found = [env.reset(seed=5)[0]]
    while len(found) < n:
        found.append(env.step(env.action_space.sample())[0])
    env.close()
    return found


def test_it_acts_in_the_environment_that_it_makes(reach: scilab_rl.Agent) -> None:
    env = reach.make_env()
    observation, info = env.reset(seed=1)
    for _ in range(50):
        action = reach.predict(observation)
        assert env.action_space.contains(action)
        observation, _, _, _, info = env.step(action)
    assert info["is_success"]


def test_a_batch_is_answered_as_its_entries(reach: scilab_rl.Agent) -> None:
    seen = observations(reach, 4)
    batch = {key: np.stack([o[key] for o in seen]) for key in seen[0]}
    actions = reach.predict(batch)
    assert actions.shape == (4, 1)
    for index, one in enumerate(seen):
        np.testing.assert_allclose(reach.predict(one), actions[index], atol=1e-6)
        values = reach.q_values(one, actions[index])
        assert values.shape == (1,)
        np.testing.assert_allclose(reach.q_values(batch, actions)[index], values, rtol=1e-4)


def test_observations_are_normalized_as_in_training(normalized: scilab_rl.Agent) -> None:
    (seen,) = observations(normalized, 1)
    statistics = normalized.env.obs_rms
    by_hand = np.clip((seen - statistics.mean) / np.sqrt(statistics.var + 1e-8), -10, 10)
    expected, _ = normalized.algorithm.predict(by_hand[None].astype(np.float32), deterministic=True)
    np.testing.assert_allclose(normalized.predict(seen), expected[0], atol=1e-6)
    unnormalized, _ = normalized.algorithm.predict(seen[None], deterministic=True)
    assert np.abs(unnormalized - expected).max() > 1e-3


def test_discrete_actions_are_single_numbers() -> None:
    with scilab_rl.load("agent:CartPole") as agent:
        seen = np.zeros((3, 4), np.float32)
        assert agent.predict(seen).shape == (3,)
        assert agent.predict(seen[0]) in (0, 1)
        steps = agent.trajectories(1, per="episode")
        assert steps[0]["return"] == steps[0]["steps"]


def test_a_recurrent_policy_remembers_until_an_episode_begins(
    reach: scilab_rl.Agent, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Counts:
        def predict(self, seen, state, episode_start, deterministic):
            state = np.where(episode_start, 0.0, 0.0 if state is None else state) + 1
            return state[:, None], state

    agent = scilab_rl.Agent(reach.run, reach.cfg, reach.policy)
    vars(agent).update(_player=(reach.env, Counts()), inspector=reach.inspector)
    (seen,) = observations(reach, 1)
    answers = [agent.predict(seen).item() for _ in range(3)]
    answers += [agent.predict(seen, begins=begins).item() for begins in (True, False)]
    assert answers == [1, 2, 3, 1, 2]
    batch = {key: np.stack([value, value]) for key, value in seen.items()}
    assert agent.predict(batch).ravel().tolist() == [1, 1]


def test_probes_are_asked_by_name(reach: scilab_rl.Agent) -> None:
    first, second = observations(reach, 2)
    assert {"q_value", "value", "entropy", "td_error", "goal_distance"} <= set(reach.probes)
    action = reach.predict(first)
    assert reach.probe("q_value", first) == pytest.approx(reach.q_values(first, action).mean())
    assert reach.probe("goal_distance", first) == pytest.approx(
        np.linalg.norm(first["achieved_goal"] - first["desired_goal"])
    )
    by_hand = -1.0 + reach.algorithm.gamma * reach.probe("value", second)
    by_hand -= reach.probe("q_value", first, action)
    assert reach.probe("td_error", first, action, -1.0, second) == pytest.approx(by_hand)


@pytest.mark.parametrize(
    ("ask", "said"),
    [
        (lambda a, o: a.probe("q_valu", o), "Did you mean 'q_value"),
        (lambda a, o: a.probe("critic_variance", o), "cannot answer 'critic_variance'"),
        (lambda a, o: a.probe("td_error", o), "needs reward and next_observation"),
        (lambda a, o: a.predict({"observation": o["observation"]}), "no 'achieved_goal'"),
        (lambda a, o: a.predict(o["observation"]), "must be a dictionary"),
        (lambda a, o: a.predict({k: v[:0] for k, v in o.items()}), "has the shape (0,)"),
    ],
)
def test_errors_are_one_line(reach: scilab_rl.Agent, ask, said: str) -> None:
    (seen,) = observations(reach, 1)
    with pytest.raises(ConfigError) as error:
        ask(reach, seen)
    assert said in str(error.value) and "\n" not in str(error.value)


def test_entries_are_all_batches_or_none(reach: scilab_rl.Agent) -> None:
    (seen,) = observations(reach, 1)
    with pytest.raises(ConfigError, match="some are not"):
        as_batch(seen | {"observation": seen["observation"][None]}, reach.observation_space)


def test_an_evaluation_has_its_interval_and_repeats(reach: scilab_rl.Agent) -> None:
    summary = reach.evaluate(5, seed=4)
    assert summary.n_episodes == len(summary.returns) == len(summary.lengths) == 5
    assert summary.success is not None
    # Wilson's lower end for 5 of 5: 5 / (5 + 1.96^2).
    assert summary.success.value == 1 and summary.success.low == pytest.approx(0.566, abs=1e-3)
    assert summary.mean_return.value == pytest.approx(summary.returns.mean())
    assert "success 1 [0.566, 1]" in str(summary)
    np.testing.assert_array_equal(reach.evaluate(5, seed=4).returns, summary.returns)


def test_sampled_actions_repeat_too(reach: scilab_rl.Agent) -> None:
    first, second = (reach.evaluate(2, seed=4, deterministic=False).returns for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_nothing_of_the_program_changes() -> None:
    np.random.seed(7), torch.manual_seed(7)
    torch.set_num_threads(2)
    try:
        before = np.random.get_state()[1].copy(), torch.get_rng_state()
        with scilab_rl.load("agent:Reach1DOF") as agent:
            agent.evaluate(1)
        assert torch.get_num_threads() == 2
        np.testing.assert_array_equal(np.random.get_state()[1], before[0])
        assert torch.equal(torch.get_rng_state(), before[1])
    finally:
        torch.set_num_threads(1)


def test_an_episode_is_recorded(normalized: scilab_rl.Agent, tmp_path: Path) -> None:
    replay = normalized.record(["value", "reward"], seed=2)
    assert replay.path.is_file() and replay.recording.is_file()
    shown = replay._repr_html_()
    assert shown.startswith("<iframe srcdoc=") and "<script" not in shown
    assert replay.path.name == "play_001.html"


@pytest.mark.parametrize("name", ["agent:Reach1DO", "nothing"])
def test_what_is_not_there(name: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"'Reach1DO'|No run 'nothing'"):
        scilab_rl.load(name, base_logdir=tmp_path)


def test_a_misspelled_policy_is_not_replaced(reach: scilab_rl.Agent) -> None:
    with pytest.raises(ConfigError, match="There is no policy 'finisht'"):
        scilab_rl.load(reach.run.path, policy="finisht")


def test_goals_are_mapped(reach: scilab_rl.Agent, tmp_path: Path, monkeypatch) -> None:
    """What `examine` finds is tested with it; here is what becomes of it."""
    given = {}
    study = SimpleNamespace(
        space=SimpleNamespace(axes=(0,)), grid=SimpleNamespace(centers=[[-0.5], [0.5]]),
        rates=[success_interval(4, 4), success_interval(1, 4)], asked=np.array([7, 0]),
        overall=success_interval(5, 8), own=success_interval(4, 4), calibration=None,
        findings=["not reached: the right."], settings=GoalSettings(episodes=4),
    )  # fmt: skip

    def examine(run, policy, settings, **more):
        given.update(run=run, policy=policy, settings=settings, **more)
        return SimpleNamespace(page=tmp_path / "goals.html", study=study)

    (tmp_path / "goals.html").write_text("<p>Goals</p>")
    monkeypatch.setattr("scilab_rl.api.goals.examine", examine)
    found = scilab_rl.goals(reach, cells=[2], checkpoints=["finished"], record=1)
    assert given["settings"].cells == (2,) and given["n_recorded"] == 1
    assert given["checkpoints"] == [reach.policy]
    assert str(found).splitlines() == [
        "success over the goal space: 0.625 [0.306, 0.863], 4 episodes per goal",
        "with the goals that are asked for: 1 [0.51, 1]", "* not reached: the right.",
    ]  # fmt: skip
    assert "&lt;p&gt;Goals" in found._repr_html_()
    pytest.importorskip("pandas")
    assert found.cells["success"].tolist() == [1.0, 0.25]
    assert list(found.cells.columns) == ["goal_0", "success", "low", "high", "asked"]


def test_a_policy_with_a_memory_is_not_asked_for_a_single_action(
    reach: scilab_rl.Agent, monkeypatch: pytest.MonkeyPatch
) -> None:
    observation = observations(reach, 1)[0]
    monkeypatch.setattr(type(reach.inspector), "has_memory", property(lambda _: True))
    with pytest.raises(ConfigError, match="remembers its episode"):
        reach.predict(observation)
