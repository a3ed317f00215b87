"""Weights & Biases: only on request, offline without a key, and never with a question."""

from __future__ import annotations

import logging
import netrc
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from scilab_rl import telemetry
from scilab_rl.errors import first_line
from scilab_rl.results import RunResult
from scilab_rl.tracking.base import TrackedRun, Tracker
from scilab_rl.tracking.names import encoded

_PATIENCE_SECONDS = 10.0
_RESERVED = re.compile(r"^_(?=(?:step|runtime|timestamp|wandb)$)")  # columns of its own
_log = logging.getLogger(__name__)


class WandbTracker(Tracker):
    """Writes each epoch as one row.

    Args:
        mode: ``auto`` (online with a key, else offline), ``online`` or ``offline``.
    """

    def __init__(self, mode: str = "auto") -> None:
        self.mode = mode
        self._run: Any = None

    def begin(self, run: TrackedRun) -> None:
        """Open the run."""
        telemetry.switch_off()
        os.environ.setdefault("WANDB_SILENT", "true")
        # Not in the home directory: a run leaves its traces among the runs and nowhere else.
        for folder in ("WANDB_CACHE_DIR", "WANDB_DATA_DIR"):
            os.environ.setdefault(folder, str(run.base_logdir.resolve() / ".wandb"))
        import wandb

        mode = self.mode if self.mode != "auto" else ("online" if has_key() else "offline")
        try:
            self._run = _open(run, mode)
        except wandb.Error as error:
            if mode == "offline":
                raise
            _log.warning("W&B cannot be reached (%s); the run is kept offline.", first_line(error))
            wandb.teardown()  # its service still holds the name of the run
            self._run = _open(run, "offline")

    def epoch(self, step: int, epoch: int, values: Mapping[str, float]) -> None:
        """Write the metrics of an epoch."""
        named = {encoded(name, _RESERVED): value for name, value in values.items()}
        self._run.log(named, step=step)

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


def _open(run: TrackedRun, mode: str) -> Any:
    import wandb

    return wandb.init(
        project=run.project,
        entity=run.cfg.entity,
        group=run.cfg.group,
        tags=run.tags or None,
        notes=run.cfg.info or None,
        name=run.name,
        id=run.name,
        resume="allow",
        dir=str(run.run_dir),
        config=run.parameters,
        mode=mode,  # type: ignore[arg-type]
        # The terminal belongs to the console tracker, its text to train.log.
        settings=wandb.Settings(console="off", init_timeout=_PATIENCE_SECONDS),
    )


def has_key() -> bool:
    """Return whether a key is known, from the environment or ``~/.netrc``."""
    if os.environ.get("WANDB_API_KEY"):
        return True
    try:
        return netrc.netrc().authenticators("api.wandb.ai") is not None
    except (OSError, netrc.NetrcParseError):
        return False
