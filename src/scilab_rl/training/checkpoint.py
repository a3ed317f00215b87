"""Saving snapshots so that a damaged one is noticed before anything is loaded from it.

A saved directory holds ``tensors.safetensors``, ``arrays/*.npy``, ``state.json`` and, written last,
``manifest.json`` with the size and the SHA-256 of each. No pickle is read or written.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from scilab_rl import files
from scilab_rl.errors import CheckpointError, ConfigError
from scilab_rl.training.snapshot import Snapshot

SCHEMA_VERSION = 1
MANIFEST = "manifest.json"
_TENSORS, _STATE, _ARRAYS = "tensors.safetensors", "state.json", "arrays"
# Errors of reading JSON that others wrote.
_MALFORMED = (ValueError, KeyError, AttributeError, TypeError, RecursionError)
_VERSIONED = ("torch", "numpy", "gymnasium", "stable-baselines3", "mujoco")


def save(
    snapshot: Snapshot, directory: Path, *, step: int, about: dict[str, object] | None = None
) -> None:
    """Write a snapshot; an existing one of the same name is replaced only by a complete one.

    Args:
        snapshot: What to save.
        directory: For example ``<run>/rl_model_best``.
        step: Environment steps so far, for the manifest.
        about: More facts for the manifest.
    """
    files.remove_unfinished(directory.parent)
    files.fault_point("checkpoint.begin")
    unfinished = directory.with_name(f".{directory.name}.{os.getpid()}.tmp")
    (unfinished / _ARRAYS).mkdir(parents=True)
    try:
        _write_content(snapshot, unfinished)
        files.fault_point("checkpoint.before_manifest")
        _write_manifest(unfinished, step, about or {})
        files.fault_point("checkpoint.before_swap")
        _swap(unfinished, directory)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def load(directory: Path) -> Snapshot:
    """Read a snapshot after checking that it is whole.

    Raises:
        CheckpointError: If a file is missing, cut, changed or of another schema.
    """
    directory = _present(directory)
    listed = verify(directory)["files"]
    try:
        stored = json.loads((directory / _STATE).read_text(encoding="utf-8"))
        arrays = {}
        for name, file in stored["arrays"].items():
            if f"{_ARRAYS}/{file}" not in listed:
                raise ValueError(f"its manifest does not list {file}")
            array = np.load(directory / _ARRAYS / file, mmap_mode="r", allow_pickle=False)
            if not isinstance(array, np.ndarray):  # an archive of arrays
                raise ValueError(f"{file} is not an array")
            arrays[name] = array
        return Snapshot(stored["tree"], load_file(directory / _TENSORS), arrays)
    except (OSError, *_MALFORMED, SafetensorError) as error:
        raise CheckpointError(f"'{directory}' cannot be read: {error}") from error


def saved_step(directory: Path) -> int | None:
    """Return after how many environment steps something was saved; None where it is not known."""
    try:
        manifest = json.loads((directory / MANIFEST).read_text(encoding="utf-8"))
        return int(manifest["step"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def verify(directory: Path) -> dict[str, Any]:
    """Return the manifest of a saved directory after comparing every file with it.

    Raises:
        CheckpointError: If it does not hold.
    """
    if not directory.is_dir():
        raise ConfigError(f"There is no saved policy in '{directory}'.")
    try:
        manifest = json.loads((directory / MANIFEST).read_text(encoding="utf-8"))
        entries = [
            (name, fact["bytes"], fact["sha256"]) for name, fact in manifest["files"].items()
        ]
        schema = manifest["schema_version"]
    except (OSError, *_MALFORMED) as error:
        raise CheckpointError(f"'{directory}' is not a complete checkpoint: {error}") from error
    if schema != SCHEMA_VERSION:
        raise CheckpointError(
            f"'{directory}' has format {schema}; this version of Scilab-RL reads {SCHEMA_VERSION}."
        )
    for name, n_bytes, digest in entries:
        path = directory / name
        if not path.resolve().is_relative_to(directory.resolve()) or not path.is_file():
            raise CheckpointError(f"'{directory}' is damaged: {name} is missing.")
        if path.stat().st_size != n_bytes or files.sha256(path) != digest:
            raise CheckpointError(
                f"'{directory}' is damaged: {name} has changed since it was saved."
            )
    if {_TENSORS, _STATE} - set(manifest["files"]):
        raise CheckpointError(f"'{directory}' is damaged: its manifest lists no state.")
    return manifest


def _previous(directory: Path) -> Path:
    return directory.with_name(f"{directory.name}.old")


def _present(directory: Path) -> Path:
    """Return the directory, or the older state of a process killed while it replaced this one."""
    previous = _previous(directory)
    return previous if not directory.exists() and previous.is_dir() else directory


def _write_content(snapshot: Snapshot, directory: Path) -> None:
    tensors = {
        name: tensor.detach().cpu().contiguous().clone()
        for name, tensor in snapshot.tensors.items()
    }
    try:
        save_file(tensors, directory / _TENSORS)
    except SafetensorError as error:  # its word for a full disk
        raise OSError(str(error)) from error
    files.fault_point("checkpoint.after_tensors")
    with (directory / _TENSORS).open("rb") as file:
        os.fsync(file.fileno())
    names = {}
    for index, (name, array) in enumerate(snapshot.arrays.items()):
        names[name] = f"{index}.npy"
        with (directory / _ARRAYS / names[name]).open("wb") as file:
            np.save(file, array, allow_pickle=False)
            files.fault_point("checkpoint.in_arrays")
            file.flush()
            os.fsync(file.fileno())
    files.write_json(directory / _STATE, {"arrays": names, "tree": snapshot.tree})


def _write_manifest(directory: Path, step: int, about: dict[str, object]) -> None:
    contents = sorted(path for path in directory.rglob("*") if path.is_file())
    files.write_json(
        directory / MANIFEST,
        {
            "schema_version": SCHEMA_VERSION,
            "step": step,
            **about,
            "versions": versions(),
            "files": {
                str(path.relative_to(directory)): {
                    "bytes": path.stat().st_size,
                    "sha256": files.sha256(path),
                }
                for path in contents
            },
        },
    )


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that results depend on."""
    installed = {"python": platform.python_version()}
    for package in _VERSIONED:
        try:
            installed[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return installed


def _swap(finished: Path, directory: Path) -> None:
    """Put the finished directory in its place; a directory cannot replace a full one in one step.

    Between the two renames the older state lies under ``<name>.old``, where `load` finds it.
    """
    previous = _previous(directory)
    if directory.exists():
        files.discard(previous)
        directory.rename(previous)
    files.fault_point("checkpoint.in_swap")
    finished.rename(directory)
    files.fsync_directory(directory.parent)
    files.discard(previous)
