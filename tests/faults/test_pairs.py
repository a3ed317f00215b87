"""Every algorithm with every kind of task: it learns, or it is refused in words."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

from scilab_rl.algorithms import models
from scilab_rl.cli.main import run_command_line
from scilab_rl.config.workspace import SHIPPED_CONF

from .archetypes import ARCHETYPES
from .harness import scilab_rl

MODULE = "tests.faults.archetypes"
# One character for each of the archetypes, in their order: y where the pair has to work.
_N_UNREADABLE = 12
_MOVES, _CHOICES, _ALL = "y-y--y----yyy--", "-y-yy-y------y-", "yyyyyyyyy-yyyyy"
# PyTorch has no modules with a dot in their name, so that Stable-Baselines3's make none.
_SB3_MOVES, _SB3_ALL = "y-y--y----yy---", "yyyyyyyyy-yy-yy"
ORACLE = {
    "a2c": _SB3_ALL,
    "actor_critic": _MOVES,
    "cleandqn": _CHOICES,
    "cleanppo": "yyyyyyy---yyyy-",
    "cleansac": _MOVES,
    "cleansacmc": _MOVES,
    "crossq": "y---------yy---",  # it has no policy for dictionaries
    "ddpg": _SB3_MOVES,
    "dqn": _CHOICES,
    "jaxcrl": "--y------------",  # it learns from goals alone
    "jaxgciql": "--y------------",
    "jaxsac": _MOVES,
    "jaxtd3": _MOVES,
    "onestepac": _CHOICES,
    "ppo": _SB3_ALL,
    "qrdqn": _CHOICES,
    "random": _ALL,
    "recurrentppo": "yyyyyyyy--yy---",  # no switches, no dice
    "sac": _SB3_MOVES,
    "td3": _SB3_MOVES,
    "tqc": _SB3_MOVES,
    "trpo": _SB3_ALL,
}
# They act in choice tasks alone, which are not in this table; `tests/contract` has their pairs.
MODELS = {path.stem for path in Path(models.__file__).parent.glob("[a-z]*.py")}
WORKING = [
    (algorithm, name)
    for algorithm, row in ORACLE.items()
    for name, mark in zip(ARCHETYPES, row + _N_UNREADABLE * "-", strict=True)
    if mark == "y"
]
IMPOSSIBLE = [
    (algorithm, name) for algorithm in ORACLE for name in ARCHETYPES
    if (algorithm, name) not in WORKING
]  # fmt: skip
SHORT = ("n_epochs=1", "eval_after_n_steps=50", "n_test_rollouts=1", "seed=1", "mlflow=0",
         "tuned=false", "vector=inprocess", "require_updates=false")  # fmt: skip
WAY_OUT = "wrappers=[{_target_: scilab_rl.envs.clipping.ClipAction, low: -1, high: 1}]"


def needs_jax(algorithm: str) -> None:
    if algorithm.startswith("jax") and importlib.util.find_spec("jax") is None:
        pytest.skip("jax is not installed")


def test_f29_the_table_has_every_algorithm() -> None:
    shipped = {path.stem for path in (SHIPPED_CONF / "algorithm").glob("*.yaml")}
    assert set(ORACLE) == shipped - MODELS
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
    if "Choice-v0" in name or "EntryMove" in name:
        kind = re.sub(r"(Choice|EntryMove)-v0", "", name)
        if f" is a {kind} space" in line:
            assert name in line
            assert ("'odd'" in line) == ("Entry" in name)
            return
    can = [other for other, row in WORKING if row == name and not other.startswith("jax")]
    if "flatten_obs" in line:
        return
    if not can:
        assert "None of the algorithms can." in line
        return
    listed = re.search(r"These can: (.*)\.$", line)
    assert listed, line
    assert set(can) <= set(listed[1].split(", "))


def test_f29_what_no_algorithm_reads_is_refused_in_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in list(ARCHETYPES)[-_N_UNREADABLE:]:
        refuse("random", name, capsys)
    assert list(tmp_path.rglob("*.*")) == []


@pytest.mark.slow
@pytest.mark.parametrize(("algorithm", "name"), WORKING)
def test_f29_pairs_that_can_work_train(algorithm: str, name: str, tmp_path: Path) -> None:
    needs_jax(algorithm)
    train(algorithm, name, tmp_path)


@pytest.mark.parametrize(
    ("algorithm", "name"),
    [("sac", "BytesMove-v0"), ("cleansac", "LockedMove-v0"),
     ("ppo", "DiceChoices-v0"), ("dqn", "OddPartsChoice-v0")],
)  # fmt: skip
def test_f29_odd_spaces_work(algorithm: str, name: str, tmp_path: Path) -> None:
    """One pair of each kind; `test_f29_pairs_that_can_work_train` has them all."""
    train(algorithm, name, tmp_path, "n_envs=2", "vector=workers")


def train(algorithm: str, name: str, tmp_path: Path, *overrides: str) -> None:
    more = (
        ["algorithm.n_steps=16"] if algorithm in ("ppo", "cleanppo", "recurrentppo", "trpo") else []
    )
    more += ["algorithm.batch_size=16"] if more else []
    more += ["algorithm.buffer_size=200"] if algorithm in ("dqn", "qrdqn", "cleandqn") else []
    more += ["algorithm.data=random:3"] if algorithm == "jaxgciql" else []
    done = scilab_rl(f"algorithm={algorithm}", f"env={MODULE}:{name}", *SHORT, *more, *overrides,
                     cwd=tmp_path, timeout=300)  # fmt: skip
    assert done.code == 0, done.errors


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_f29_the_first_of_the_actions_is_learned(algorithm: str, tmp_path: Path) -> None:
    """Actions from -1 to 1: an algorithm that sends 0 and 1 alone gets 0 of 10."""
    more = {"ppo": ["algorithm.n_steps=100", "algorithm.learning_rate=0.003"], "dqn": []}
    done = scilab_rl(f"algorithm={algorithm}", f"env={MODULE}:Left-v0", *SHORT, *more[algorithm],
                     "eval_after_n_steps=1000", cwd=tmp_path, timeout=100)  # fmt: skip
    assert done.code == 0, done.errors
    reward = re.search(r"^reward: (.*)$", done.output + done.errors, re.MULTILINE)
    assert reward, done.errors
    assert float(reward[1]) > 8


@pytest.mark.parametrize("algorithm", ["sac", "cleansac"])
def test_f29_hindsight_without_a_step_limit(algorithm: str, tmp_path: Path) -> None:
    done = scilab_rl(f"algorithm={algorithm}", f"env={MODULE}:Endless-v0", *SHORT, cwd=tmp_path)
    assert done.code == 2, done.errors
    assert "step limit" in done.error


@pytest.mark.parametrize("algorithm", ["sac", "td3", "cleansac", "ppo", "cleanppo", "random"])
def test_f29_actions_without_bounds(
    algorithm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """An action without bounds cannot be scaled, and bounds of finfo.max are none."""
    monkeypatch.chdir(tmp_path)
    for name, problem in (("Boundless-v0", "no bound in"), ("Huge-v0", "mean no bound in")):
        code = run_command_line([f"algorithm={algorithm}", f"env={MODULE}:{name}", *SHORT])
        errors = capsys.readouterr().err
        assert code == 2, errors
        assert problem in errors
        assert f"{name} have" in errors
        assert WAY_OUT in errors


def test_f29_actions_get_bounds(tmp_path: Path) -> None:
    """The way out that the message names is one."""
    done = scilab_rl("algorithm=sac", f"env={MODULE}:Huge-v0", WAY_OUT, *SHORT, cwd=tmp_path)
    assert done.code == 0, done.errors
