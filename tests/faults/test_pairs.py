"""Every algorithm with every kind of task: it learns, or it is refused in words."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

from scilab_rl.cli import run_command_line
from scilab_rl.workspace import SHIPPED_CONF

from .archetypes import ARCHETYPES
from .harness import scilab_rl

MODULE = "tests.faults.archetypes"
# One character for each of the archetypes, in their order: y where the pair has to work.
_MOVES, _CHOICES, _ALL = "y-y--y----", "-y-yy-y---", "yyyyyyyyy-"
ORACLE = {
    "a2c": _ALL,
    "actor_critic": _MOVES,
    "cleandqn": _CHOICES,
    "cleanppo": "yyyyyyy---",
    "cleansac": _MOVES,
    "cleansacmc": _MOVES,
    "crossq": "y---------",  # it has no policy for dictionaries
    "ddpg": _MOVES,
    "dqn": _CHOICES,
    "jaxsac": _MOVES,
    "jaxtd3": _MOVES,
    "onestepac": _CHOICES,
    "ppo": _ALL,
    "qrdqn": _CHOICES,
    "random": _ALL,
    "sac": _MOVES,
    "td3": _MOVES,
    "tqc": _MOVES,
    "trpo": _ALL,
}
WORKING = [
    (algorithm, name)
    for algorithm, row in ORACLE.items()
    for name, mark in zip(ARCHETYPES, row, strict=True)
    if mark == "y"
]
IMPOSSIBLE = [
    (algorithm, name) for algorithm in ORACLE for name in ARCHETYPES
    if (algorithm, name) not in WORKING
]  # fmt: skip
SHORT = ("n_epochs=1", "eval_after_n_steps=50", "n_test_rollouts=1", "seed=1", "mlflow=0",
         "tuned=false", "vector=inprocess")  # fmt: skip


def needs_jax(algorithm: str) -> None:
    if algorithm.startswith("jax") and importlib.util.find_spec("jax") is None:
        pytest.skip("jax is not installed")


def test_f29_the_table_has_every_algorithm() -> None:
    assert set(ORACLE) == {path.stem for path in (SHIPPED_CONF / "algorithm").glob("*.yaml")}
    assert len(WORKING) + len(IMPOSSIBLE) == len(ORACLE) * len(ARCHETYPES)


@pytest.mark.parametrize("algorithm", ORACLE)
def test_f29_pairs_that_cannot_work_are_refused(
    algorithm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    needs_jax(algorithm)
    monkeypatch.chdir(tmp_path)
    # The answer depends on the actions alone; one task of each kind is enough here.
    names = [name for other, name in IMPOSSIBLE if other == algorithm]
    for name in names[:: max(1, len(names) // 2)]:
        refuse(algorithm, name, capsys)
    assert list(tmp_path.rglob("*.*")) == []


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ORACLE)
def test_f29_all_pairs_that_cannot_work_are_refused(
    algorithm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    needs_jax(algorithm)
    monkeypatch.chdir(tmp_path)
    for other, name in IMPOSSIBLE:
        if other == algorithm:
            refuse(algorithm, name, capsys)


def refuse(algorithm: str, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    code = run_command_line([f"algorithm={algorithm}", f"env={MODULE}:{name}", *SHORT])
    captured = capsys.readouterr()
    assert code == 2, (name, captured.err)
    (line,) = [line for line in captured.err.splitlines() if line.startswith("error:")]
    assert "Traceback" not in captured.err
    can = [other for other, row in WORKING if row == name and not other.startswith("jax")]
    if "flatten_obs" in line:
        return
    if not can:
        assert "None of the algorithms can." in line
        return
    listed = re.search(r"These can: (.*)\.$", line)
    assert listed, line
    assert set(can) <= set(listed[1].split(", "))


@pytest.mark.slow
@pytest.mark.parametrize(("algorithm", "name"), WORKING)
def test_f29_pairs_that_can_work_train(algorithm: str, name: str, tmp_path: Path) -> None:
    needs_jax(algorithm)
    more = ["algorithm.n_steps=16"] if algorithm in ("ppo", "cleanppo", "trpo") else []
    more += ["algorithm.batch_size=16"] if more else []
    more += ["algorithm.buffer_size=200"] if algorithm in ("dqn", "qrdqn", "cleandqn") else []
    done = scilab_rl(f"algorithm={algorithm}", f"env={MODULE}:{name}", *SHORT, *more,
                     cwd=tmp_path, timeout=300)  # fmt: skip
    assert done.code == 0, done.errors


@pytest.mark.parametrize("algorithm", ["sac", "cleansac"])
def test_f29_hindsight_without_a_step_limit(algorithm: str, tmp_path: Path) -> None:
    done = scilab_rl(f"algorithm={algorithm}", f"env={MODULE}:Endless-v0", *SHORT, cwd=tmp_path)
    assert done.code == 2, done.errors
    assert "step limit" in done.error


@pytest.mark.parametrize("algorithm", ["sac", "td3", "cleansac", "ppo", "cleanppo"])
def test_f29_actions_without_bounds(algorithm: str, tmp_path: Path) -> None:
    """An action without bounds cannot be scaled; most algorithms say so, and none fails later."""
    done = scilab_rl(f"algorithm={algorithm}", f"env={MODULE}:Boundless-v0", *SHORT, cwd=tmp_path)
    assert done.code == 2, done.errors
    assert re.search(r"finite|bound", done.error)
