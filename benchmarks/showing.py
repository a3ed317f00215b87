"""What showing costs: steps nobody watches, shown steps, and a viewer that is stuck.

Prints one JSON object with

* ``unwatched_share``: time in the observers of declared but unwatched metrics, as a share of the
  time of a training step of SAC + HER on FetchReach (bar: at most 0.01);
* ``shown_frames_per_second``: shown FetchPush steps per second at 480x480 with 4 probes, drawing,
  probes and hand-over to the encoder included (bar: at least 20), beside
  ``bare_frames_per_second``, the same environment drawn without us;
* ``stuck_viewer_speed``: speed of shown training with a stopped viewer process, relative to a
  running one (bar: at least 0.95).

Run: python benchmarks/showing.py
"""

from __future__ import annotations

import json
import os
import signal
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import hydra

from scilab_rl import assembly, config, experiment
from scilab_rl.results import RunDirectory
from scilab_rl.workspace import open_desk

FOUR = "render_metrics_test=[q_value,critic_variance,goal_distance,reward]"
FOUR_TRAIN = "render_metrics_train=[q_value,critic_variance,goal_distance,reward]"
REPEATS, STUCK_REPEATS, STUCK_STEPS = 3, 6, 400


def main() -> None:
    """Measure everything and print it."""
    open_desk()
    with hydra.initialize_config_module("scilab_rl.conf", version_base="1.3"):
        result = {
            "unwatched_share": unwatched_share(),
            "bare_frames_per_second": bare_frames_per_second(),
            "shown_frames_per_second": shown_frames_per_second(),
            "stuck_viewer_speed": stuck_viewer_speed(),
            "load_average": os.getloadavg()[0],
        }
    sys.stdout.write(json.dumps(result, indent=2) + "\n")


def unwatched_share() -> float:
    """Return the share of a training step that goes into observers while nothing is shown."""
    session = make_session("env=FetchReach", "render=record", FOUR, FOUR_TRAIN)
    session.algorithm.learning_starts = 60
    train = session.showing.train
    spent = 0.0

    def timed(method: Any) -> Any:
        def call(*arguments: Any) -> Any:
            nonlocal spent
            started = time.perf_counter()
            value = method(*arguments)
            spent += time.perf_counter() - started
            return value

        return call

    train.on_step = timed(train.on_step)
    train.complete_step = timed(train.complete_step)
    started = time.perf_counter()
    session.algorithm.learn(600, callback=session.trainer)
    total = time.perf_counter() - started
    close(session)
    return spent / total


def bare_frames_per_second() -> float:
    """Return how many FetchPush steps per second can be drawn at all."""
    session = make_session("env=FetchPush", "render=record")
    env = session.eval_env.envs[0]
    env.reset(seed=1)
    started = time.perf_counter()
    for _ in range(50):
        env.step(env.action_space.sample())
        env.render()
    seconds = time.perf_counter() - started
    close(session)
    return 50 / seconds


def shown_frames_per_second() -> float:
    """Return the steps per second of shown evaluation episodes."""
    from scilab_rl.training.evaluation import evaluate

    rates = []
    for _ in range(REPEATS):
        session = make_session("env=FetchPush", "render=record", FOUR)
        session.showing.evaluation.show(1, 2)
        started = time.perf_counter()
        evaluate(session.algorithm, session.eval_env, 2, seed=1)
        rates.append(100 / (time.perf_counter() - started))
        close(session)
    return statistics.median(rates)


def stuck_viewer_speed() -> float:
    """Return the speed of shown training with a stopped viewer, relative to a running one."""
    speeds: dict[bool, list[float]] = {False: [], True: []}
    for stuck in [False, True] * STUCK_REPEATS:
        session = make_session("env=FetchReach", "render=display", FOUR_TRAIN)
        viewer = session.showing.sinks[0]
        if stuck and viewer._child is not None:
            os.kill(viewer._child.pid, signal.SIGSTOP)
        session.showing.train.show(1, STUCK_STEPS // 50)
        started = time.perf_counter()
        session.algorithm.learn(STUCK_STEPS, callback=session.trainer)
        speeds[stuck].append(STUCK_STEPS / (time.perf_counter() - started))
        if stuck and viewer._child is not None:
            os.kill(viewer._child.pid, signal.SIGCONT)
        close(session)
    return statistics.median(speeds[True]) / statistics.median(speeds[False])


def make_session(*overrides: str) -> Any:
    """Build a run in a temporary folder."""
    base = Path(tempfile.mkdtemp())
    given = [*overrides, "algorithm=cleansac", "mlflow=0", "seed=1", f"base_logdir={base}"]
    cfg = assembly.complete(config.compose([*given, "++algorithm.buffer_size=10000"]))
    directory = RunDirectory.create(base, cfg.env, "bench", 1)
    session = experiment.build(cfg, directory)
    session.trackers.trackers.clear()
    return session


def close(session: Any) -> None:
    """End what a session has opened."""
    session.showing.close()
    session.train_env.close()
    session.eval_env.close()


if __name__ == "__main__":
    main()
