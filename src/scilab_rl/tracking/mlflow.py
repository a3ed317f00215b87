"""MLflow: all runs in one SQLite database next to them, browsed with ``make mlflow``."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from scilab_rl import files, telemetry
from scilab_rl.results import RunResult
from scilab_rl.tracking.base import RemoteState, SyncableTracker, TrackedRun
from scilab_rl.tracking.names import encoded, is_plain_path

_RUN_ID_FILE = "mlflow_run_id.txt"
_MAX_PARAMETERS = 100  # of one log_batch
_MAX_VALUE_CHARACTERS = 6000
_MAX_NAME_CHARACTERS = 250
_REFUSED_IN_NAMES = re.compile(r"[^\w\-. :/]", re.ASCII)
_REFUSED_IN_OTHER_PATHS = re.compile(r"[^\w\- :]", re.ASCII)  # /a, a//b, a/../b are refused
_SETTINGS = {
    "MLFLOW_LOGGING_LEVEL": "WARNING",
    # MLflow's own patience with a server that is not there is minutes; many runs are shorter.
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "4",
}
_PARENT = "mlflow.parentRunId"
_STATUS = {"failed": "FAILED", "interrupted": "KILLED"}
_UNKNOWN = ("RESOURCE_DOES_NOT_EXIST", "INVALID_PARAMETER_VALUE")  # no such run; no run's id at all


class MLflowTracker(SyncableTracker):
    """Writes each epoch as one batch.

    Args:
        tracking_uri: Where to write; None means ``sqlite:///<base_logdir>/mlflow.db``.
    """

    def __init__(self, tracking_uri: str | None = None) -> None:
        self.tracking_uri = tracking_uri
        self._client: Any = None
        self._run_id = ""

    def begin(self, run: TrackedRun) -> None:
        """Create the run, or continue it after a resume."""
        known = self._find(run)
        if known is not None:
            self._run_id = known.info.run_id
            self._client.update_run(self._run_id, status="RUNNING")
            self._log_parameters(run, known.data.params)
            return
        with _locked(run.base_logdir / ".mlflow.lock"):  # two runs must not both create it
            experiment = self._experiment(run)
            tags = {"mlflow.note.content": run.cfg.info}
            tags |= dict.fromkeys(map(_allowed, run.tags), "true")
            if group := run.cfg.group:
                tags |= {"group": group, _PARENT: self._group(experiment, group)}
        created = self._client.create_run(experiment, run_name=run_name(run), tags=tags)
        self._run_id = created.info.run_id
        (run.run_dir / _RUN_ID_FILE).write_text(self._run_id, encoding="utf-8")
        self._log_parameters(run, {})

    def epoch(self, step: int, epoch: int, values: Mapping[str, float]) -> None:
        """Write the metrics of an epoch."""
        from mlflow.entities import Metric

        now = int(time.time() * 1000)
        metrics = [Metric(_allowed(name), value, now, step) for name, value in values.items()]
        self._client.log_batch(self._run_id, metrics=metrics)

    def artifact(self, path: Path) -> None:
        """Copy a file to the run's artifacts."""
        self._client.log_artifact(self._run_id, str(path))

    def end(self, result: RunResult) -> None:
        """Set the final status."""
        self._client.set_terminated(self._run_id, status=_final_status(result))

    def remote_state(self, run: TrackedRun, names: Iterable[str], result: RunResult) -> RemoteState:
        """Ask the database."""
        known = self._find(run)
        if known is None:
            return RemoteState({}, frozenset(), is_closed=False)
        run_id = known.info.run_id
        has_all_parameters = set(map(_allowed, run.parameters)) <= set(known.data.params)
        return RemoteState(
            steps={
                name: {m.step for m in self._client.get_metric_history(run_id, _allowed(name))}
                for name in names
            },
            files={file.path for file in self._client.list_artifacts(run_id)},
            is_closed=has_all_parameters and known.info.status == _final_status(result),
        )

    def delete(self, run: TrackedRun) -> bool:
        """Move a run to MLflow's trash, which ``mlflow gc`` empties.

        Returns:
            Whether it was there.
        """
        known = self._find(run)
        if known is not None:
            self._client.delete_run(known.info.run_id)
        return known is not None

    def _find(self, run: TrackedRun) -> Any:
        """Return the run as the database knows it, or None; opens the database."""
        _apply_settings()
        from mlflow.tracking import MlflowClient

        uri = self.tracking_uri or prepare_database(run.base_logdir)
        self._client = MlflowClient(tracking_uri=uri)
        stored = run.run_dir / _RUN_ID_FILE
        known = self._get(stored.read_text(encoding="utf-8")) if stored.is_file() else None
        if known is not None:
            return known
        # The id may be that of another database, or a server has created it and not answered.
        experiment = self._client.get_experiment_by_name(run.project)
        if experiment is None:
            return None
        named = f"attributes.run_name = '{run_name(run)}'"
        found = self._client.search_runs([experiment.experiment_id], named)
        return found[0] if found else None

    def _get(self, run_id: str) -> Any:
        from mlflow.exceptions import MlflowException

        try:
            known = self._client.get_run(run_id)
        except MlflowException as error:
            if error.error_code in _UNKNOWN:
                return None
            raise
        return known if known.info.lifecycle_stage == "active" else None

    def _experiment(self, run: TrackedRun) -> str:
        found = self._client.get_experiment_by_name(run.project)
        if found is not None:
            return found.experiment_id
        artifacts = (run.base_logdir.resolve() / "mlflow_artifacts").as_uri()
        return self._client.create_experiment(run.project, artifact_location=artifacts)

    def _group(self, experiment: str, name: str) -> str:
        """Return the id of the run below which MLflow shows the runs of a group."""
        key = _allowed(name)
        found = self._client.search_runs([experiment], f"tags.group_parent = '{key}'")
        if found:
            return found[0].info.run_id
        tags = {"group": name, "group_parent": key}
        parent = self._client.create_run(experiment, run_name=name, tags=tags).info.run_id
        self._client.set_terminated(parent)
        return parent

    def _log_parameters(self, run: TrackedRun, known: Mapping[str, str]) -> None:
        """Write the parameters that are not known; MLflow refuses to change the others."""
        from mlflow.entities import Param

        parameters = [
            Param(_allowed(name), str(value)[:_MAX_VALUE_CHARACTERS])
            for name, value in run.parameters.items()
            if _allowed(name) not in known
        ]
        for start in range(0, len(parameters), _MAX_PARAMETERS):
            self._client.log_batch(self._run_id, params=parameters[start : start + _MAX_PARAMETERS])


def run_name(run: TrackedRun) -> str:
    """Return the name under which MLflow shows a run; its lists cut names at their end."""
    return f"{run.cfg.algorithm.name} s{run.cfg.seed} {run.name}"


def _final_status(result: RunResult) -> str:
    return _STATUS.get(result.status, "FINISHED")


def _apply_settings() -> None:
    """Make MLflow quiet and quick; it reads these when it is imported."""
    telemetry.switch_off()
    for name, value in _SETTINGS.items():
        os.environ.setdefault(name, value)


def _allowed(name: str) -> str:
    """Return the name in characters that do not make MLflow refuse the whole batch."""
    refused = _REFUSED_IN_NAMES if is_plain_path(name) else _REFUSED_IN_OTHER_PATHS
    return encoded(name, refused, _MAX_NAME_CHARACTERS)


def prepare_database(base_logdir: Path) -> str:
    """Return the address of the runs' database, which is created in one step when it is missing.

    MLflow needs seconds and many transactions for that. Two runs would collide, and a run that ends
    meanwhile would leave a database that nobody can open.
    """
    path = base_logdir.resolve() / "mlflow.db"
    with _locked(base_logdir / ".mlflow.lock"):
        if not path.exists():
            _apply_settings()
            from mlflow.tracking import MlflowClient

            unfinished = path.with_name(".mlflow.db.tmp")
            unfinished.unlink(missing_ok=True)
            MlflowClient(tracking_uri=f"sqlite:///{unfinished}").search_experiments()
            unfinished.replace(path)
    return f"sqlite:///{path}"


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    with path.open("w") as file:
        files.lock(file)
        yield
