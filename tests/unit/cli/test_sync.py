"""Which runs are sent, and what is said about those that are not."""

from __future__ import annotations

import json
import logging
from typing import Any

import pytest

from scilab_rl.cli import sync
from scilab_rl.errors import ConfigError, MissingDependencyError, ScilabRLError
from scilab_rl.results import RunResult

FINISHED = RunResult("finished", 0.5, 2, 20, 3.0, "")


@pytest.fixture
def trained(project: Any, make_run: Any) -> Any:
    """Return a function that leaves a run of two epochs behind."""

    def train(name: str, result: RunResult | None = FINISHED, **config: Any) -> Any:
        run = make_run(name, result, **config)
        rows = [{"kind": "epoch", "epoch": e, "step": 10 * e, "x": float(e)} for e in (1, 2)]
        (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
        return run

    return train


def points(run: Any) -> list[tuple[int, float]]:
    event_accumulator = pytest.importorskip(
        "tensorboard.backend.event_processing.event_accumulator"
    )
    events = event_accumulator.EventAccumulator(str(run / "tensorboard")).Reload()
    return [(event.step, event.value) for event in events.Scalars("x")]


def said(caplog: pytest.LogCaptureFixture) -> list[str]:
    lines = [record.getMessage() for record in caplog.records if "scilab_rl" in record.name]
    caplog.clear()
    return lines


def test_one_run_all_runs_and_again(trained: Any, caplog: pytest.LogCaptureFixture) -> None:
    pytest.importorskip("tensorboard")
    caplog.set_level(logging.INFO)
    first, second = trained("100000-a"), trained("110000-b", None)
    assert sync.main(["100000-a", "--to", "tensorboard"]) == 0
    assert said(caplog) == ["100000-a: 2 values and 0 files sent"]
    assert not (second / "tensorboard").exists()
    assert sync.main(["all", "--to", "tensorboard"]) == 0
    assert said(caplog) == [
        "100000-a: already complete",
        "110000-b: 2 values and 0 files sent",
    ]
    assert points(first) == points(second) == [(10, 1.0), (20, 2.0)]


def test_runs_that_cannot_be_sent_do_not_keep_the_others(
    trained: Any, caplog: pytest.LogCaptureFixture
) -> None:
    pytest.importorskip("tensorboard")
    damaged, busy, good = (trained(f"1{i}0000-run") for i in range(3))
    (damaged / "config.yaml").write_text("env: [", encoding="utf-8")
    with busy.in_use():
        assert sync.main(["all", "--to", "tensorboard"]) == 1
        lines = said(caplog)
    assert [line.partition(":")[0] for line in lines] == ["100000-run", "110000-run"]
    assert "Another process works on" in lines[1]
    assert points(good) == [(10, 1.0), (20, 2.0)]


def test_wandb_has_a_command_of_its_own(trained: Any, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    run = trained("100000-a")
    assert sync.main(["100000-a", "--to", "wandb"]) == 0
    folder = run / "wandb" / "offline-run-1"
    folder.mkdir(parents=True)
    assert sync.main(["all", "--to", "wandb"]) == 0
    nothing, line = said(caplog)
    assert nothing == "100000-a: nothing to upload to W&B"
    assert line.startswith("wandb sync ")
    assert line.endswith("100000-a/wandb/offline-run-1")


@pytest.mark.parametrize(
    ("status", "expected"),
    [("running", "interrupted"), ("failed", "failed"), (None, "interrupted")],
)
def test_a_run_that_was_killed_counts_as_interrupted(
    trained: Any, status: str | None, expected: str
) -> None:
    result = RunResult(status, None, 1, 10, 3.0, "") if status else None
    assert sync._ended(trained("100000-a", result)).status == expected


def test_videos_and_pages_are_sent(trained: Any) -> None:
    run = trained("100000-a")
    (run / "episodes").mkdir()
    for name in ("b.mp4", "a.html", "a.npz", "a.rrd"):
        (run / "episodes" / name).touch()
    assert [path.name for path in sync._files(run)] == ["a.html", "b.mp4"]


def test_errors_are_one_line(trained: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match="No run 'nothing'"):
        sync.main(["nothing", "--to", "wandb"])
    with pytest.raises(ConfigError, match="invalid choice: 'mlflo'"):
        sync.main(["last", "--to", "mlflo"])
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MissingDependencyError, match=r"pip install .*\[mlflow\]"):
        sync.main(["last"])


def test_addresses_and_servers_that_do_not_work(trained: Any) -> None:
    pytest.importorskip("mlflow")
    masked = {"mlflow": {"tracking_uri": "http://***@127.0.0.1:9"}}
    trained("100000-a", tracking=masked)
    with pytest.raises(ConfigError, match="with --uri"):
        sync.main(["100000-a"])
    with pytest.raises(ScilabRLError, match=r"mlflow did not accept .* sends the rest") as caught:
        sync.main(["100000-a", "--uri", "http://127.0.0.1:9"])
    assert caught.value.exit_code == 1
    assert "\n" not in str(caught.value)
