"""From the command line of a multirun to a finished study."""

from __future__ import annotations

import contextlib
import logging
import re
import signal
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf

from scilab_rl import assembly, config
from scilab_rl.errors import ConfigError, ScilabRLError, SomeRunsFailedError
from scilab_rl.files import write_text
from scilab_rl.hyperopt.folders import DEFINITION_FILE, STUDIES
from scilab_rl.hyperopt.launchers import open_pool
from scilab_rl.hyperopt.ledger import Ledger
from scilab_rl.hyperopt.report import write_report
from scilab_rl.hyperopt.samplers import require_packages
from scilab_rl.hyperopt.settings import StudySettings, read_settings
from scilab_rl.hyperopt.space import (
    Parameter,
    SearchSpace,
    override_text,
    parameter_of,
    parse_space,
)
from scilab_rl.hyperopt.study import RunPlan, Study
from scilab_rl.results import slug
from scilab_rl.seeding import resolve_seed

if TYPE_CHECKING:
    from hydra.core.override_parser.types import Override

_log = logging.getLogger(__name__)
# What may differ when a study is continued: it does not change what a run learns.
_FREE_KEYS = (
    "seed", "base_logdir", "info", "mlflow", "wandb", "tensorboard", "project_name", "entity",
    "group", "tags", "render", "render_freq", "device", "n_threads", "save_model_freq", "tracking",
)  # fmt: skip


class StudyInterrupted(ScilabRLError):
    """Somebody has stopped the study.

    Args:
        message: What to tell.
        signal_number: The signal.
    """

    def __init__(self, message: str, signal_number: int) -> None:
        super().__init__(message)
        self.exit_code = 128 + signal_number


@dataclass(frozen=True)
class Request:
    """What a multirun asks for.

    Attributes:
        fixed: Overrides that all runs share.
        parameters: What is searched.
        sweeper: The mapping ``hydra.sweeper``.
    """

    fixed: tuple[str, ...]
    parameters: tuple[Parameter, ...]
    sweeper: Mapping[str, Any]


def is_study(sweeper: Mapping[str, Any], overrides: Sequence[Override]) -> bool:
    """Tell whether a multirun is a study, rather than a grid in which each run happens once.

    It is when it has a search space, a continuous interval, or a name or size of a study.
    """
    from hydra.core.override_parser.types import IntervalSweep

    named = any(sweeper.get(key) for key in ("search_space", "study_name", "max_trials"))
    return named or any(isinstance(override.value(), IntervalSweep) for override in overrides)


def run_study(
    sweeper: Mapping[str, Any], launcher: Mapping[str, Any], overrides: Sequence[Override]
) -> None:
    """Run, continue or join a study, and leave its report behind.

    Args:
        sweeper: The mapping ``hydra.sweeper``.
        launcher: The mapping ``hydra.launcher``.
        overrides: The command line.

    Raises:
        ConfigError: If it cannot work; nothing has been started.
        SomeRunsFailedError: If runs have failed; the report is there.
        StudyInterrupted: If a signal has stopped it; the report is there.
    """
    request = read_request(sweeper, overrides)
    space = SearchSpace(request.parameters)
    cfg = check_runs(request, space)
    family = re.sub(r"^.*:|-v\d+$", "", cfg.env)
    name = request.sweeper.get("study_name") or slug(f"{cfg.algorithm.name}_{family}")
    settings = read_settings({**request.sweeper, "study_name": name})
    require_packages(settings.sampler)
    n_settings = settings.max_trials // settings.min_trials_per_param
    if n_settings < 2:
        _log.info(
            "max_trials=%d suffices for %d setting(s) of %d runs; there is little to compare.",
            settings.max_trials, n_settings, settings.min_trials_per_param,
        )  # fmt: skip
    directory = Path(cfg.base_logdir) / STUDIES / settings.study_name
    ledger = Ledger(directory, settings.storage, settings.directions)
    definition = _define(ledger, request, space, settings, cfg)
    plan = RunPlan(
        overrides=(
            *request.fixed,
            "++tracking.console.enabled=false",  # many runs at once: the study reports for them
            f"group={cfg.group or settings.study_name}",
        ),
        criterion=cfg.hyperopt_criterion,
        n_epochs=cfg.n_epochs,
        budget_steps=cfg.n_epochs * cfg.eval_after_n_steps,
        threshold=cfg.early_stop_threshold,
        seed=definition["seed"],
        present=space.setting_in(config.flat(cfg)),
    )
    prepare_trackers(cfg)
    from scilab_rl.hyperopt.progress import StudyProgress

    with (
        open_pool(launcher, settings.n_jobs, directory) as pool,
        StudyProgress(directory, settings, pool.size) as progress,
    ):
        study = Study(ledger, pool, space, settings, plan, progress)
        with _signals_to(study):
            study.work()
    write_report(ledger).print_summary()
    _conclude(study)


def read_request(sweeper: Mapping[str, Any], overrides: Sequence[Override]) -> Request:
    """Divide the command line into what is fixed and what is searched.

    Raises:
        ConfigError: If the search is empty or sweeps over seeds.
    """
    parameters = parse_space(sweeper.get("search_space") or {})
    fixed = []
    for override in overrides:
        if not override.is_sweep_override():
            fixed.append(override.input_line or "")
            continue
        parameter = parameter_of(override)
        if parameter.name == "seed":
            raise ConfigError(
                "A study repeats each setting with seeds of its own: leave seed out, and choose "
                "how often with hydra.sweeper.min_trials_per_param and max_trials_per_param."
            )
        # The command line wins over the file.
        parameters = [p for p in parameters if p.name != parameter.name] + [parameter]
    if not parameters:
        raise ConfigError(
            "The study has nothing to search: give hydra.sweeper.search_space in a file, or an "
            "interval on the command line, for example 'algorithm.gamma=interval(0.9,0.99)'."
        )
    given = {key: value for key, value in sweeper.items() if key not in ("_target_", "params")}
    words = [word for word in fixed if not word.lstrip("+~").startswith(("hydra.", "hydra/"))]
    return Request(tuple(words), tuple(parameters), given)


def check_runs(request: Request, space: SearchSpace) -> DictConfig:
    """Compose and check the configuration of a first run, so that mistakes show at once.

    Returns:
        The configuration without the searched values.
    """
    example: dict[str, Any] = {}
    for parameter in space.parameters:
        if parameter.exists_in(example):
            example[parameter.name] = (parameter.labels or (parameter.low,))[0]
    assembly.complete(config.compose([*request.fixed, *space.overrides(example)]))
    return config.prepare(config.compose(request.fixed))


def prepare_trackers(cfg: DictConfig) -> None:
    """Create MLflow's database before many runs would have to wait for one of them."""
    tracker = cfg.tracking.mlflow
    if not config.switched_on(tracker.enabled, package="mlflow") or tracker.tracking_uri:
        return
    from scilab_rl.tracking import mlflow

    try:
        mlflow.prepare_database(Path(cfg.base_logdir))
    except Exception as error:  # noqa: BLE001 - training never depends on a tracker
        _log.warning("MLflow: %s. The study goes on without it.", error)


def _define(
    ledger: Ledger,
    request: Request,
    space: SearchSpace,
    settings: StudySettings,
    cfg: DictConfig,
) -> dict[str, Any]:
    """Store what a new study is made with, or check that an old one is continued as it was."""
    searched = {parameter.name for parameter in space.parameters}
    values = config.flat(cfg)
    new = {
        "seed": resolve_seed(settings.seed or cfg.seed),
        "overrides": list(request.fixed),
        "space": space.describe(),
        "score": list(settings.score),
        "directions": list(settings.directions),
        "min_runs": settings.min_trials_per_param,
        "env": cfg.env,
        "algorithm": cfg.algorithm.name,
        "criterion": cfg.hyperopt_criterion,
        "max_runs": settings.max_trials_per_param,
        "configuration": {
            key: override_text(value)
            for key, value in values.items()
            if key.partition(".")[0] not in _FREE_KEYS and key not in searched
        },
    }
    with ledger.locked():
        old = ledger.definition()
        if not (ledger.directory / DEFINITION_FILE).exists():
            _save_configuration(ledger.directory, cfg, settings)  # each machine has its folder
        if old is None:
            ledger.define(new)
            return new
        refuse_changes(old, new, settings)
        asked = settings.seed or cfg.seed
        if asked not in (0, old["seed"]):
            raise ConfigError(
                f"The study {settings.study_name} has the seed {old['seed']}, not {asked}."
            )
        new["seed"] = old["seed"]
        ledger.define(new)
    return new


def refuse_changes(old: Mapping[str, Any], new: Mapping[str, Any], settings: StudySettings) -> None:
    """Refuse to continue a study with something that makes its runs incomparable.

    Raises:
        ConfigError: With the first differences and what can be done.
    """
    changes = _differences(old["configuration"], new["configuration"])
    changes += _differences(old, new, keys=("score", "directions", "min_runs"))
    if changes:
        raise ConfigError(
            f"The study {settings.study_name} was made with {'; '.join(changes[:4])}. Its runs "
            "could not be compared with new ones: set it back, or take another study_name."
        )
    changes = _differences(old["space"], new["space"])
    if changes and not settings.allow_space_change:
        raise ConfigError(
            f"The search space of {settings.study_name} was {'; '.join(changes[:4])}. Take another "
            "study_name, or go on with the new space by hydra.sweeper.allow_space_change=true."
        )


def _differences(
    old: Mapping[str, Any], new: Mapping[str, Any], keys: Sequence[str] = ()
) -> list[str]:
    names = keys or sorted({*old, *new})
    return [
        f"{name}: {old.get(name, 'absent')} (now {new.get(name, 'absent')})"
        for name in names
        if old.get(name) != new.get(name)
    ]


def _save_configuration(directory: Path, cfg: DictConfig, settings: StudySettings) -> None:
    import dataclasses

    stored = {"sweeper": dataclasses.asdict(settings), "run": OmegaConf.to_container(cfg)}
    write_text(directory / DEFINITION_FILE, OmegaConf.to_yaml(OmegaConf.create(stored)))


@contextlib.contextmanager
def _signals_to(study: Study) -> Iterator[None]:
    """Let Ctrl-C and SIGTERM stop the study politely while the block runs."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    previous = {n: signal.signal(n, lambda number, _: study.interrupt(number)) for n in numbers}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _conclude(study: Study) -> None:
    reason, name = study.stop.reason, study.settings.study_name
    if study.stop.signal_number:
        raise StudyInterrupted(
            f"{name}: {reason}; the same command continues it.", study.stop.signal_number
        )
    failed = [run for run in study.runs if run.state == "failed"]
    if failed:
        raise SomeRunsFailedError(
            f"{name}: {len(failed)} of {len(study.runs)} runs failed"
            f"{f' ({reason})' if reason else ''}, first with: {failed[0].error}"
        )
    if reason:
        _log.info("%s: %s; the same command continues it.", name, reason)
