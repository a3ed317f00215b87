"""The trainer's epochs, and the callbacks that do everything else."""

from __future__ import annotations

import json
import signal
from collections.abc import Mapping
from pathlib import Path

import pytest
from stable_baselines3.common.callbacks import BaseCallback

import scilab_rl.testing  # noqa: F401 - registers the tiny environments
from scilab_rl.algorithms.random import RANDOM
from scilab_rl.config.schema import RunConfig
from scilab_rl.envs.vectorize import make_eval_env, make_train_env
from scilab_rl.metrics.store import MetricStore
from scilab_rl.tracking.base import TrackerGroup
from scilab_rl.training import checkpoint
from scilab_rl.training.callbacks import EarlyStop, KeepBest, Pruning, RunCallback
from scilab_rl.training.loop import Outcome, Trainer

CFG = RunConfig("TinyReach-v0", seed=1)


def make_trainer(folder: Path, **keys: object) -> Trainer:
    given: dict = {"eval_after_n_steps": 20, "n_epochs": 3, "n_test_rollouts": 1, "seed": 1}
    given |= {"early_stop_threshold": 2.0, "save_model_freq": 0, **keys}
    model = RANDOM(env=make_train_env(CFG), seed=1)
    eval_env = make_eval_env(CFG)
    return Trainer(RunConfig(**given), model, eval_env, TrackerGroup([]), folder)


class Listener(RunCallback):
    """Notes what it hears, and ends the run after an epoch."""

    def __init__(self, reasons: Mapping[int, str] | None = None) -> None:
        super().__init__()
        self.reasons = reasons or {}
        self.heard: list[tuple] = []

    def begin(self, trainer: Trainer) -> None:
        self.heard.append(("begin", trainer.n_epochs_done, trainer.state.model.num_timesteps))

    def on_evaluation_start(self, epoch: int) -> None:
        self.heard.append(("evaluation", epoch, self.num_timesteps))

    def on_epoch(self, step: int, epoch: int, values: Mapping[str, float]) -> str | None:
        self.heard.append(("epoch", epoch, step))
        assert values["time/total_timesteps"] == step
        return self.reasons.get(epoch)

    def close(self) -> None:
        self.heard.append(("close",))


class Counter(BaseCallback):
    """One of Stable-Baselines3, which knows no epochs but looks at each step."""

    total = 0.0

    def _on_step(self) -> bool:
        self.total += float(self.locals["rewards"][0])
        return True


def test_callbacks_hear_of_everything_in_order(tmp_path: Path) -> None:
    trainer, listener, counter = make_trainer(tmp_path), Listener(), Counter()
    trainer.callbacks += [listener, counter]
    assert trainer.learn() == Outcome("finished")
    trainer.close()
    epochs = [(what, n, 20 * n) for n in (1, 2, 3) for what in ("evaluation", "epoch")]
    assert listener.heard == [("begin", 0, 0), *epochs, ("close",)]
    assert counter.n_calls == listener.n_calls == 60
    assert trainer.state.store.steps == [20, 40, 60]
    statistics = trainer.state.statistics
    assert counter.total == pytest.approx(sum(statistics.episode_returns) + statistics.returns[0])


def test_policies_of_some_epochs_are_kept(tmp_path: Path) -> None:
    trainer = make_trainer(tmp_path, keep_policies=2, n_epochs=5)
    trainer.learn()
    kept = {p.name: checkpoint.verify(p)["step"] for p in tmp_path.glob("rl_model_epoch_*")}
    assert kept == {f"rl_model_epoch_000{epoch}": 20 * epoch for epoch in (1, 2, 4)}


@pytest.mark.parametrize(
    ("reasons", "outcome", "n_epochs"),
    [({2: "tired"}, "tired", 2), ({3: "tired"}, "finished", 3), ({}, "finished", 3)],
)
def test_a_reason_ends_a_run_that_has_epochs_left(
    reasons: dict[int, str], outcome: str, n_epochs: int, tmp_path: Path
) -> None:
    trainer = make_trainer(tmp_path)
    trainer.callbacks += [Listener(reasons), Listener({2: "later"} if 2 in reasons else {})]
    assert trainer.learn() == Outcome(outcome)
    assert trainer.n_epochs_done == n_epochs


def test_pruning_ends_a_run_where_it_may_not_continue(tmp_path: Path) -> None:
    trainer, asked = make_trainer(tmp_path), []

    def should_continue(step: int, epoch: int, values: Mapping[str, float]) -> bool:
        asked.append((step, epoch))
        return epoch < 2

    trainer.callbacks.append(Pruning(should_continue))
    assert trainer.learn() == Outcome("pruned")
    assert asked == [(20, 1), (40, 2)]


def test_all_callbacks_are_closed_even_when_one_fails(tmp_path: Path) -> None:
    class Failing(RunCallback):
        def close(self) -> None:
            raise OSError("disk full")

    trainer, listeners = make_trainer(tmp_path), [Listener(), Listener()]
    trainer.callbacks = [listeners[0], Failing(), listeners[1]]
    with pytest.raises(OSError, match="disk full"):
        trainer.close()
    assert [listener.heard for listener in listeners] == [[("close",)]] * 2


def test_checkpoints_are_kept_at_each_multiple_and_where_a_run_stops(tmp_path: Path) -> None:
    class StopAt(RunCallback):
        def begin(self, trainer: Trainer) -> None:
            self.checkpoints = trainer.checkpoints

        def _on_step(self) -> bool:
            if self.num_timesteps == 37:
                self.checkpoints.stop_request.receive(signal.SIGTERM, None)
            return True

    trainer = make_trainer(tmp_path, save_model_freq=15)
    trainer.callbacks.append(StopAt())
    assert trainer.learn() == Outcome("interrupted", signal.SIGTERM)
    kept = sorted(path.name for path in tmp_path.glob("checkpoints/step_*"))
    assert kept == ["step_0000000030", "step_0000000037"]


def test_the_best_policy_is_the_one_with_most_success_then_most_reward(tmp_path: Path) -> None:
    state = make_trainer(tmp_path).state
    keep_best, best = KeepBest(state, tmp_path), []
    for epoch, (rate, reward) in enumerate([(0.1, -1), (0.1, -2), (0.2, -9), (0.2, -9)], start=1):
        keep_best.on_epoch(epoch, epoch, {"eval/success_rate": rate, "eval/mean_reward": reward})
        manifest = json.loads((tmp_path / "rl_model_best" / "manifest.json").read_text())
        best.append(manifest["epoch"])
    assert best == [1, 1, 3, 3]
    assert state.best == (0.2, -9)


def test_early_stop_needs_the_mean_of_the_last_epochs() -> None:
    store, answers = MetricStore(), []
    early_stop = EarlyStop(store, "eval/x", threshold=0.9, last_n=2)
    for epoch, value in enumerate([1.0, 0.7, 1.0, 0.8], start=1):
        store.append(epoch, {"eval/x": value})
        answers.append(early_stop.on_epoch(epoch, epoch, {}))
    assert answers == [None, None, None, "solved"]
