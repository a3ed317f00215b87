"""The directory that a run leaves behind, and how to find it again."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime as dt
import json
import re
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import yaml

from scilab_rl import files
from scilab_rl.config.workspace import PROJECT_AGENTS, SHIPPED_AGENTS
from scilab_rl.errors import ConfigError, did_you_mean
from scilab_rl.results import RunResult

CONFIG_FILE = "config.yaml"
RESULT_FILE = "result.json"
LAST_LINK = "last"
LOCK_FILE = ".lock"
AGENT = "agent:"
_POLICY = "rl_model_"
_AGENT_OUTPUTS = "agents"  # below the folder of all runs
_ID = re.compile(r"[0-9a-f]{4}")
_ID_ATTEMPTS = 20  # then an id may repeat: there are thousands of runs
# The C loader is ten times faster, and there may be thousands of runs.
_Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class RunDirectory:
    """The directory ``<base>/<date>/<time>-<env>-<algorithm>-s<seed>-<suffix>/`` of one run.

    A trained agent has the same files as a run, but nothing is written into its directory.

    Args:
        path: An existing directory.
        outputs: Where commands write what they make of it; None: into the directory itself.

    Attributes:
        path: The directory.
        outputs: Where commands write; may not exist yet.
        is_agent: Whether it is a trained agent, which neither learns nor changes.
    """

    def __init__(self, path: Path, outputs: Path | None = None) -> None:
        self.path = path
        self.outputs = outputs or path
        self.is_agent = outputs is not None

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
                path = day / f"{name}-{_new_id(base)}"
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

    @property
    def id(self) -> str:
        """The short id, with which commands find the run: the last four letters of its name."""
        suffix = self.path.name.rpartition("-")[2]
        return suffix if _ID.fullmatch(suffix) and not self.is_agent else str(self.path.name)

    def __truediv__(self, name: str) -> Path:
        return self.path / name

    def __str__(self) -> str:
        return f"{AGENT}{self.path.name}" if self.is_agent else str(self.path)

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

    def read_config(self) -> dict[str, Any]:
        """Return the recorded configuration as plain data.

        Raises:
            ConfigError: If it is missing or damaged.
        """
        try:
            config = yaml.load((self / CONFIG_FILE).read_text(encoding="utf-8"), Loader=_Loader)
        except (OSError, ValueError, yaml.YAMLError) as error:
            raise ConfigError(f"{CONFIG_FILE} cannot be read: {type(error).__name__}") from error
        if not isinstance(config, dict) or not config:
            raise ConfigError(f"{CONFIG_FILE} holds no configuration")
        return config

    @contextlib.contextmanager
    def in_use(self) -> Iterator[None]:
        """Mark the run as alive for the block; the kernel takes the mark back when we die.

        Raises:
            ConfigError: If another process works on this run.
        """
        with (self / LOCK_FILE).open("w") as file:
            if not _lock_if_free(file):
                raise ConfigError(f"Another process works on '{self}'; wait for it or stop it.")
            yield

    def is_in_use(self) -> bool:
        """Return whether a process works on this run."""
        try:
            with (self / LOCK_FILE).open("r") as file:
                return not _lock_if_free(file)
        except OSError:
            return False

    def refuse_agent(self) -> None:
        """Reject a trained agent where only a run makes sense.

        Raises:
            ConfigError: With what can be done with an agent.
        """
        if self.is_agent:
            raise ConfigError(
                f"{self} is a trained agent, not a run of yours: play, record, view, probe, export "
                f"or compare it, or start a run from its policy with restore_policy={self}."
            )

    def publish_as_last(self, base: Path) -> None:
        """Let ``<base>/last`` point to this run."""
        files.point_to(base / LAST_LINK, self.path)


def _new_id(base: Path) -> str:
    """Draw an id that no run has, as far as that is possible with four letters."""
    for _ in range(_ID_ATTEMPTS):
        drawn = secrets.token_hex(2)
        if not any(base.glob(f"*/*-{drawn}")):
            break
    return drawn


def _lock_if_free(file: IO[str]) -> bool:
    try:
        return files.lock(file, wait=False)
    except OSError:  # a network drive without locks
        return True


def slug(text: str) -> str:
    """Return a name that is safe as part of a file name.

    >>> slug("ALE/Pong-v5")
    'ALE_Pong-v5'
    >>> slug("../../etc")
    'etc'
    """
    return re.sub(r"[^A-Za-z0-9._-]+", "_", text).strip("._-")[:80] or "unnamed"


def find_policy(run: RunDirectory, *names: str) -> Path:
    """Return the folder of the first of these policies that exists.

    Args:
        run: A run.
        names: ``best``, ``finished``, ``agent:NAME``, or paths of saved policies.

    Raises:
        ConfigError: If there is none.
    """
    saved = {path.name.removeprefix(_POLICY): path for path in run.path.glob(f"{_POLICY}*")}
    for name in names:
        if (policy_path(name) / "manifest.json").is_file():
            return policy_path(name)
        if name.removeprefix(_POLICY) in saved:
            return saved[name.removeprefix(_POLICY)]
        if archive := saved.get(f"{name.removeprefix(_POLICY)}.zip"):
            return archive  # of Stable-Baselines3; whoever loads it asks whether it is trusted
    if not saved:
        raise ConfigError(f"The run '{run}' has not saved a policy yet: it needs one epoch.")
    raise ConfigError(f"There is no policy '{names[-1]}'. The run has: {', '.join(sorted(saved))}.")


def policy_path(name: str) -> Path:
    """Return the folder of a policy that ``agent:NAME`` or a path names.

    Raises:
        ConfigError: If there is no such agent.
    """
    if name.startswith(AGENT):
        return find_agent(name.removeprefix(AGENT)) / f"{_POLICY}finished"
    return Path(name)


def all_agents() -> dict[str, Path]:
    """Return the folders of the trained agents by name, shipped ones and those of the project."""
    configs = (
        config
        for folder in (SHIPPED_AGENTS, PROJECT_AGENTS)
        for config in sorted(folder.glob(f"*/{CONFIG_FILE}"))
    )
    return {config.parent.name: config.parent for config in configs}


def find_agent(name: str) -> Path:
    """Return the folder of a trained agent.

    Raises:
        ConfigError: If there is none of this name.
    """
    agents = all_agents()
    if name not in agents:
        raise ConfigError(
            f"There is no agent '{name}'.{did_you_mean(name, agents)} There are: "
            f"{', '.join(sorted(agents)) or 'none'}."
        )
    return agents[name]


def all_runs(base: Path) -> Iterator[RunDirectory]:
    """Yield the runs below a base directory, oldest first."""
    for config in sorted(base.glob(f"*/*/{CONFIG_FILE}")):
        is_half_removed = config.parent.name.startswith(".")
        if not config.parent.parent.is_symlink() and not is_half_removed:
            yield RunDirectory(config.parent)


def find_run(name: str, base: Path) -> RunDirectory:
    """Find a run by ``last``, ``agent:NAME``, its path, its id, or a unique part of its name.

    Args:
        name: What the user typed; also the path of a saved policy inside a run.
        base: Where runs live.

    Raises:
        ConfigError: If no run or more than one fits.
    """
    if (named := find_named_run(name, base)) is not None:
        return named
    runs = {run.path.name: run for run in all_runs(base)}
    fitting = [run for run in runs.values() if run.id == name]  # several, or none
    fitting = fitting or [run for run_name, run in runs.items() if name and name in run_name]
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        raise ConfigError(
            f"'{name}' fits {len(fitting)} runs in '{base}'; give the id of one, or more of the "
            f"name, for example '{fitting[-1].path.name}'."
        )
    raise ConfigError(
        f"No run '{name}' in '{base}'.{did_you_mean(name, runs)} "
        "`scilab-rl runs` lists them; 'last' means the newest."
    )


def find_named_run(name: str, base: Path) -> RunDirectory | None:
    """Return the run of this path or id, ``last``, or the agent ``agent:NAME``, if there is one.

    Raises:
        ConfigError: If there is no such agent.
    """
    for path in (*_named_agent(name, base), Path(name), base / name):
        for candidate in (path, path.parent):
            if (candidate / CONFIG_FILE).is_file():
                return _opened(candidate.resolve(), base)
    if _ID.fullmatch(name):
        runs = [run for run in all_runs(base) if run.id == name]
        return runs[0] if len(runs) == 1 else None
    return None


def _named_agent(name: str, base: Path) -> list[Path]:
    """Return the agent that ``agent:NAME`` names, or the path of what was made of it."""
    if name.startswith(AGENT):
        return [find_agent(name.removeprefix(AGENT))]
    path = Path(name).resolve()
    is_output = path.parent == (base / _AGENT_OUTPUTS).resolve() and path.is_dir()
    return [find_agent(path.name)] if is_output else []


def _opened(path: Path, base: Path) -> RunDirectory:
    is_agent = path.parent in (SHIPPED_AGENTS, PROJECT_AGENTS.resolve())
    return RunDirectory(path, base / _AGENT_OUTPUTS / path.name if is_agent else None)


def reports_success(run: RunDirectory) -> bool:
    """Return whether any evaluation of a run has measured a success rate."""
    return any("eval/success_rate" in row for row in read_epochs(run))


def read_epochs(run: RunDirectory) -> list[dict[str, Any]]:
    """Return the rows of ``metrics.jsonl`` that describe evaluations, oldest first."""
    rows = files.read_json_lines(run / "metrics.jsonl", containing='"epoch"')
    return [row for row in rows if row.get("kind") == "epoch"]


def read_episodes(run: RunDirectory) -> list[dict[str, Any]]:
    """Return the training episodes in ``metrics.jsonl``, oldest first."""
    rows = files.read_json_lines(run / "metrics.jsonl", containing='"episode"')
    return [row for row in rows if row.pop("kind", None) == "episode"]
