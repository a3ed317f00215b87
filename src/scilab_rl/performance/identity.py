"""What makes a run what it is: its configuration without what does not change what it learns."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

_FREE_KEYS = (
    "seed", "base_logdir", "info", "mlflow", "wandb", "tensorboard", "project_name", "entity",
    "group", "tags", "tracking", "render", "render_freq", "render_metrics_train",
    "render_metrics_test", "render_frames_per_clip", "record_when", "viewer_host",
    "save_model_freq", "device", "n_threads", "warn_after_seconds",
)  # fmt: skip


def identity_of(config: Any) -> dict[str, str]:
    """Return a configuration as one level of keys to texts, without names, places and looks.

    Args:
        config: Plain dictionaries and lists.

    >>> identity_of({"seed": 3, "algorithm": {"gamma": 0.9}})
    {'algorithm.gamma': '0.9'}
    """
    return {k: v for k, v in _flat(config, "") if k.partition(".")[0] not in _FREE_KEYS}


def _flat(value: Any, prefix: str) -> Iterable[tuple[str, str]]:
    if isinstance(value, dict):
        for key, entry in value.items():
            yield from _flat(entry, f"{prefix}.{key}" if prefix else str(key))
    else:
        yield prefix, json.dumps(value)
