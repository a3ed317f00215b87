"""Rates of evaluations and of training count all episodes."""

import numpy as np

from scilab_rl.envs.vec_step import ObservedStep, decode_step
from scilab_rl.metrics.criteria import criterion_curve
from scilab_rl.metrics.logger import MetricLogger
from scilab_rl.training.evaluation import Episode, Evaluation
from scilab_rl.training.statistics import RolloutStatistics


def episode(*infos: dict) -> Episode:
    episode = Episode()
    for info in infos:
        episode.add(0.0, info)
    return episode


def test_an_evaluation_without_a_report_has_a_rate_only_if_the_task_reports() -> None:
    silent = Evaluation([episode({}, {}), episode({})])
    assert "eval/success_rate" not in silent.metrics()
    metrics = silent.metrics(reports_success=True)
    assert metrics["eval/success_rate"] == metrics["eval/success_once_rate"] == 0.0
    assert metrics["eval/success_not_reported"] == 2.0


def test_success_reported_on_the_way_is_no_success_at_the_end() -> None:
    metrics = Evaluation([episode({"is_success": True}, {}), episode({}, {})]).metrics()
    assert (metrics["eval/success_rate"], metrics["eval/success_once_rate"]) == (0.0, 0.5)
    assert metrics["eval/success_not_reported"] == 2.0


def test_training_counts_its_silent_episodes() -> None:
    episodes: list[dict] = []
    statistics = RolloutStatistics(MetricLogger(), 1, episodes.append)
    zero, column, end = np.zeros(1, dtype=np.int64), np.zeros((1, 1)), np.ones(1, bool)
    for info in ({"is_success": True}, {}, {}, {"success": 0}):
        infos = [info | {"terminal_observation": column[0]}]
        decoded = decode_step(column, column, column, np.zeros(1), end, infos)
        step = ObservedStep(**vars(decoded), phase="train", step=1, episodes=zero,
                            episode_steps=zero, frames=[None], states=[None])  # fmt: skip
        statistics.on_step(step)
    metrics = statistics.metrics()
    assert metrics["rollout/success_rate"] == 0.25
    assert metrics["rollout/success_not_reported"] == 2.0
    assert [e.get("success") for e in episodes] == [True, None, None, False]


def test_a_curve_for_a_study_never_mixes_success_and_reward() -> None:
    rows = [{"eval/mean_reward": -50.0}, {"eval/mean_reward": 1.0, "eval/success_rate": 0.5}]
    assert criterion_curve(rows, "eval/success_rate") == [0.0, 0.5]
    assert criterion_curve(rows[:1], "eval/success_rate") == [-50.0]
