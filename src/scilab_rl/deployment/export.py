"""Writing a policy for a robot, and measuring that it still acts as the agent does."""

from __future__ import annotations

import json
import logging
import os
import shutil
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from scilab_rl import files
from scilab_rl.canonical_spaces import conversions
from scilab_rl.config.recorded import load_recorded
from scilab_rl.deployment import run_policy
from scilab_rl.deployment.description import Entry, Normalization, PolicyDescription, describe
from scilab_rl.deployment.onnx_graph import ACTION, ONLY_ENTRY, write_onnx
from scilab_rl.deployment.run_policy import TOLERANCE, Policy
from scilab_rl.envs.units import control_frequency, units_of
from scilab_rl.envs.vectorize import observed_layer
from scilab_rl.errors import ConfigError, MissingDependencyError, ScilabRLError
from scilab_rl.learning.inspector import observation_functions
from scilab_rl.run.directory import CONFIG_FILE, RunDirectory
from scilab_rl.run.player import load_player
from scilab_rl.run.provenance import fingerprint_of, recorded_fingerprint
from scilab_rl.seeding import derive_seed

if TYPE_CHECKING:
    from scilab_rl.config.schema import RunConfig
    from scilab_rl.envs.vec_step import ObservedStep
    from scilab_rl.learning.algorithm import Algorithm

FORMAT = 1
CONTRACT_FILE, ARRAYS_FILE, PARITY_FILE = "contract.json", "policy.npz", "parity.json"
ONNX_FILE, RUNTIME_FILE = "policy.onnx", "run_policy.py"
N_OBSERVATIONS = 10_000
_N_SAMPLES = 20  # in policy.npz, for the check on the robot
_N_COPIES = 3  # of each visited observation, with noise
# Where two actions are valued nearly the same, another processor may choose the other.
_CLEAR_MARGIN = 1e-3
_BATCH = 1000
_PACKAGES = (
    "scilab-rl", "numpy", "torch", "stable-baselines3", "sb3-contrib", "jax", "gymnasium",
    "gymnasium-robotics", "mujoco", "onnx",
)  # fmt: skip
_log = logging.getLogger(__name__)

Observations = dict[str | None, np.ndarray]  # by the entries' names


@dataclass
class _Seen:
    """Collects what the environment shows: an observer of steps."""

    observations: list[Any] = field(default_factory=list)

    def on_step(self, step: ObservedStep) -> None:
        self.observations.append(step.observations)


def write_policy(
    run: RunDirectory, saved: Path, folder: Path, *, n_observations: int = N_OBSERVATIONS
) -> dict[str, Any]:
    """Write a policy with its runtime, its contract and its parity report.

    The folder appears when it is complete and its actions agree with the agent's; an older export
    in its place is replaced.

    Args:
        run: The run or trained agent.
        saved: Its saved policy.
        folder: Where to.
        n_observations: For how many observations actions are compared.

    Returns:
        The parity report.

    Raises:
        ConfigError: If the policy cannot be exported, or the folder holds something else.
        ScilabRLError: If the written policy acts differently.
    """
    folder = folder.absolute()
    _check_folder(folder)
    cfg = load_recorded(run / CONFIG_FILE)
    env, model = load_player(cfg, saved, record=False)
    folder.parent.mkdir(parents=True, exist_ok=True)
    unfinished = folder.with_name(f".{folder.name}.{os.getpid()}.tmp")
    unfinished.mkdir()
    try:
        description = describe(model)
        observations = draw_observations(model, description, n_observations, int(cfg.seed))
        contract = _contract(run, cfg, saved, description, model)
        report = write_files(unfinished, model, description, observations, contract)
        if folder.exists():
            files.discard(folder)
        unfinished.rename(folder)
    finally:
        env.close()
        shutil.rmtree(unfinished, ignore_errors=True)
    return report


def write_files(
    folder: Path,
    model: Algorithm,
    description: PolicyDescription,
    observations: Observations,
    contract: dict[str, Any],
) -> dict[str, Any]:
    """Write all files of an export, and return the parity report.

    Raises:
        ScilabRLError: If the written policy acts differently.
    """
    shutil.copyfile(run_policy.__file__, folder / RUNTIME_FILE)
    files.write_json(folder / CONTRACT_FILE, contract | describe_numbers(description))
    expected = own_actions(model, observations)
    arrays: dict[str, np.ndarray] = {}
    for index, layer in enumerate(description.layers):
        arrays |= {f"weight{index}": layer.weight, f"bias{index}": layer.bias}
    _write_arrays(folder, arrays)
    about = {"contract": (folder / CONTRACT_FILE).read_text(encoding="utf-8")}
    try:
        write_onnx(description, folder / ONNX_FILE, about)
    except MissingDependencyError as error:
        _log.warning("%s is left out: %s", ONNX_FILE, error)
    report = compare(folder, observations, expected)
    files.write_json(folder / PARITY_FILE, report)
    for name in ("numpy", "onnx"):
        largest = report[name]
        if largest is not None and not largest <= TOLERANCE:
            raise ScilabRLError(
                f"The exported policy would act differently from the agent ({name}): by up to "
                f"{largest:.2g} of half the action range, and {TOLERANCE:g} is allowed; it was not "
                "written."
            )
    samples = _samples(Policy(folder), observations, expected)
    _write_arrays(folder, arrays | samples)
    return report


def compare(folder: Path, observations: Observations, expected: np.ndarray) -> dict[str, Any]:
    """Compare the actions of an exported policy with the agent's own.

    Args:
        folder: Of the export.
        observations: By the entries' names.
        expected: The agent's actions, in the environment's units. Shapes: ``(n, ...)``.

    Returns:
        ``numpy`` and ``onnx``: the largest differences, as a share of half the action's range; of
        discrete actions by how much the network's output for our action exceeds that for the
        agent's. ``onnx`` is None where it was not written or ``onnxruntime`` is not installed.
    """
    policy = Policy(folder)
    outputs = np.array([policy.outputs(policy.vector(one)) for one in _singles(observations)])
    actions = np.array([policy.choose(output) for output in outputs])
    report: dict[str, Any] = {
        "observations": len(expected),
        "tolerance": TOLERANCE,
        "numpy": _difference(policy, outputs, actions, expected),
        "onnx": None,
    }
    if (folder / ONNX_FILE).is_file() and find_spec("onnxruntime"):
        actions = run_onnx(folder / ONNX_FILE, observations)
        report["onnx"] = _difference(policy, outputs, actions, expected)
    report["milliseconds"] = round(1e3 * _seconds(policy, observations), 4)
    return report


def run_onnx(path: Path, observations: Observations) -> np.ndarray:
    """Return the actions of an ONNX graph. Shapes: ``(n, ...)``."""
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    kinds = {"tensor(float)": np.float32, "tensor(double)": np.float64, "tensor(int64)": np.int64}
    given = {node.name: kinds[node.type] for node in session.get_inputs()}
    entries = {name or ONLY_ENTRY: values for name, values in observations.items()}
    feed = {name: entries[name].astype(kind) for name, kind in given.items()}
    return session.run([ACTION], feed)[0]


def own_actions(model: Algorithm, observations: Observations) -> np.ndarray:
    """Return the agent's most likely actions, in the environment's units. Shapes: ``(n, ...)``."""
    env = model.get_env()
    functions, to_env = observation_functions(env), conversions(env)[0].to_env
    actions = []
    for begin in range(0, len(next(iter(observations.values()))), _BATCH):
        part = {name: values[begin : begin + _BATCH] for name, values in observations.items()}
        batch: Any = part.get(None, part)
        for function in functions:
            batch = function(batch)
        actions.append(np.asarray(to_env(model.predict(batch, deterministic=True)[0])))
    return np.concatenate(actions)


def draw_observations(
    model: Algorithm, description: PolicyDescription, n: int, seed: int
) -> Observations:
    """Return observations of all kinds: visited by the policy and by chance, and with noise.

    Every second action is random. Three copies of each visited observation have noise with the
    entry's deviation, so that many lie where the policy has never been.

    Shapes:
        result: ``(n, ...)`` per entry.
    """
    env, seen = model.get_env(), _Seen()
    rng = np.random.default_rng(derive_seed(seed, "parity"))
    observed_layer(env).observers.append(seen)
    env.seed(derive_seed(seed, "parity"))
    env.action_space.seed(derive_seed(seed, "parity"))
    current = env.reset()
    for step in range(-(-n // (1 + _N_COPIES))):
        action, _ = model.predict(current, deterministic=True)
        if step % 2:
            action = np.array([env.action_space.sample()])
        current = env.step(action)[0]
    observed_layer(env).observers.remove(seen)
    found: Observations = {}
    for entry in description.entries:
        rows = [row if entry.name is None else row[entry.name] for row in seen.observations]
        visited = np.concatenate(rows)
        copies = [visited] + [_with_noise(entry, visited, rng) for _ in range(_N_COPIES)]
        found[entry.name] = np.concatenate(copies)[:n]
    return found


def _with_noise(entry: Entry, visited: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    if visited.dtype.kind != "f":
        return visited
    noise = rng.standard_normal(visited.shape) * visited.std(axis=0)
    return (visited + noise).astype(visited.dtype)


def _singles(observations: Observations) -> list[Any]:
    """Return observations one by one, as an environment gives them."""
    columns = list(observations.values())
    if None in observations:
        return list(columns[0])
    return [dict(zip(observations, row, strict=True)) for row in zip(*columns, strict=True)]


def _difference(
    policy: Policy, outputs: np.ndarray, actions: np.ndarray, expected: np.ndarray
) -> float:
    if policy.action["kind"] == "continuous":
        return run_policy.difference(policy, actions, expected)
    rows, start = np.arange(len(outputs)), policy.action["start"]
    return float(np.max(outputs[rows, actions - start] - outputs[rows, expected - start]))


def _seconds(policy: Policy, observations: Observations) -> float:
    """Return the median time of an answer, measured by 200 observations."""
    seconds = []
    for one in _singles({name: values[:200] for name, values in observations.items()}):
        begin = time.perf_counter()
        policy(one)
        seconds.append(time.perf_counter() - begin)
    return float(np.median(seconds))


def _samples(
    policy: Policy, observations: Observations, expected: np.ndarray
) -> dict[str, np.ndarray]:
    """Return a few observations with the agent's actions, for the check on the robot."""
    singles = _singles(observations)
    chosen = [i for i in range(len(singles)) if _is_clear(policy, singles[i])][:_N_SAMPLES]
    entries = {f"check.{i}": values[chosen] for i, values in enumerate(observations.values())}
    return entries | {"check.action": expected[chosen]}


def _is_clear(policy: Policy, observation: Any) -> bool:
    if policy.action["kind"] == "continuous":
        return True
    outputs = np.sort(policy.outputs(policy.vector(observation)))
    return bool(np.diff(outputs[-2:]).min(initial=np.inf) > _CLEAR_MARGIN)


def _write_arrays(folder: Path, arrays: Mapping[str, np.ndarray]) -> None:
    files.atomic_write(folder / ARRAYS_FILE, lambda file: np.savez(file, **arrays))  # type: ignore[arg-type]


def _contract(
    run: RunDirectory, cfg: RunConfig, saved: Path, description: PolicyDescription, model: Algorithm
) -> dict[str, Any]:
    """Return what a robot must know next to the numbers."""
    env = model.get_env().envs[0]  # type: ignore[attr-defined]
    units, wrappers = units_of(env), [_name_of(wrapper) for wrapper in cfg.wrappers]
    if wrappers:
        _log.warning(
            "The policy reads what %s makes of the observations; the robot must do the same.",
            " and ".join(wrappers),
        )
    fingerprint, recorded = fingerprint_of(env), recorded_fingerprint(run)
    if recorded not in (None, fingerprint):
        _log.warning(
            "%s behaves differently from when the run was trained (fingerprint %s, was %s).",
            cfg.env, fingerprint, recorded,
        )  # fmt: skip
    return {
        "format": FORMAT,
        "policy": {"of": run.path.name, "saved": saved.name.removeprefix("rl_model_")},
        "algorithm": cfg.algorithm.name,
        "env": cfg.env,
        "env_kwargs": dict(cfg.env_kwargs),
        "wrappers": wrappers,
        "fingerprint": fingerprint,
        "control_frequency_hz": control_frequency(env),
        "units": {
            name: units.get(name)
            for name in (*(e.name or ONLY_ENTRY for e in description.entries), ACTION)
        },
        "versions": _versions(),
    }


def _name_of(wrapper: object) -> str:
    return str(wrapper["_target_"] if isinstance(wrapper, Mapping) else wrapper).rpartition(".")[2]


def describe_numbers(description: PolicyDescription) -> dict[str, Any]:
    """Return the part of a contract that the runtime reads: entries, layers, action."""
    positions = np.cumsum([0, *(entry.n_inputs for entry in description.entries)]).tolist()
    return {
        "observation": [
            _entry(entry, positions[i : i + 2]) for i, entry in enumerate(description.entries)
        ],
        "normalization": _numbers(description.normalization),
        "layers": [
            {
                "inputs": len(layer.weight),
                "outputs": len(layer.bias),
                "activation": layer.activation,
            }
            for layer in description.layers
        ],
        "action": _action(description),
    }


def _entry(entry: Entry, inputs: list[int]) -> dict[str, Any]:
    space = entry.space
    one_hot = None
    if entry.columns is not None and entry.values is not None:
        one_hot = {"columns": entry.columns.tolist(), "values": entry.values.tolist()}
    return {
        "name": entry.name,
        "shape": list(space.shape or ()),
        "dtype": str(space.dtype),
        "inputs": inputs,
        **(_bounds(space) if isinstance(space, spaces.Box) else {}),
        "one_hot": one_hot,
        "normalization": _numbers(entry.normalization),
    }


def _action(description: PolicyDescription) -> dict[str, Any]:
    output = description.output
    space = output.space
    if isinstance(space, spaces.Discrete):
        return {"kind": "discrete", "n": int(space.n), "start": int(space.start)}
    assert isinstance(space, spaces.Box)
    return {
        "kind": "continuous",
        "shape": list(space.shape),
        "dtype": str(space.dtype),
        "scale": output.scale.tolist(),
        "offset": output.offset.tolist(),
        **_bounds(space),
    }


def _bounds(space: spaces.Box) -> dict[str, list[float | None]]:
    """Return the bounds; null where there is none, since JSON has no infinity."""
    return {
        name: [float(v) if np.isfinite(v) else None for v in bound.ravel()]
        for name, bound in (("low", space.low), ("high", space.high))
    }


def _numbers(normalization: Normalization | None) -> dict[str, Any] | None:
    if normalization is None:
        return None
    return {
        "mean": normalization.mean.tolist(),
        "scale": normalization.scale.tolist(),
        "limit": normalization.limit,
    }


def _versions() -> dict[str, str]:
    installed = {d.name.lower().replace("_", "-"): d.version for d in metadata.distributions()}
    return {name: installed[name] for name in _PACKAGES if name in installed}


def _check_folder(folder: Path) -> None:
    """Reject a folder that holds anything but an export."""
    if not folder.exists():
        return
    try:
        contract = json.loads((folder / CONTRACT_FILE).read_text(encoding="utf-8"))
        is_ours = "layers" in contract
    except (OSError, ValueError):
        is_ours = folder.is_dir() and not any(folder.iterdir())
    if not is_ours:
        raise ConfigError(f"'{folder}' holds something other than a policy; choose a new folder.")
