"""Training from Python: the same run as from the command line, and nothing else has changed."""

from __future__ import annotations

import logging
import os
import random
import signal
import sys
import types
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra.core.global_hydra import GlobalHydra

import scilab_rl
from scilab_rl.config.overrides import as_override, read_changes
from scilab_rl.errors import ConfigError, MissingDependencyError
from scilab_rl.training.callbacks import RunCallback

ENV = "scilab_rl.testing:TinyReach-v0"
SHORT = {"n_epochs": 2, "eval_after_n_steps": 60, "n_test_rollouts": 2, "mlflow": 0, "quiet": True}


def program_state() -> list[object]:
    logger = logging.getLogger("scilab_rl")
    return [
        random.getstate(), np.random.get_state()[1].tolist(), torch.get_rng_state().tolist(),
        torch.get_num_threads(), signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM),
        Path.cwd(), logger.level, logger.propagate, list(logger.handlers),
        logging.getLogger().handlers[:], GlobalHydra.instance().is_initialized(),
    ]  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    path = tmp_path_factory.mktemp("project")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(path)
        yield path


@pytest.fixture(scope="module")
def run(folder: Path) -> scilab_rl.Run:
    before = program_state()
    trained = scilab_rl.train(ENV, "random", seed=7, tags=["a, b", "c"], **SHORT)
    assert program_state() == before
    return trained


def test_a_run_is_complete(run: scilab_rl.Run, folder: Path) -> None:
    assert run.result.status == "finished" and run.result.steps == 120
    assert run.config["tags"] == ["a, b", "c"] and run.config["algorithm"]["name"] == "random"
    assert (folder / "data" / "last").resolve() == run.path.resolve()
    assert scilab_rl.Run("last").path == run.path.resolve()
    assert repr(run).startswith(f"<Run {run.path.name}: random in {ENV}, finished with success")
    assert "<th" in run._repr_html_() and "problem" not in run._repr_html_()
    assert [row["step"] for row in run.epochs] == [60, 120]


def test_tables(run: scilab_rl.Run) -> None:
    pytest.importorskip("pandas")
    assert list(run.metrics["step"]) == [60, 120]
    assert run.episodes["length"].sum() <= 120
    steps = run.steps(2, seed=3)
    assert list(steps.groupby("episode").size()) == [15, 15]
    assert len(run.steps(2, seed=3, per="episode")) == 2
    listed = scilab_rl.runs(env="*TinyReach*")
    assert run.path.name in set(listed["run"])
    assert len(scilab_rl.runs(where="seed == 7 and steps == 120")) == 1
    assert len(scilab_rl.runs(where=lambda facts: facts["seed"] == 8)) == 0
    with pytest.raises(ConfigError, match=r"where='sed == 7' cannot be read.*Columns: run, id"):
        scilab_rl.runs(where="sed == 7")


def test_without_pandas_one_line_says_how_to_get_it(
    run: scilab_rl.Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    for ask in (lambda: run.metrics, scilab_rl.runs, lambda: run.steps(1)):
        with pytest.raises(MissingDependencyError, match=r'pip install "scilab-rl\[pandas\]"'):
            ask()


def test_figures_are_figures(run: scilab_rl.Run, tmp_path: Path) -> None:
    figure = run.plot("eval/mean_reward", "eval/success_rate")
    assert figure._repr_png_().startswith(b"\x89PNG")
    assert figure.save(tmp_path / "curves.svg").read_text().startswith("<?xml")
    lines = run.plot().figure.axes[0].lines
    assert [list(line.get_xdata()) for line in lines] == [[60, 120]]
    with pytest.raises(ConfigError, match="Did you mean 'eval/success_rate'"):
        run.plot("eval/succes_rate")


def test_a_comparison_is_shown_as_a_page(run: scilab_rl.Run, tmp_path: Path) -> None:
    other = scilab_rl.train(ENV, "random", seed=8, **SHORT)
    comparison = scilab_rl.compare({"first": run, "second": [other]}, metric="eval/mean_reward")
    assert comparison.comparison.groups[1].label == "second"
    assert str(comparison).startswith("second and first do not differ significantly with 1 runs")
    assert comparison._repr_html_().startswith("<iframe srcdoc=")
    assert (tmp_path / "comparison.html") in comparison.save(tmp_path)
    same = scilab_rl.compare(run, f"other={other.path.name}", metric="eval/mean_reward")
    assert [group.label for group in same.comparison.groups] == ["random", "other"]
    reach = scilab_rl.compare(run, other, env="*tinyreach", metric="eval/mean_reward")
    assert [group.n_runs for group in reach.comparison.groups] == [1, 1]
    with pytest.raises(ConfigError, match="has no run in FetchReach"):
        scilab_rl.compare(run, other, env="FetchReach")
    with pytest.raises(ConfigError, match="requires two groups"):
        scilab_rl.compare(run)


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"epochs": 3}, "There is no key 'epochs'. Did you mean 'n_epochs'"),
        ({"n_epochs": object()}, "n_epochs takes numbers, text, lists, mappings or classes"),
        ({"env": "FetchRech"}, "Did you mean 'FetchReach-v4'"),
        ({"algorithm.gama": 0.9, "algorithm": "sac"}, "gama"),
    ],
)
def test_errors_are_one_line(folder: Path, keys: dict, said: str) -> None:
    before = program_state()
    with pytest.raises(ConfigError) as error:
        scilab_rl.train(**({"env": ENV} | keys), quiet=True)
    assert said in str(error.value) and "\n" not in str(error.value)
    assert program_state() == before


def test_an_interrupted_training_raises(folder: Path) -> None:
    class Interrupt(RunCallback):
        def _on_step(self) -> bool:
            os.kill(os.getpid(), signal.SIGINT)
            return True

    with pytest.raises(KeyboardInterrupt):
        scilab_rl.train(ENV, "random", callbacks=[Interrupt()], **SHORT)
    assert scilab_rl.Run("last").result.status == "interrupted"


def test_what_is_printed(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logging.getLogger(), "handlers", [])
    scilab_rl.train(ENV, "random", **SHORT)
    assert capsys.readouterr() == ("", "")
    scilab_rl.train("FetchPush-v1", "random", **(SHORT | {"quiet": False, "eval_after_n_steps": 5}))
    printed = capsys.readouterr()
    assert "status: finished" in printed.out
    assert "FetchPush-v1 is not available any more; using FetchPush-v4." in printed.err


def test_a_notebook_shows_progress(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[str] = []

    class Handle:
        def update(self, thing: object) -> None:
            shown.append(thing._repr_html_())

    display = types.ModuleType("IPython.display")
    display.display = lambda thing, display_id: Handle()
    ipython = types.ModuleType("IPython")
    ipython.get_ipython = lambda: types.SimpleNamespace(kernel=object())
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    monkeypatch.setitem(sys.modules, "IPython.display", display)
    scilab_rl.train(ENV, "random", seed=9, **(SHORT | {"quiet": False}))
    assert shown[-1].startswith("<progress value='120' max='120'></progress> random learns")
    assert "120 of 120 steps. epoch 2: success" in shown[-1]


@pytest.mark.parametrize(
    ("value", "written"),
    [
        (None, "null"), (True, "true"), (np.float32(0.5), "0.5"), (1e-5, "1e-05"),
        ("null", "'null'"), ("1", "'1'"), ("a, b", "'a, b'"), ("it's", r"'it\'s'"), ("", "''"),
        (Path("a/b"), "a/b"), (torch.nn.Tanh, "torch.nn.modules.activation.Tanh"),
        ([1, "x y"], "[1,'x y']"), ({"a": (1, "m:E-v0")}, "{a:[1,m:E-v0]}"),
    ],
)  # fmt: skip
def test_values_are_written_as_they_would_be_typed(value: object, written: str) -> None:
    assert as_override("key", value) == f"key={written}"
    ((_, read),) = read_changes([as_override("key", value)])
    if value is not torch.nn.Tanh and not isinstance(value, Path):
        assert read == (value if not isinstance(value, dict) else {"a": [1, "m:E-v0"]})
