"""Run an exported policy; NumPy is all that it needs.

    policy = Policy("DIR")
    action = policy(observation)

An observation is an array, or a dictionary of arrays with the names in ``contract.json``. The
action is in the environment's units and within its bounds. ``python run_policy.py`` checks on this
computer that the policy answers as it did where it was exported, and how long an answer takes.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

TOLERANCE = 1e-5  # of actions, as a share of half their range
_NUMBERS = {"mean", "scale", "offset", "low", "high", "columns", "values"}
_ACTIVATIONS: dict[str, Any] = {
    "none": lambda x: x,
    "relu": lambda x: np.maximum(x, 0.0),
    "tanh": np.tanh,
    "elu": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0.0))),
    "leaky_relu": lambda x: np.where(x > 0, x, np.float32(0.01) * x),
    "silu": lambda x: x / (1.0 + np.exp(-x)),
}


class Policy:
    """A policy that maps an observation to its most likely action.

    Args:
        folder: Has ``contract.json`` and ``policy.npz``; default: where this file is.
    """

    def __init__(self, folder: str | Path | None = None) -> None:
        folder = Path(__file__).parent if folder is None else Path(folder)
        self.contract: dict[str, Any] = json.loads((folder / "contract.json").read_text("utf-8"))
        with np.load(folder / "policy.npz", allow_pickle=False) as stored:
            arrays = dict(stored)
        self.entries = [_arrays_of(entry) for entry in self.contract["observation"]]
        self.normalization = _arrays_of(self.contract["normalization"] or {})
        self.layers = [
            (arrays[f"weight{i}"], arrays[f"bias{i}"], _ACTIVATIONS[layer["activation"]])
            for i, layer in enumerate(self.contract["layers"])
        ]
        self.action = _arrays_of(self.contract["action"])
        self.samples = {k: v for k, v in arrays.items() if k.startswith("check.")}

    def __call__(self, observation: Any) -> Any:
        """Return the action for one observation.

        Raises:
            ValueError: If the observation breaks the contract, or a number is not finite.
        """
        return self.choose(self.outputs(self.vector(observation)))

    def vector(self, observation: Any) -> np.ndarray:
        """Return what the network reads. Shapes: ``(n_inputs,)``."""
        parts = [self._part(entry, observation) for entry in self.entries]
        return _normalized(np.concatenate(parts), self.normalization)

    def outputs(self, vector: np.ndarray) -> np.ndarray:
        """Return what the network says. Shapes: ``(n_outputs,)``."""
        for weight, bias, activation in self.layers:
            vector = activation(vector @ weight + bias)
        return vector

    def choose(self, outputs: np.ndarray) -> Any:
        """Return the action that outputs stand for."""
        if (action := self.action)["kind"] == "discrete":
            return int(outputs.argmax()) + action["start"]
        scaled = action["offset"] + action["scale"] * outputs
        bounded = np.clip(scaled, action["low"], action["high"])
        return bounded.astype(action["dtype"]).reshape(action["shape"])

    def _part(self, entry: dict[str, Any], observation: Any) -> np.ndarray:
        """Return one entry as the numbers of its inputs."""
        name, value = entry["name"], observation
        if name is not None:
            if name not in observation:
                raise ValueError(f"the observation has no entry '{name}'")
            value = observation[name]
        values = np.asarray(value)
        if values.shape != tuple(entry["shape"]):
            raise ValueError(f"{name or 'observation'} has shape {values.shape}, "
                             f"but the policy needs {tuple(entry['shape'])}")  # fmt: skip
        values = values.reshape(-1)
        if entry["one_hot"] is not None:
            hot = values[entry["one_hot"]["columns"]] == entry["one_hot"]["values"]
            if hot.sum() != len(values):
                raise ValueError(f"{name or 'observation'} is {values}, which is not a choice")
            return hot.astype(np.float32)
        if not np.isfinite(values).all():
            raise ValueError(f"{name or 'observation'} is not finite: {values}")
        return _normalized(values, entry["normalization"] or {})


def _normalized(values: np.ndarray, by: dict[str, Any]) -> np.ndarray:
    if by:
        values = ((values - by["mean"]) / by["scale"]).clip(-by["limit"], by["limit"])
    return values.astype(np.float32)


def _arrays_of(value: Any) -> Any:
    """Turn the lists of numbers of a contract into arrays; null is an infinite bound."""
    if not isinstance(value, dict):
        return value
    found = {key: _arrays_of(entry) for key, entry in value.items()}
    for key in _NUMBERS & found.keys():
        infinite = -np.inf if key == "low" else np.inf
        found[key] = np.array([infinite if number is None else number for number in found[key]])
    return found


def check(policy: Policy) -> tuple[float, float]:
    """Return the largest difference from the stored actions, and seconds per answer."""
    actions, answers, seconds = policy.samples["check.action"], [], np.inf
    for index in range(len(actions)):
        entries = enumerate(policy.entries)
        one = {entry["name"]: policy.samples[f"check.{i}"][index] for i, entry in entries}
        begin = time.perf_counter()
        answers.append(policy(one.get(None, one)))
        seconds = min(seconds, time.perf_counter() - begin)
    return difference(policy, np.array(answers), actions), float(seconds)


def difference(policy: Policy, actions: np.ndarray, others: np.ndarray) -> float:
    """Return the largest difference between actions, as a share of half the action's range."""
    gaps = np.abs(np.asarray(actions, float) - others).reshape(len(others), -1)
    if policy.action["kind"] == "continuous":
        half = (policy.action["high"] - policy.action["low"]) / 2
        gaps = gaps / np.where(np.isfinite(half) & (half > 0), half, 1.0)
    return float(gaps.max(initial=0.0))


def main() -> int:
    """Check the policy next to this file."""
    largest, seconds = check(Policy())
    verdict = "as exported" if largest <= TOLERANCE else "NOT AS EXPORTED: do not use it here"
    sys.stdout.write(f"largest difference {largest:.1e}, {verdict}; {seconds * 1e3:.3f} ms\n")
    return int(largest > TOLERANCE)


if __name__ == "__main__":
    sys.exit(main())
