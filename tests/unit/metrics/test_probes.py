from __future__ import annotations

import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scilab_rl.errors import ConfigError
from scilab_rl.metrics.probes import (
    PROBE_NAMES,
    Curve,
    EpisodeProbes,
    answerable,
    as_curves,
    built_in,
    resolve_metrics,
)

OBSERVATION = {"achieved_goal": np.array([0.0, 3.0]), "desired_goal": np.array([4.0, 0.0])}


class Mind:
    """Answers with numbers that can be followed by hand."""

    algorithm = "the algorithm"
    gamma = 0.5

    def __init__(self, *quantities: str) -> None:
        self.quantities = frozenset(quantities)

    def q_values(self, observation: Any, action: Any) -> np.ndarray:
        return np.array([1.0, 2.0, 6.0])

    def value(self, observation: Any) -> float:
        return 10.0

    def log_prob(self, observation: Any, action: Any) -> float:
        return -1.5

    def similarity(self, observation: Any, action: Any) -> float:
        return -2.5

    def steps_to_goal(self, observation: Any, action: Any) -> float:
        return 12.0

    def entropy(self, observation: Any) -> float:
        return 0.25

    def intrinsic_reward(self, observation: Any, action: Any, next_observation: Any) -> float:
        return 7.0

    def learned_reward(self, reward: float) -> float:
        return reward

    def after(self, observation: Any) -> Mind:
        return self


EVERYTHING = Mind(
    "q_values",
    "value",
    "log_prob",
    "entropy",
    "intrinsic_reward",
    "goals",
    "second critic",
    "similarity",
    "steps_to_goal",
)


def single(values: dict[str, float]) -> dict[Curve, float]:
    return {Curve(name): number for name, number in values.items()}


def ask(name: str, inspector: Mind = EVERYTHING, **changes: Any) -> dict[Curve, float]:
    step = {
        "observation": OBSERVATION,
        "action": np.array([0.5, -1.0]),
        "reward": -1.0,
        "next_observation": OBSERVATION,
        "info": {"is_success": True},
        "done": False,
        "terminated": False,
    } | changes
    return EpisodeProbes(inspector, [built_in(name)], pytest.fail).of_step(*step.values())


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("q_value", {("q_value", ""): 3.0}),
        ("q_values", {("q_values", "0"): 1.0, ("q_values", "1"): 2.0, ("q_values", "2"): 6.0}),
        ("critic_variance", {("critic_variance", ""): (4 + 1 + 9) / 3}),
        ("value", {("value", ""): 10.0}),
        ("td_error", {("td_error", ""): -1.0 + 0.5 * 10.0 - 3.0}),
        ("entropy", {("entropy", ""): 0.25}),
        ("log_prob", {("log_prob", ""): -1.5}),
        ("similarity", {("similarity", ""): -2.5}),
        ("steps_to_goal", {("steps_to_goal", ""): 12.0}),
        ("reward", {("reward", ""): -1.0}),
        ("train/rollout_rewards_step", {("train/rollout_rewards_step", ""): -1.0}),
        ("intrinsic_reward", {("intrinsic_reward", ""): 7.0}),
        ("goal_distance", {("goal_distance", ""): 5.0}),
        ("action", {("action", "0"): 0.5, ("action", "1"): -1.0}),
        ("success", {("success", ""): 1.0}),
    ],
)
def test_value_by_hand(name: str, expected: dict[tuple[str, str], float]) -> None:
    assert ask(name) == pytest.approx(expected)


def test_every_probe_has_a_case() -> None:
    for name in PROBE_NAMES:
        assert ask(name), name


def test_td_error_of_a_terminal_step_has_no_future_but_a_truncated_one_has() -> None:
    assert ask("td_error", done=True, terminated=True)[Curve("td_error")] == -1.0 - 3.0
    cut_off = ask("td_error", done=True)
    assert cut_off[Curve("td_error")] == -1.0 + 5.0 - 3.0


def test_td_error_without_action_values_uses_the_state_value() -> None:
    assert ask("td_error", Mind("value"))[Curve("td_error")] == -1.0 + 5.0 - 10.0


def test_return_so_far_adds_up_and_begins_anew_with_each_episode() -> None:
    probes = [built_in("return_so_far")]
    for _ in range(2):
        episode = EpisodeProbes(EVERYTHING, probes, pytest.fail)
        totals = [
            episode.of_step(OBSERVATION, None, reward)[Curve("return_so_far")]
            for reward in (1.0, 2.0, 4.0)
        ]
        assert totals == [1.0, 3.0, 7.0]


def test_discrete_action_is_one_curve() -> None:
    assert ask("action", action=np.array(3)) == single({"action": 3.0})


def test_missing_success_is_a_gap() -> None:
    assert ask("success", info={}) == {}


def test_what_is_not_finite_is_a_gap() -> None:
    assert as_curves("x", float("nan")) == as_curves("x", float("inf")) == {}
    assert as_curves("x", {"a": np.float32(2.0), "b": None}) == {Curve("x", "a"): 2.0}


def test_last_scene_answers_only_what_needs_no_action() -> None:
    probes = [built_in(name) for name in PROBE_NAMES]
    values = EpisodeProbes(EVERYTHING, probes, pytest.fail).of_scene(OBSERVATION)
    assert values == single({"value": 10.0, "entropy": 0.25, "goal_distance": 5.0})


def test_random_can_answer_only_what_the_environment_knows() -> None:
    assert answerable(Mind()) == ["reward", "return_so_far", "action", "success"]
    with pytest.raises(ConfigError) as raised:
        resolve("q_value", inspector=Mind())
    assert str(raised.value) == (
        "render_metrics_train: random cannot answer 'q_value', because it has no q_values here. "
        "It can answer: reward, return_so_far, action, success."
    )


def test_one_critic_alone_has_no_variance() -> None:
    class OneCritic(Mind):
        def q_values(self, observation: Any, action: Any) -> np.ndarray:
            return np.array([1.0])

    assert ask("critic_variance", OneCritic("q_values")) == {}  # a gap, not 0
    with pytest.raises(ConfigError, match=r"no second critic here.*Give it two critics or more"):
        resolve("critic_variance", inspector=OneCritic("q_values"))


def test_what_is_recorded_in_other_configurations_is_told() -> None:
    with pytest.raises(ConfigError, match="random records 'train/x_1' only when x is on"):
        resolve("train/x_1", absent={"train/x_*": "x is on"})


def test_unknown_name_gets_a_suggestion() -> None:
    with pytest.raises(ConfigError, match=r"no metric 'critc_variance'\. Did you mean 'critic_var"):
        resolve("critc_variance")
    with pytest.raises(ConfigError, match="Did you mean 'train/critic_loss'"):
        resolve("train/critic_los", recorded=["train/critic_loss"])


def test_recorded_names_and_patterns() -> None:
    shown = resolve(
        "train/x_3", "q_value", "my_metric", recorded=["train/x_*", "my_metric", "train/y"]
    )
    assert shown.names == ("train/x_3", "q_value", "my_metric")
    assert shown.recorded == ("train/x_3", "my_metric")
    assert [probe.name for probe in shown.probes] == ["q_value"]


def test_repeated_name_is_one_panel() -> None:
    assert resolve("reward", "reward").names == ("reward",)


@pytest.fixture
def own(monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    module: Any = types.ModuleType("my_probes")

    class Steps:
        def __init__(self) -> None:
            self.n = 0

        def __call__(self, algorithm: Any, observation: Any, action: Any) -> int:
            self.n += 1
            return self.n

    def surprise(algorithm: Any, observation: Any) -> float:
        return 2.0 if algorithm == "the algorithm" else 0.0

    def broken(algorithm: Any, observation: Any) -> float:
        raise ZeroDivisionError("no luck")

    def nothing() -> float:
        return 0.0

    for entry in (Steps, surprise, broken, nothing):
        setattr(module, entry.__name__, entry)
    monkeypatch.setitem(sys.modules, "my_probes", module)
    return module


def test_own_probes_get_the_algorithm_itself(own: types.ModuleType) -> None:
    shown = resolve("my_probes.surprise", "my_probes.Steps")
    for _ in range(2):  # the class is made anew
        episode = EpisodeProbes(EVERYTHING, shown.probes, pytest.fail)
        step = (OBSERVATION, np.zeros(1), 0.0, OBSERVATION, {}, False)
        assert episode.of_step(*step) == single({"my_probes.surprise": 2.0, "my_probes.Steps": 1.0})
        assert episode.of_step(*step)[Curve("my_probes.Steps")] == 2.0
        assert episode.of_scene(OBSERVATION) == single({"my_probes.surprise": 2.0})


def test_failing_probe_is_reported_once_and_a_gap(own: types.ModuleType) -> None:
    warnings: list[str] = []
    shown = resolve("my_probes.broken", "reward")
    episode = EpisodeProbes(EVERYTHING, shown.probes, warnings.append)
    for _ in range(3):
        assert episode.of_step(OBSERVATION, None, -1.0) == single({"reward": -1.0})
    assert warnings == ["The metric my_probes.broken failed: ZeroDivisionError: no luck"]


def test_own_probes_that_cannot_be(own: types.ModuleType, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no 'surprize' in my_probes\. Did you mean 'surprise'"):
        resolve("my_probes.surprize")
    with pytest.raises(ConfigError, match=r"'nowhere\.x' cannot be imported"):
        resolve("nowhere.x")
    with pytest.raises(ConfigError, match="takes 0 arguments, but a probe takes the first of"):
        resolve("my_probes.nothing")


def resolve(
    *names: str, inspector: Mind = EVERYTHING, recorded: Any = (), absent: Any = None
) -> Any:
    return resolve_metrics(
        names,
        inspector,
        recorded,
        key="render_metrics_train",
        algorithm_name="random",
        absent=absent,
    )
