"""What a run leaves behind: its directory and its result."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime as dt
import fcntl
import json
import os
import re
import secrets
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from scilab_rl import files
from scilab_rl.errors import ConfigError, did_you_mean

CONFIG_FILE = "config.yaml"
RESULT_FILE = "result.json"
LAST_LINK = "last"
LOCK_FILE = ".lock"
EXIT_REQUEUE = 75


@dataclasses.dataclass(frozen=True)
class RunResult:
    """The outcome of one run, as stored in its ``result.json``.

    Attributes:
        status: ``running``, ``finished`` (all epochs), ``stopped_early``, ``interrupted`` or
            ``failed``.
        score: Last value of ``hyperopt_criterion``; None when the run failed or never evaluated.
        epochs: Completed epochs, that is evaluations.
        steps: Environment steps over all environments.
        seconds: Wall time.
        run_dir: The directory of the run.
        metrics: The last value of each evaluation metric.
        error: One line that says why the run failed.
        signal_number: The signal that interrupted the run, or 0.
    """

    status: str
    score: float | None
    epochs: int
    steps: int
    seconds: float
    run_dir: str
    metrics: dict[str, float] = dataclasses.field(default_factory=dict)
    error: str | None = None
    signal_number: int = 0

    @property
    def exit_code(self) -> int:
        """What the shell shall see: 0, or 128 and the signal that interrupted the run.

        Under a job scheduler an interrupted run asks to be queued again (75, EX_TEMPFAIL).
        """
        if not self.signal_number:
            return 0
        if self.signal_number == signal.SIGTERM and "SLURM_JOB_ID" in os.environ:
            return EXIT_REQUEUE
        return 128 + self.signal_number


class RunDirectory:
    """The directory ``<base>/<date>/<time>-<env>-<algorithm>-s<seed>-<suffix>/`` of one run.

    Args:
        path: An existing directory.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def create(cls, base: Path, env: str, algorithm: str, seed: int) -> RunDirectory:
        """Create a directory that no other run has, however many start in the same second.

        Uniqueness holds by construction: ``mkdir`` fails for all but one of the processes that
        draw the same suffix.

        Raises:
            ConfigError: If the directory cannot be written.
        """
        now = dt.datetime.now()
        name = f"{now:%H%M%S}-{slug(env)}-{slug(algorithm)}-s{seed}"
        day = base / f"{now:%Y-%m-%d}"
        try:
            day.mkdir(parents=True, exist_ok=True)
            while True:
                path = day / f"{name}-{secrets.token_hex(2)}"
                try:
                    path.mkdir()
                except FileExistsError:
                    continue
                return cls(path)
        except OSError as error:
            raise ConfigError(
                f"The run directory cannot be created in '{base}': {error.strerror}. "
                f"Choose another place with base_logdir=DIR."
            ) from error

    def __truediv__(self, name: str) -> Path:
        return self.path / name

    def __str__(self) -> str:
        return str(self.path)

    def discard(self) -> None:
        """Remove the directory of a run that was refused before its first step."""
        shutil.rmtree(self.path, ignore_errors=True)
        for folder in list(self.path.parents)[:2]:
            with contextlib.suppress(OSError):  # another run lives there
                folder.rmdir()

    def write_result(self, result: RunResult) -> None:
        """Replace ``result.json``."""
        files.write_json(self / RESULT_FILE, dataclasses.asdict(result))

    def read_result(self) -> RunResult | None:
        """Return the stored result, or None when it is missing or damaged."""
        try:
            stored = json.loads((self / RESULT_FILE).read_text(encoding="utf-8"))
            return RunResult(**stored)
        except (OSError, ValueError, TypeError):
            return None

    @contextlib.contextmanager
    def in_use(self) -> Iterator[None]:
        """Mark the run as alive for the block; the kernel takes the mark back when we die.

        Raises:
            ConfigError: If another process works on this run.
        """
        with (self / LOCK_FILE).open("w") as file:
            if not _try_lock(file):
                raise ConfigError(f"Another process works on '{self}'; wait for it or stop it.")
            yield

    def is_in_use(self) -> bool:
        """Tell whether a process works on this run."""
        try:
            with (self / LOCK_FILE).open("r") as file:
                return not _try_lock(file)
        except OSError:
            return False

    def publish_as_last(self, base: Path) -> None:
        """Let ``<base>/last`` point to this run."""
        files.point_to(base / LAST_LINK, self.path)


def _try_lock(file: IO[str]) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a network drive without locks
        return True
    return True


def slug(text: str) -> str:
    """Return a name that is safe as part of a file name.

    >>> slug("ALE/Pong-v5")
    'ALE_Pong-v5'
    >>> slug("../../etc")
    'etc'
    """
    return re.sub(r"[^A-Za-z0-9._-]+", "_", text).strip("._-")[:80] or "unnamed"


def all_runs(base: Path) -> Iterator[RunDirectory]:
    """Yield the runs below a base directory, oldest first."""
    for config in sorted(base.glob(f"*/*/{CONFIG_FILE}")):
        if not config.parent.parent.is_symlink():
            yield RunDirectory(config.parent)


def find_run(name: str, base: Path) -> RunDirectory:
    """Find a run by ``last``, by its path, or by a unique part of its directory's name.

    Args:
        name: What the user typed; also the path of a saved policy inside a run.
        base: Where runs live.

    Raises:
        ConfigError: If no run or more than one fits.
    """
    for path in (Path(name), base / name):
        for candidate in (path, path.parent):
            if (candidate / CONFIG_FILE).is_file():
                return RunDirectory(candidate.resolve())
    runs = {run.path.name: run for run in all_runs(base)}
    fitting = [run for run_name, run in runs.items() if name and name in run_name]
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        raise ConfigError(
            f"'{name}' fits {len(fitting)} runs in '{base}'; give more of the name, for example "
            f"'{fitting[-1].path.name}'."
        )
    raise ConfigError(
        f"No run '{name}' in '{base}'.{did_you_mean(name, runs)} "
        "`scilab-rl runs` lists them; 'last' means the newest."
    )


def read_epochs(run: RunDirectory) -> list[dict[str, Any]]:
    """Return the rows of ``metrics.jsonl`` that describe evaluations, oldest first."""
    path = run / "metrics.jsonl"
    if not path.is_file():
        return []
    rows = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            row = json.loads(line)
        except ValueError:  # the last line of a killed run may be cut
            continue
        if row.get("kind") == "epoch":
            rows.append(row)
    return rows
