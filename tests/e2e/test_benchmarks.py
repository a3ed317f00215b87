"""Every benchmark in its smallest size, and the arithmetic that they share."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from .chromium import EXECUTABLE
from .commands import ROOT

BENCHMARKS = ROOT / "benchmarks"
SMALL_RUN = (
    "algorithm.batch_size=16", "algorithm.net_arch=[16]", "algorithm.buffer_size=2000",
    "algorithm.learning_starts=20",
)  # fmt: skip
SMALLER_SHOWING = "import showing; showing.N_PAIRS = 2; showing.REPEATS = 1; showing.main()"
SMALLER_STUDY = """
import study
if __name__ == "__main__":
    study.SECONDS, study.N_WAITING, study.N_WORKERS = (0.5, 1.0), 4, 2
    study.n_cores, study.N_TRAININGS = (lambda: 1), 2
    study.main()
"""
# By the name in `benchmarks/all.py`: what runs instead, and what has to be among the figures.
SMALLEST = {
    "startup": (["startup.py", "--rounds", "1"], "jaxsac"),
    "updates": (
        ["updates.py", "--rounds", "1", "--sizes", "32,16", "--steps", "150"],
        "batch 32, [16]",
    ),
    "steps": (
        ["steps.py", "--rounds", "1", "--steps", "120", "--only", "stable-baselines3", "jaxsac"],
        "jaxsac",
    ),
    "rounds": (
        [
            "rounds.py", "--rounds", "1", "--steps", "2", *SMALL_RUN[:2],
            "algorithm.learning_starts=400",
        ],
        "ratio",
    ),
    "replay": (["replay.py", "--transitions", "4000"], "ours"),
    "checkpoint": (["checkpoint_1m.py", "--transitions", "1000"], "save_seconds"),
    "environments": (["environments.py", "--steps", "1"], 0),
    "scaling": (
        ["scaling.py", "--rounds", "1", "--steps", "2", "--sizes", "32,16", "--n-envs", "1", "2"],
        "updates",
    ),
    "gpu": (
        [
            "gpu.py", "--rounds", "1", "--steps", "120", "--sizes", "16,16",
            "--only", "jaxsac", "cleansac",
        ],
        "rows",
    ),
    "cost": (["cost.py", "--rounds", "1", "--steps", "60", *SMALL_RUN], "declared metrics"),
    "showing": (["-c", SMALLER_SHOWING], "stuck_viewer"),
    "study": (["smaller_study.py"], "unequal"),
    "decisions": (["decisions.py", "--runs", "30"], "sqlite, 30 runs"),
    "metrics": (["load.py", "metrics", "--scale", "0.01"], "part"),
    "board": (["board.py", "--runs", "5"], "write_seconds"),
    "exported": (
        ["exported_policies.py", "--agents", "CartPole", "--observations", "100"], "agents",
    ),
    "hbayesdm": (
        [
            "hbayesdm_data.py", "--simulated", "--only", "bandit2arm_delta", "--warmup", "20",
            "--samples", "20",
        ],
        "bandit2arm_delta",
    ),
    "reach": (
        [
            "time_to_success.py", "reach", "n_epochs=1", "eval_after_n_steps=60",
            "n_test_rollouts=1", *SMALL_RUN, "--seeds", "1", "--only", "cleansac",
        ],
        "runs",
    ),
}  # fmt: skip


@pytest.fixture
def benchmarks(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    monkeypatch.syspath_prepend(str(BENCHMARKS / "peers"))

    return importlib.import_module


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALLEST)
def test_runs_in_its_smallest_size(name: str, tmp_path: Path, benchmarks: Any) -> None:
    if name == "showing":
        pytest.importorskip("rerun")
    if name in ("startup", "updates", "steps", "scaling", "gpu", "cost"):
        pytest.importorskip("jax")
    if name == "cost":
        pytest.importorskip("mlflow")
        pytest.importorskip("tensorboard")
    if name == "hbayesdm":
        pytest.importorskip("numpyro")
    if name == "board" and EXECUTABLE is None:
        pytest.skip("needs Chromium")
    words, expected = SMALLEST[name]
    if name == "study":  # its workers are started from a file
        (tmp_path / words[0]).write_text(SMALLER_STUDY, encoding="utf-8")
        words = [str(tmp_path / words[0])]
    elif words[0].endswith(".py"):
        words = [str(BENCHMARKS / words[0]), *words[1:]]
    figures = tmp_path / "figures.json"
    done = subprocess.run(
        [sys.executable, *words, *benchmarks("all").BENCHMARKS[name].json, str(figures)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=600,
        env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(BENCHMARKS)},
        check=False,
    )
    assert figures.exists(), done.stderr
    content = json.loads(figures.read_text(encoding="utf-8"))
    assert content[expected]
    assert done.stdout.rstrip().endswith(("}", "]"))  # the figures come after the table
    if name != "metrics":  # which says in its exit code whether the machine was quick enough
        assert done.returncode == 0, done.stderr


def test_each_script_has_a_name_and_each_name_a_smallest_size(benchmarks: Any) -> None:
    named = {benchmark.words[0] for benchmark in benchmarks("all").BENCHMARKS.values()}
    scripts = {path.name for path in BENCHMARKS.glob("*.py")}
    # `acceptance_rules.py` simulates statistics and draws a figure; it measures nothing.
    assert named == scripts - {"all.py", "turns.py", "participants.py", "acceptance_rules.py"}
    run_here = {benchmarks("all").BENCHMARKS[name].words[0] for name in SMALLEST}
    assert run_here == named


def test_arithmetic_of_an_update(benchmarks: Any) -> None:
    """Batch 2, one layer of 3: actor 16-3-8, critics 20-3-1; counted by hand."""
    updates = benchmarks("updates")
    actor, critic = 16 * 3 + 3 * 8, 20 * 3 + 3 * 1
    forwards = 2 * actor + 2 * 3 * critic  # target and loss of the actor; two critics, thrice
    weights = actor + 2 * critic
    inputs = 3 * 8 + 2 * (3 * 1) + 2 * critic  # to the actions through both critics
    assert updates.gflop(2, [3]) * 1e9 == pytest.approx(2 * 2 * (forwards + weights + inputs))


def test_rows_are_compared_with_peers_and_with_the_limit(benchmarks: Any) -> None:
    updates = benchmarks("updates")
    names = (updates.PEER, updates.SBX, "jaxsac", updates.PRODUCTS)
    results = {
        name: {"ms": ms, "cpu_ms": cpu}
        for name, ms, cpu in zip(names, (24, 12, 6, 3), (20, 16, 5, 4), strict=True)
    }
    updates.compare(results, [e for e in updates.ENTRIES if e.name in names], work=0.5)
    ours = results["jaxsac"]
    assert (ours["ratio"], ours["sbx_ratio"], ours["cpu_ratio"]) == (4, 2, 4)
    assert ours["of_limit"] == 0.8
    assert results[updates.PRODUCTS]["gflops"] == 125  # 0.5 GFLOP in 4 ms


def test_a_gpu_is_compared_with_the_cpu_in_the_same_turns(benchmarks: Any) -> None:
    gpu, turns = benchmarks("gpu"), benchmarks("turns")
    times = {
        device: [turns.Seconds(wall, 0.0) for wall in walls]
        for device, walls in {"cpu": (4.0, 8.0, 6.0), "cuda": (1.0, 4.0, 2.0)}.items()
    }
    row = gpu.compare(times, n_steps=120)
    assert (row["cpu"], row["cuda"], row["times"]) == (20.0, 60.0, 3.0)  # of 4, 2 and 3
    assert set(gpu.compare({"cpu": times["cpu"]}, n_steps=120)) == {"cpu"}
    assert "3.00" in gpu.table({"jaxsac 256,256,256": row})


def softmax(values: np.ndarray) -> np.ndarray:
    return np.exp(values) / np.exp(values).sum()


def one_stage(rows: list[dict], rates: dict[int, float], beta: float) -> float:
    """The loop of bandit2arm_delta.stan and prl_rp.stan, with a rate for each sign."""
    values, total = np.zeros(2), 0.0
    for row in rows:
        choice, outcome = row["choice"] - 1, row["outcome"]
        total += np.log(softmax(beta * values)[choice])
        values[choice] += rates[outcome] * (outcome - values[choice])
    return total


def two_stages(rows: list[dict], a: float, beta: float, pi: float, w: float) -> float:
    """The loop of ts_par4.stan."""
    v, total, before = np.zeros(6), 0.0, None
    for row in rows:
        first, second, reward = row["level1_choice"] - 1, row["level2_choice"] + 1, row["reward"]
        best = np.array([v[2:4].max(), v[4:6].max()])
        mixed = w * (0.7 * best + 0.3 * best[::-1]) + (1 - w) * v[:2]
        stay = np.zeros(2) if before is None else pi * np.eye(2)[before]
        total += np.log(softmax(beta * mixed + stay)[first])
        v[first] += a * (v[second] - v[first])
        start = 2 if second < 4 else 4
        total += np.log(softmax(beta * v[start : start + 2])[second - start])
        v[second] += a * (reward - v[second])
        v[first] += a * (reward - v[second])
        before = first
    return total


def test_models_of_hbayesdm_have_the_likelihoods_of_its_programs(benchmarks: Any) -> None:
    pytest.importorskip("numpyro")
    from scilab_rl.analysis.fitting.panel import make_panel
    from scilab_rl.analysis.fitting.selection import choice_probabilities

    data, rng = benchmarks("hbayesdm_data"), np.random.default_rng(0)
    names = {"choice": (1, 2), "outcome": (-1, 1), "level1_choice": (1, 2),
             "level2_choice": (1, 2, 3, 4), "reward": (0, 1)}  # fmt: skip
    drawn = [{name: int(rng.choice(of)) for name, of in names.items()} for _ in range(60)]
    one = [{"subjID": "1", "choice": r["choice"], "outcome": r["outcome"]} for r in drawn]
    two = [{"subjID": "1", **{k: r[k] for k in [*names][2:]}} for r in drawn]
    for name, rows, values, expected in (
        ("bandit2arm_delta", one, {"A": 0.3, "tau": 1.2}, one_stage(one, {1: 0.3, -1: 0.3}, 1.2)),
        (
            "prl_rp",
            one,
            {"Apun": 0.2, "Arew": 0.6, "beta": 2.0},
            one_stage(one, {1: 0.6, -1: 0.2}, 2.0),
        ),
        (
            "ts_par4",
            two,
            {"a": 0.4, "beta": 3.0, "pi": 0.5, "w": 0.7},
            two_stages(two, 0.4, 3.0, 0.5, 0.7),
        ),
    ):
        task, panel = data.TASKS[name], make_panel(rows)
        ours = {own: np.full(1, values[k] * by) for k, (own, by) in task.names.items()}
        each = choice_probabilities(task.model, panel, ours)
        chosen = np.take_along_axis(each, panel.responses[..., None], axis=2)
        assert np.log(chosen).sum() == pytest.approx(expected, rel=1e-5), name


def test_turns_go_forwards_and_backwards(benchmarks: Any) -> None:
    order: list[str] = []
    calls = {name: (lambda name=name: order.append(name) or len(order)) for name in "ab"}
    results = benchmarks("turns").take_turns(calls, 2)
    assert order == ["a", "b", "b", "a"] * 2
    assert results == {"a": [1, 4, 5, 8], "b": [2, 3, 6, 7]}


def test_ratios_are_those_of_the_same_turn(benchmarks: Any) -> None:
    compared = benchmarks("turns").relative([2.0, 40.0, 6.0], [1.0, 10.0, 2.0])
    assert compared["ratio"] == 3.0  # of 2, 4 and 3
    low, high = compared["interval"]
    assert 2.0 <= low <= 3.0 <= high <= 4.0


def test_a_benchmark_that_nobody_knows(benchmarks: Any) -> None:
    done = subprocess.run(
        [sys.executable, str(BENCHMARKS / "all.py"), "updatse"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert "there is no updatse; there is startup, updates" in done.stderr


def test_a_peer_does_as_many_updates_as_it_is_asked_for(tmp_path: Path) -> None:
    """What it prints does not get between its answers."""
    script = """
from recorded import Requests
requests = Requests()
print("noise")
requests.serve(lambda n: print("more noise") or open("asked", "a").write(f"{n} "))
"""
    done = subprocess.run(
        [sys.executable, "-c", script],
        input="2\n8\n",
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(BENCHMARKS / "peers")},
        capture_output=True,
        text=True,
        check=True,
    )
    assert (tmp_path / "asked").read_text() == "2 8 "
    assert len([float(line) for line in done.stdout.splitlines()]) == 3  # ready, and two answers


def test_peers_get_the_recorded_steps(benchmarks: Any) -> None:
    updates, recorded = benchmarks("updates"), benchmarks("recorded")
    steps = [as_added(index, over=index == 2) for index in range(4)]
    with updates.written(steps) as path:
        read = list(recorded.read_steps(str(path)))
    assert [step.over for step in read] == [False, False, True, False]
    assert [step.reward for step in read] == [-0.0, -1.0, -2.0, -3.0]
    assert [step.now["goal"].tolist() for step in read] == [[0.0], [1.0], [2.0], [3.0]]
    assert [step.following["goal"].tolist() for step in read] == [[10.0], [11.0], [12.0], [13.0]]
    assert [step.action.tolist() for step in read] == [[0.0], [0.1], [0.2], [0.3]]


def as_added(index: int, *, over: bool) -> tuple:
    now, following = ({"goal": np.array([[value]])} for value in (index, index + 10.0))
    action, infos = np.array([[index / 10]]).round(1), [{}]
    return now, following, action, np.array([-float(index)]), np.array([over]), infos


def test_the_script_of_cleanrl_waits_after_the_recorded_steps(benchmarks: Any) -> None:
    recorded, cleanrl = benchmarks("recorded"), benchmarks("cleanrl_sac")
    steps = [
        recorded.Step(
            {"goal": np.array([float(n)])}, {"goal": np.array([n + 0.5])}, np.array([n / 10]), -n,
            n == 1,
        )
        for n in range(3)
    ]  # fmt: skip
    asked = iter([2, 0])
    env = cleanrl.WaitingEnv(steps, SimpleNamespace(next=lambda: next(asked)))
    actions = [env.single_action_space.sample().item() for _ in steps]
    assert actions == [0.0, 0.1, 0.2]
    assert env.reset().item() == 0.0
    outcomes = [env.step(None) for _ in steps]
    assert [outcome[0].item() for outcome in outcomes] == [1.0, 2.0, 0.0]
    assert outcomes[1][3][0]["terminal_observation"].item() == 1.5
    assert [outcome[2].item() for outcome in outcomes] == [False, True, False]
    env.step(None)  # `learning-starts` itself; the next two are the two that were asked for
    env.step(None)
    env.step(None)
    with pytest.raises(SystemExit):
        env.step(None)


def test_the_script_of_cleanrl_takes_as_many_steps_as_it_is_asked_for(benchmarks: Any) -> None:
    """The first ones are random and for nobody; episodes follow each other."""
    cleanrl = benchmarks("cleanrl_sac")
    taken: list[float] = []

    class TwoSteps(gym.Env):
        action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

        def reset(self, **_: Any) -> tuple[dict[str, np.ndarray], dict]:
            self.n_steps = 0
            return {"observation": np.array([100.0])}, {}

        def step(self, action: np.ndarray) -> tuple[Any, ...]:
            taken.append(action.item())
            self.n_steps += 1
            return {"observation": np.array([self.n_steps])}, -1.0, False, self.n_steps == 2, {}

    asked = iter([3, 0])
    env = cleanrl.LiveEnv(TwoSteps(), SimpleNamespace(next=lambda: next(asked)))
    for number in range(cleanrl.N_RANDOM + 3):
        after, _, dones, infos = env.step(np.array([[float(number)]]))
        is_last = number % 2 == 1
        assert after.item() == (100.0 if is_last else 1.0)
        assert dones[0] == infos[0]["TimeLimit.truncated"] == is_last
        assert infos[0]["terminal_observation"].item() == (2.0 if is_last else 1.0)
    assert len(taken) == cleanrl.N_RANDOM + 3
    with pytest.raises(SystemExit):
        env.step(np.array([[0.0]]))
    assert len(taken) == cleanrl.N_RANDOM + 3
