"""MLflow: all runs in one SQLite database beside them, browsed with ``make mlflow``."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from scilab_rl.results import RunResult
from scilab_rl.tracking.base import RunInfo, Tracker

_RUN_ID_FILE = "mlflow_run_id.txt"
_MAX_PARAMETERS = 100  # of one log_batch
_MAX_VALUE_CHARACTERS = 6000
_STATUS = {"failed": "FAILED", "interrupted": "KILLED"}


class MLflowTracker(Tracker):
    """Writes each epoch as one batch.

    Args:
        tracking_uri: Where to write; None means ``sqlite:///<base_logdir>/mlflow.db``.
    """

    def __init__(self, tracking_uri: str | None = None) -> None:
        self.tracking_uri = tracking_uri
        self._client: Any = None
        self._run_id = ""

    def begin(self, run: RunInfo) -> None:
        """Create the run, or go on with it after a resume."""
        os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
        os.environ.setdefault("DO_NOT_TRACK", "true")
        os.environ.setdefault("MLFLOW_LOGGING_LEVEL", "WARNING")
        from mlflow.tracking import MlflowClient

        uri = self.tracking_uri or f"sqlite:///{run.base_logdir.resolve() / 'mlflow.db'}"
        with _locked(run.base_logdir / ".mlflow.lock"):
            # The first client creates the tables, and two at once would collide.
            self._client = MlflowClient(tracking_uri=uri)
            experiment = self._experiment(run)
        stored = run.run_dir / _RUN_ID_FILE
        if stored.is_file():
            self._run_id = stored.read_text(encoding="utf-8")
            self._client.update_run(self._run_id, status="RUNNING")
            return
        tags = {"mlflow.note.content": run.notes} | dict.fromkeys(run.tags, "true")
        if run.group:
            tags["group"] = run.group
        created = self._client.create_run(experiment, run_name=run.name, tags=tags)
        self._run_id = created.info.run_id
        stored.write_text(self._run_id, encoding="utf-8")
        self._log_parameters(run)

    def epoch(self, step: int, epoch: int, values: Mapping[str, float]) -> None:
        """Write the metrics of an epoch."""
        from mlflow.entities import Metric

        now = int(time.time() * 1000)
        metrics = [Metric(name, value, now, step) for name, value in values.items()]
        self._client.log_batch(self._run_id, metrics=metrics)

    def artifact(self, path: Path) -> None:
        """Copy a file to the run's artifacts."""
        self._client.log_artifact(self._run_id, str(path))

    def end(self, result: RunResult) -> None:
        """Set the final status."""
        self._client.set_terminated(self._run_id, status=_STATUS.get(result.status, "FINISHED"))

    def _experiment(self, run: RunInfo) -> str:
        name = run.project or "scilab-rl"
        found = self._client.get_experiment_by_name(name)
        if found is not None:
            return found.experiment_id
        artifacts = (run.base_logdir.resolve() / "mlflow_artifacts").as_uri()
        return self._client.create_experiment(name, artifact_location=artifacts)

    def _log_parameters(self, run: RunInfo) -> None:
        from mlflow.entities import Param

        parameters = [
            Param(name, str(value)[:_MAX_VALUE_CHARACTERS])
            for name, value in run.parameters.items()
        ]
        for start in range(0, len(parameters), _MAX_PARAMETERS):
            self._client.log_batch(self._run_id, params=parameters[start : start + _MAX_PARAMETERS])


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
