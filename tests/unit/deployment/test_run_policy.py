"""The runtime that is copied to robots, with numbers computed by hand, and what it refuses."""

from __future__ import annotations

import ast
import json
from pathlib import Path

import numpy as np
import pytest

from scilab_rl.deployment import run_policy
from scilab_rl.deployment.run_policy import Policy, check, difference

PLACE = {"name": "place", "shape": [2], "one_hot": None,
         "normalization": {"mean": [1.0, 0.0], "scale": [0.5, 2.0], "limit": 3.0}}  # fmt: skip
TOOL = {"name": "tool", "shape": [], "normalization": None,
        "one_hot": {"columns": [0, 0], "values": [4, 5]}}  # fmt: skip
ARM = {"kind": "continuous", "shape": [1, 2], "dtype": "float32", "scale": [2.0, 1.0],
       "offset": [1.0, 0.0], "low": [-1.0, None], "high": [3.0, 0.5]}  # fmt: skip


def export(folder, *, entries=(PLACE, TOOL), action=ARM, activation="relu", normalization=None):
    """Write a policy of one layer by hand: the first output sums all inputs, the second is -x0."""
    n_inputs = sum(2 for _ in entries)
    weight = np.zeros((n_inputs, 2), np.float32)
    weight[:, 0], weight[0, 1] = 1.0, -1.0
    contract = {"observation": list(entries), "normalization": normalization, "action": action,
                "layers": [{"activation": activation}]}  # fmt: skip
    (folder / "contract.json").write_text(json.dumps(contract))
    samples = {f"check.{i}": np.zeros((1, *e["shape"])) + 4 for i, e in enumerate(entries)}
    np.savez(folder / "policy.npz", weight0=weight, bias0=np.array([0.0, 0.25], np.float32),
             **samples, **{"check.action": np.zeros((1, 1, 2))})  # fmt: skip
    return Policy(folder)


def test_it_has_at_most_150_lines_and_needs_only_numpy() -> None:
    source = Path(run_policy.__file__).read_text(encoding="utf-8")
    assert len(source.splitlines()) <= 150
    imported = {
        alias.name.partition(".")[0] if isinstance(node, ast.Import) else node.module
        for node in ast.walk(ast.parse(source))
        if isinstance(node, (ast.Import, ast.ImportFrom))
        for alias in node.names
    }
    assert imported == {"__future__", "json", "numpy", "pathlib", "sys", "time", "typing"}


def test_each_step_of_an_answer_is_as_computed_by_hand(tmp_path) -> None:
    policy = export(tmp_path)
    one = {"place": [1.5, -8.0], "tool": 5, "more": 0}
    # (1.5 - 1) / 0.5 = 1; -8 / 2 = -4, cut off at -3; the tool is the second of its two.
    assert policy.vector(one).tolist() == [1.0, -3.0, 0.0, 1.0]
    assert policy.vector(one).dtype == np.float32
    # 1 - 3 + 0 + 1 = -1 -> 0;  0.25 - 1 = -0.75 -> 0
    assert policy.outputs(policy.vector(one)).tolist() == [0.0, 0.0]
    action = policy(one)
    assert action.tolist() == [[1.0, 0.0]] and action.dtype == np.float32  # 1 + 2 * 0, 0 + 1 * 0
    # place: -2 and 3, so that the outputs are 2 and 2.25: 1 + 2 * 2 is above 3, 2.25 above 0.5
    assert policy({"place": [0.0, 99.0], "tool": 4}).tolist() == [[3.0, 0.5]]


def test_an_array_is_an_observation_and_its_sum_is_normalized(tmp_path) -> None:
    only = {**PLACE, "name": None, "normalization": None}
    by = {"mean": [1.0, 1.0], "scale": [2.0, 4.0], "limit": 9.0}
    action = {"kind": "discrete", "n": 2, "start": 3}
    policy = export(tmp_path, entries=[only], action=action, normalization=by)
    assert policy.vector([5.0, -7.0]).tolist() == [2.0, -2.0]
    assert policy([5.0, -7.0]) == 3  # outputs 0 and 0 (of -1.75): the first of the largest
    assert policy([-7.0, -7.0]) == 4  # -6 -> 0, and 4.25


@pytest.mark.parametrize(
    ("activation", "expected"),
    [
        ("none", [-1.0, 2.0]),
        ("relu", [0.0, 2.0]),
        ("tanh", np.tanh([-1.0, 2.0])),
        ("elu", [np.exp(-1) - 1, 2.0]),
        ("leaky_relu", [-0.01, 2.0]),
        ("silu", [-1 / (1 + np.e), 2 / (1 + np.exp(-2))]),
    ],
)
def test_activations(activation, expected) -> None:
    values = np.array([-1.0, 2.0], np.float32)
    assert run_policy._ACTIVATIONS[activation](values) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        ({"place": [0, 0]}, "no entry 'tool'"),
        ({"place": [0, 0, 0], "tool": 4}, r"place has shape \(3,\), but the policy needs \(2,\)"),
        ({"place": [0, np.nan], "tool": 4}, "place is not finite"),
        ({"place": [0, 0], "tool": 6}, r"tool is \[6\], which is not a choice"),
    ],
)
def test_an_observation_that_breaks_the_contract_gets_no_action(
    tmp_path, observation, message
) -> None:
    with pytest.raises(ValueError, match=message):
        export(tmp_path)(observation)


def test_differences_are_shares_of_half_the_range(tmp_path) -> None:
    policy = export(tmp_path)
    # From -1 to 3: half is 2. The other dimension has no lower bound: as it is.
    assert difference(policy, np.array([[[1.0, 0.0]]]), np.array([[[0.0, 0.25]]])) == 0.5
    assert difference(policy, np.array([[[1.0, 0.4]]]), np.array([[[1.0, 0.3]]])) == (
        pytest.approx(0.1)
    )


def test_the_check_on_the_robot_finds_another_answer(tmp_path, monkeypatch, capsys) -> None:
    policy = export(tmp_path)
    # place (6 -> 3, 2) and tool (1, 0): 6 -> 13, cut off at 3; -2.75 -> 0. The stored action is 0.
    largest, seconds = check(policy)
    assert largest == 1.5 and 0 < seconds < np.inf
    monkeypatch.setattr(run_policy, "Policy", lambda: policy)
    assert run_policy.main() == 1
    assert "NOT AS EXPORTED" in capsys.readouterr().out
    policy.samples["check.action"][:] = [[3.0, 0.0]]
    assert run_policy.main() == 0
    assert "largest difference 0.0e+00, as exported" in capsys.readouterr().out
