import os
import pty
import re
import subprocess
import sys
import textwrap
from dataclasses import replace

import pytest

from scilab_rl.config.compose import compose
from scilab_rl.tracking.console import ConsoleTracker, is_interactive

from .conftest import result, run_info

VALUES = {"eval/success_rate": 0.25, "eval/mean_reward": -7.5, "time/fps": 123.4}

COURSE = """
    import time
    from pathlib import Path
    from scilab_rl.results import RunResult
    from scilab_rl.config.schema import AlgorithmConfig, RunConfig
    from scilab_rl.tracking.base import TrackedRun
    from scilab_rl.tracking.console import ConsoleTracker
    tracker = ConsoleTracker()
    sac = AlgorithmConfig("sac")
    cfg = RunConfig("TinyReach-v0", seed=7, eval_after_n_steps=1000, n_epochs=2, algorithm=sac)
    tracker.begin(TrackedRun(cfg, Path("data/run")))
    for step in range(1, 1001):
        tracker.step(step)
        time.sleep(0.0005)
    values = {"eval/success_rate": 0.25, "eval/mean_reward": -7.5, "time/fps": 123.4}
    tracker.epoch(1000, 1, values)
    tracker.end(RunResult("finished", 0.25, 1, 1000, 3.0, "data/run", values))
"""


def on_a_terminal(**environment):
    """Return what a person would get to see, control characters included."""
    controller, terminal = pty.openpty()
    kept = {name: os.environ[name] for name in ("PATH",) if name in os.environ}
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(COURSE)],
        env=kept | {"COLUMNS": "120"} | environment,
        stdin=terminal,
        stdout=terminal,
        stderr=terminal,
    )
    os.close(terminal)
    seen = b""
    while True:
        try:
            block = os.read(controller, 65536)
        except OSError:  # the last writer has closed it
            break
        if not block:
            break
        seen += block
    os.close(controller)
    assert process.wait(timeout=60) == 0
    return seen.decode()


def test_plain_lines_where_nobody_watches(tmp_path, capsys):
    tracker = ConsoleTracker()
    tracker.begin(run_info(tmp_path))
    for step in range(20):
        tracker.step(step)
    tracker.epoch(10, 1, VALUES)
    tracker.end(result())
    shown = capsys.readouterr()
    assert shown.err.splitlines()[1] == (
        "epoch   1        10 steps  success 0.25  reward -7.5  123 steps/s"
    )
    assert "sac learns TinyReach-v0 (seed 7, up to 2 epochs)" in shown.err
    assert shown.out.splitlines()[:4] == [
        "status: finished",
        "algorithm: sac",
        "environment: TinyReach-v0",
        "seed: 7",
    ]
    assert "success: 0.5" in shown.out
    assert "\x1b" not in shown.err + shown.out


def test_a_failed_run_shows_no_table(tmp_path, capsys):
    tracker = ConsoleTracker()
    tracker.begin(run_info(tmp_path))
    tracker.end(result("failed"))
    assert capsys.readouterr().out == ""


def test_on_a_terminal_one_bar_with_steps_speed_and_success_then_a_table():
    seen = on_a_terminal(TERM="xterm-256color")
    assert "\x1b[" in seen
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", seen)
    assert re.search(r"epoch 1 .*\d+/2,000 steps", text)
    assert "epoch   1     1,000 steps  success 0.25  reward -7.5  123 steps/s" in text
    assert "│ finished" in text


@pytest.mark.parametrize("environment", [{"TERM": "dumb"}, {"TERM": "xterm", "CI": "true"}])
def test_no_control_characters_for_terminals_that_cannot_redraw(environment):
    seen = on_a_terminal(**environment)
    assert "\x1b" not in seen
    assert "status: finished" in seen


def test_captured_output_is_not_interactive():
    assert not is_interactive()


def test_the_first_line_names_tuned_values(tmp_path, capsys):
    tuned = compose(["algorithm=sac", "env=FetchPush"])
    ConsoleTracker().begin(replace(run_info(tmp_path), cfg=tuned))
    assert "sac learns FetchPush with tuned values (seed" in capsys.readouterr().err
