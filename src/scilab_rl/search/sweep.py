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

from scilab_rl.config.compose import compose
from scilab_rl.config.recorded import as_yaml
from scilab_rl.config.schema import RunConfig, is_enabled, learning_part
from scilab_rl.errors import ConfigError, ScilabRLError, SomeRunsFailedError
from scilab_rl.files import write_text
from scilab_rl.parallel.launchers import open_pool
from scilab_rl.run.checks import check_metrics, complete
from scilab_rl.run.directory import slug
from scilab_rl.search.definition import StudyDefinition
from scilab_rl.search.folders import DEFINITION_FILE, STUDIES
from scilab_rl.search.parsing import parameter_of, parse_space
from scilab_rl.search.report import write_report
from scilab_rl.search.samplers import require_packages
from scilab_rl.search.settings import StudySettings, read_settings
from scilab_rl.search.space import Parameter, SearchSpace
from scilab_rl.search.storage import StudyStorage
from scilab_rl.search.study import RunPlan, Study
from scilab_rl.search.values import override_text
from scilab_rl.seeding import resolve_seed

if TYPE_CHECKING:
    from hydra.core.override_parser.types import Override

_log = logging.getLogger(__name__)


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
    """The search that a multirun describes.

    Attributes:
        fixed: Overrides that all runs share.
        parameters: What is searched.
        sweeper: The mapping ``hydra.sweeper``.
    """

    fixed: tuple[str, ...]
    parameters: tuple[Parameter, ...]
    sweeper: Mapping[str, object]


def is_study(sweeper: Mapping[str, object], overrides: Sequence[Override]) -> bool:
    """Return whether a multirun is a study, rather than a grid in which each run happens once.

    It is when it has a search space, a continuous interval, or a name or size of a study.
    """
    from hydra.core.override_parser.types import IntervalSweep

    named = any(sweeper.get(key) for key in ("search_space", "study_name", "max_trials"))
    return named or any(isinstance(override.value(), IntervalSweep) for override in overrides)


def run_study(
    sweeper: Mapping[str, Any], launcher: Mapping[str, object], overrides: Sequence[Override]
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
    cfg = compose(request.fixed)  # without the searched values
    space = SearchSpace(request.parameters, fixed=cfg.flat())
    check_first_run(request, space)
    family = re.sub(r"^.*:|-v\d+$", "", cfg.env)
    name = request.sweeper.get("study_name") or slug(f"{cfg.algorithm.name}_{family}")
    settings = read_settings({**request.sweeper, "study_name": name})
    require_packages(settings.sampler)
    if settings.sampler == "grid":
        space.refuse_continuum()
    n_configurations = settings.max_trials // settings.min_trials_per_param
    if n_configurations < 2:
        _log.info(
            "max_trials=%d suffices for %d configuration(s) of %d runs: little to compare.",
            settings.max_trials, n_configurations, settings.min_trials_per_param,
        )  # fmt: skip
    directory = Path(cfg.base_logdir) / STUDIES / settings.study_name
    storage = StudyStorage(directory, settings.storage, settings.directions)
    definition = _define(storage, request, space, settings, cfg)
    plan = RunPlan(
        overrides=(
            *request.fixed,
            "++tracking.console.enabled=false",  # many runs at once: the study reports for them
            f"group={cfg.group or settings.study_name}",
        ),
        cfg=cfg,
        seed=definition["seed"],
        baseline=space.setting_in(cfg.flat()),
    )
    prepare_trackers(cfg)
    from scilab_rl.search.progress import StudyProgress

    with (
        open_pool(launcher, settings.n_jobs, directory) as pool,
        StudyProgress(directory, settings, pool.size) as progress,
    ):
        study = Study(storage, pool, space, settings, plan, progress.update)
        with _signals_to(study):
            study.work()
    write_report(storage).print_summary()
    _conclude(study)


def read_request(sweeper: Mapping[str, Any], overrides: Sequence[Override]) -> Request:
    """Divide the command line into what is fixed and what is searched.

    Raises:
        ConfigError: If the search is empty or sweeps over seeds.
    """
    parameters = parse_space(sweeper.get("search_space") or {})
    fixed = []
    for override in overrides:
        # The command line wins over the file.
        name = override.get_key_element().lstrip("+~")
        if any(p.name == name for p in parameters) and not override.is_sweep_override():
            _log.info("'%s' is given on the command line and not searched.", name)
        parameters = [p for p in parameters if p.name != name]
        if override.is_sweep_override():
            parameters.append(parameter_of(override))
        else:
            fixed.append(override.input_line or "")
    if any(parameter.name == "seed" for parameter in parameters):
        raise ConfigError(
            "A study repeats each setting with seeds of its own: leave seed out, and choose "
            "how often with hydra.sweeper.min_trials_per_param and max_trials_per_param."
        )
    if not parameters:
        raise ConfigError(
            "The study has nothing to search: give hydra.sweeper.search_space in a file, or an "
            "interval on the command line, for example 'algorithm.gamma=interval(0.9,0.99)'."
        )
    given = {key: value for key, value in sweeper.items() if key not in ("_target_", "params")}
    words = [word for word in fixed if not word.lstrip("+~").startswith(("hydra.", "hydra/"))]
    return Request(tuple(words), tuple(parameters), given)


def check_first_run(request: Request, space: SearchSpace) -> None:
    """Compose and check the configuration of a first run, so that mistakes show at once."""
    example: dict[str, object] = {}
    for parameter in space.parameters:
        if parameter.exists_in(example):
            example[parameter.name] = (parameter.labels or (parameter.low,))[0]
    words = [*request.fixed, *space.overrides(example)]
    check_metrics(complete(compose(words)))


def prepare_trackers(cfg: RunConfig) -> None:
    """Create MLflow's database before many runs would have to wait for one of them."""
    tracker = cfg.tracking["mlflow"]
    if not is_enabled(tracker["enabled"], package="mlflow") or tracker["tracking_uri"]:
        return
    from scilab_rl.tracking import mlflow

    try:
        mlflow.prepare_database(Path(cfg.base_logdir))
    except Exception as error:  # noqa: BLE001 - training never depends on a tracker
        _log.warning("MLflow: %s. The study continues without it.", error)


def _define(
    storage: StudyStorage,
    request: Request,
    space: SearchSpace,
    settings: StudySettings,
    cfg: RunConfig,
) -> StudyDefinition:
    """Store what a new study is made with, or check that an old one is continued as it was."""
    searched = {parameter.name for parameter in space.parameters}
    values = cfg.flat()
    new: StudyDefinition = {
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
            for key, value in learning_part(values).items()
            if key not in searched
        },
    }

    def define() -> StudyDefinition:
        old = storage.definition()
        if old is not None:
            refuse_changes(old, new, settings)
            asked = settings.seed or cfg.seed
            if asked not in (0, old["seed"]):
                raise ConfigError(
                    f"The study {settings.study_name} has the seed {old['seed']}, not {asked}."
                )
            new["seed"] = old["seed"]
        storage.define(new)
        _save_configuration(storage.directory, cfg, settings)  # each machine has its folder
        return new

    return storage.transact(define)


def refuse_changes(old: StudyDefinition, new: StudyDefinition, settings: StudySettings) -> None:
    """Refuse to continue a study with something that makes its runs incomparable.

    Raises:
        ConfigError: With the first differences and what can be done.
    """
    before, now = (learning_part(made["configuration"]) for made in (old, new))
    changes = _differences(before, now)
    changes += _differences(old, new, keys=("score", "directions", "min_runs"))
    if changes:
        raise ConfigError(
            f"The study {settings.study_name} was made with {'; '.join(changes[:4])}. Its runs "
            "could not be compared with new ones: restore it, or choose another study_name."
        )
    changes = _differences(old["space"], new["space"])
    if changes and not settings.allow_space_change:
        raise ConfigError(
            f"The search space of {settings.study_name} was {'; '.join(changes[:4])}. Take another "
            "study_name, or go on with the new space by hydra.sweeper.allow_space_change=true."
        )


def _differences(
    old: Mapping[str, object], new: Mapping[str, object], keys: Sequence[str] = ()
) -> list[str]:
    names = keys or sorted({*old, *new})
    return [
        f"{name}: {old.get(name, 'absent')} (now {new.get(name, 'absent')})"
        for name in names
        if old.get(name) != new.get(name)
    ]


def _save_configuration(directory: Path, cfg: RunConfig, settings: StudySettings) -> None:
    import dataclasses

    stored = {"sweeper": dataclasses.asdict(settings), "run": cfg.values()}
    write_text(directory / DEFINITION_FILE, as_yaml(stored))


@contextlib.contextmanager
def _signals_to(study: Study) -> Iterator[None]:
    """Let Ctrl-C and SIGTERM stop the study gracefully within the block."""
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
