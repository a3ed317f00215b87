"""Weights & Biases: only on request, offline without a key, and never with a question."""

from __future__ import annotations

import logging
import netrc
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from scilab_rl.results import RunResult
from scilab_rl.tracking.base import RunInfo, Tracker

_log = logging.getLogger(__name__)


class WandbTracker(Tracker):
    """Writes each epoch as one row.

    Args:
        mode: ``auto`` (online with a key, else offline), ``online`` or ``offline``.
    """

    def __init__(self, mode: str = "auto") -> None:
        self.mode = mode
        self._run: Any = None

    def begin(self, run: RunInfo) -> None:
        """Open the run."""
        os.environ.setdefault("WANDB_ERROR_REPORTING", "false")
        os.environ.setdefault("WANDB_SILENT", "true")
        import wandb

        mode = self.mode if self.mode != "auto" else ("online" if has_key() else "offline")
        self._run = wandb.init(
            project=run.project or "scilab-rl",
            entity=run.entity,
            group=run.group,
            tags=list(run.tags) or None,
            notes=run.notes or None,
            name=run.name,
            id=run.name,
            resume="allow",
            dir=str(run.run_dir),
            config=dict(run.parameters),
            mode=mode,  # type: ignore[arg-type]
        )

    def epoch(self, step: int, epoch: int, values: Mapping[str, float]) -> None:
        """Write the metrics of an epoch."""
        self._run.log(dict(values), step=step)

    def artifact(self, path: Path) -> None:
        """Add a video to the run's page."""
        import wandb

        if path.suffix == ".mp4":
            self._run.log({f"video/{path.stem}": wandb.Video(str(path), format="mp4")})
        else:
            self._run.save(str(path), base_path=str(path.parent), policy="now")

    def end(self, result: RunResult) -> None:
        """Close the run and say how to upload an offline one."""
        self._run.finish(exit_code=1 if result.status == "failed" else 0)
        if self._run.offline:
            _log.info("W&B is offline; sync with: wandb sync %s", Path(self._run.dir).parent)


def has_key() -> bool:
    """Tell whether a key is known, from the environment or ``~/.netrc``."""
    if os.environ.get("WANDB_API_KEY"):
        return True
    try:
        return netrc.netrc().authenticators("api.wandb.ai") is not None
    except (OSError, netrc.NetrcParseError):
        return False
