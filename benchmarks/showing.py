"""What showing costs: steps nobody watches, shown steps, and a viewer that is stuck.

Prints one JSON object with

* ``unwatched_share``: time in the observers of declared but unwatched metrics, as a share of the
  time of a training step of SAC + HER on FetchReach (bar: at most 0.01);
* ``shown_frames_per_second``: shown FetchPush steps per second at 480x480 with 4 probes, drawing,
  probes and hand-over to the encoder included (bar: at least 20), beside
  ``bare_frames_per_second``, the same environment drawn without us;
* ``running_viewer`` and ``stuck_viewer``: speed of shown training with a viewer that reads, or with
  one that has stopped reading until all buffers were full, relative to the same training whose
  scenes nobody takes (bar: at least 0.95). Windows of one episode follow each other in the order
  A B B A within one run, so that slow changes of the machine's load cancel; ``interval`` holds 95 %
  of the bootstrapped medians. There are no updates in them, which would hide the viewer's share.

Run: python benchmarks/showing.py [RESULT.json]
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
from subprocess import DEVNULL, Popen
from typing import Any

import numpy as np

from scilab_rl.config.compose import compose
from scilab_rl.config.workspace import open_project
from scilab_rl.recording.callback import Recording
from scilab_rl.recording.live import LOOPBACK, LiveViewer, free_port, start_viewer
from scilab_rl.recording.records import ClipInfo, Record, encode_picture
from scilab_rl.run.checks import complete
from scilab_rl.run.directory import RunDirectory
from scilab_rl.run.run import build_session
from scilab_rl.training.callbacks import RunCallback

FOUR = "render_metrics_test=[q_value,critic_variance,goal_distance,reward]"
FOUR_TRAIN = "render_metrics_train=[q_value,critic_variance,goal_distance,reward]"
REPEATS = 3
EPISODE = 50  # steps of an episode of Fetch
N_PAIRS = 48  # of windows, per viewer


def main() -> None:
    """Measure everything and print it."""
    open_project()
    result = {
        "unwatched_share": unwatched_share(),
        "bare_frames_per_second": bare_frames_per_second(),
        "shown_frames_per_second": shown_frames_per_second(),
        "running_viewer": speed_with_viewer(stuck=False),
        "stuck_viewer": speed_with_viewer(stuck=True),
        "load_average": os.getloadavg()[0],
    }
    text = json.dumps(result, indent=2) + "\n"
    sys.stdout.write(text)
    for path in sys.argv[1:]:
        Path(path).write_text(text, encoding="utf-8")


def unwatched_share() -> float:
    """Return the share of a training step that goes into observers while nothing is shown."""
    session = make_session("env=FetchReach", "render=record", FOUR, FOUR_TRAIN)
    session.algorithm.learning_starts = 60
    train = recording_of(session).train
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
        recording_of(session).evaluation.show(1, 2)
        started = time.perf_counter()
        evaluate(session.algorithm, session.eval_env, 2, seed=1)
        rates.append(100 / (time.perf_counter() - started))
        close(session)
    return statistics.median(rates)


def speed_with_viewer(*, stuck: bool) -> dict[str, Any]:
    """Compare shown training with a viewer to the same whose scenes nobody takes."""
    session = make_session(
        "env=FetchReach", "render=display", FOUR_TRAIN, "eval_after_n_steps=1000000"
    )
    session.algorithm.learning_starts = 10**9
    recording = recording_of(session)
    viewer = recording.sinks[0]
    reader = connect_reader(viewer)
    if stuck:
        os.kill(reader.pid, signal.SIGSTOP)
        fill_buffers(viewer)
    windows = Windows(recording.train, viewer, wait=not stuck)
    session.trainer.callbacks.insert(1, windows)
    recording.train.show(1, 10**9)
    session.algorithm.learn((2 * N_PAIRS + 1) * EPISODE, callback=session.trainer)
    reader.kill()
    reader.wait()
    close(session)
    return windows.result() | {"dropped_pictures": viewer.n_dropped_pictures}


def connect_reader(viewer: LiveViewer) -> Popen[bytes]:
    """Start a program that reads what the viewer serves, as a window or a browser does."""
    own_port = str(free_port(viewer.data_port + 1))
    reader = start_viewer(
        [viewer.uri, "--serve-grpc", "--bind", LOOPBACK, "--port", own_port], DEVNULL
    )
    time.sleep(2.0)
    return reader


def fill_buffers(viewer: LiveViewer) -> None:
    """Send scenes until the viewer takes no more."""
    noise = np.random.default_rng(0).integers(0, 256, (1024, 1024, 3), dtype=np.uint8)
    scene = Record("train", 0, 0, 1, 0, encode_picture(noise), None)
    viewer.begin(ClipInfo("noise", "train", 1, "noise", "noise", 25.0, ()))
    while not viewer.n_dropped_pictures:
        viewer.add(scene)
        time.sleep(0.005)


class Windows(RunCallback):
    """Times episodes while a viewer and nobody take turns in the order A B B A.

    Args:
        timeline: What makes the scenes.
        viewer: Takes them in every other window.
        wait: Whether the viewer shall have finished before the next window.
    """

    def __init__(self, timeline: Any, viewer: Any, *, wait: bool) -> None:
        super().__init__()
        self.timeline = timeline
        self.takers = {False: _Nobody(), True: viewer}
        self.viewer = viewer
        self.wait = wait
        self.seconds: dict[bool, list[tuple[float, float]]] = {False: [], True: []}
        self._n_steps = 0
        self._order = [False, *[False, True, True, False] * (N_PAIRS // 2), False]
        self._started = (0.0, 0.0)

    def _on_step(self) -> bool:
        """Count; between two episodes change the taker."""
        self._n_steps += 1
        window, step = divmod(self._n_steps, EPISODE)
        if step:
            return True
        wall, cpu = self._started
        if window > 1:  # the first one warms up
            times = (time.perf_counter() - wall, time.process_time() - cpu)
            self.seconds[self._order[window - 1]].append(times)
        while self.wait and self.viewer.n_waiting:
            time.sleep(0.01)
        self.timeline.sinks = [self.takers[self._order[window]]]
        self._started = (time.perf_counter(), time.process_time())
        return True

    def result(self) -> dict[str, Any]:
        """Return relative speeds, by wall clock and by processor time."""
        without, with_viewer = (np.array(self.seconds[taken]) for taken in (False, True))
        ratios = without / with_viewer
        drawn = np.random.default_rng(0).integers(0, len(ratios), (10_000, len(ratios)))
        low, high = np.percentile(np.median(ratios[drawn], axis=1), [2.5, 97.5], axis=0)
        wall, cpu = np.median(ratios, axis=0)
        return {
            "speed": wall,
            "interval": [low[0], high[0]],
            "speed_by_processor_time": cpu,
            "interval_by_processor_time": [low[1], high[1]],
            "steps_per_second": EPISODE / float(np.median(with_viewer[:, 0])),
            "steps_per_second_nobody": EPISODE / float(np.median(without[:, 0])),
            "pairs": len(ratios),
        }


class _Nobody:
    """Takes scenes and does nothing."""

    def begin(self, clip: Any) -> None:
        pass

    def add(self, record: Any) -> None:
        pass

    def end(self) -> None:
        pass


def make_session(*overrides: str) -> Any:
    """Build a run in a temporary folder."""
    base = Path(tempfile.mkdtemp())
    given = [*overrides, "algorithm=cleansac", "mlflow=0", "seed=1", f"base_logdir={base}"]
    cfg = complete(compose([*given, "++algorithm.buffer_size=10000"]))
    directory = RunDirectory.create(base, cfg.env, "bench", 1)
    session = build_session(cfg, directory)
    session.trackers.trackers.clear()
    return session


def recording_of(session: Any) -> Recording:
    """Return what shows the episodes of a session."""
    return next(c for c in session.trainer.callbacks if isinstance(c, Recording))


def close(session: Any) -> None:
    """End what a session has opened."""
    session.trainer.close()
    session.train_env.close()
    session.eval_env.close()


if __name__ == "__main__":
    main()
