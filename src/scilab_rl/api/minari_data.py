"""Episodes of an agent as a Minari data set, the common format of offline reinforcement learning.

What is written is loaded again with Minari itself and compared, before it takes its name.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scilab_rl import files
from scilab_rl.config.schema import RunConfig
from scilab_rl.envs.types import Observation
from scilab_rl.envs.vec_step import ObservedStep
from scilab_rl.envs.vectorize import observed_layer
from scilab_rl.errors import ConfigError, MissingDependencyError, ScilabRLError
from scilab_rl.learning.observations import single
from scilab_rl.metrics.success import success_of
from scilab_rl.run.provenance import recorded_fingerprint

if TYPE_CHECKING:
    from gymnasium import Space
    from gymnasium.envs.registration import EnvSpec

    from scilab_rl.api.agent import Agent, EvaluationSummary

PAGE_FILE = "README.md"
_FOLDER = "MINARI_DATASETS_PATH"  # the variable by which Minari finds its data sets
_PACKAGES = ("scilab-rl", "gymnasium", "gymnasium-robotics", "mujoco")


@dataclass
class RecordedEpisode:
    """One episode, in the environment's own units.

    Attributes:
        observations: One more than there are steps: the last one is that in which it ended.
        actions, rewards, terminated, truncated: One per step.
        success: What each step reported, where steps report success.
    """

    observations: list[Observation] = field(default_factory=list)
    actions: list[np.ndarray] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    terminated: list[bool] = field(default_factory=list)
    truncated: list[bool] = field(default_factory=list)
    success: list[bool | None] = field(default_factory=list)


@dataclass(frozen=True)
class Origin:
    """Where episodes are from.

    Attributes:
        cfg: Names the environment.
        observation_space, action_space: Those of the environment.
        policy: A word for who acted.
    """

    cfg: RunConfig
    observation_space: Space
    action_space: Space
    policy: str


class EpisodeCollector:
    """Observes the steps of a single environment and keeps its episodes.

    Attributes:
        episodes: Those that have ended.
    """

    def __init__(self) -> None:
        self.episodes: list[RecordedEpisode] = []
        self._running = RecordedEpisode()

    def on_step(self, step: ObservedStep) -> None:
        """Keep a step."""
        if step.episode_steps[0] == 0:
            self._running = RecordedEpisode([_copied(single(step.observations, 0))])
        episode = self._running
        episode.actions.append(np.array(step.actions[0]))
        episode.observations.append(_copied(single(step.next_observations, 0)))
        episode.rewards.append(float(step.rewards[0]))
        episode.terminated.append(bool(step.terminated[0]))
        episode.truncated.append(bool(step.truncated[0]))
        episode.success.append(success_of(step.infos[0]))
        if step.dones[0]:
            self.episodes.append(episode)


def default_id(agent: Agent) -> str:
    """Return the id of an agent's data set, such as ``FetchReach/jaxsac-v0``."""
    return id_of(agent.cfg.env, agent.cfg.algorithm.name)


def id_of(env_id: str, name: str) -> str:
    """Return the id of an environment's data set of this name.

    >>> id_of("FetchPush-v4", "expert")
    'FetchPush/expert-v0'
    """
    family = re.sub(r"-v[0-9]+$", "", env_id.rpartition(":")[2])
    return f"{family}/{name}-v0".replace(".", "_")


def write_minari(
    agent: Agent, dataset_id: str, n_episodes: int, *, seed: int | None = None
) -> tuple[Path, EvaluationSummary]:
    """Let an agent act and write its episodes as a Minari data set.

    Args:
        agent: The agent.
        dataset_id: As Minari has them: ``namespace/name-v0``.
        n_episodes: How many episodes.
        seed: Of the episodes; None means the run's seed plus 1.

    Returns:
        The data set's folder, where `minari.load_dataset` finds it, and how good the episodes are.

    Raises:
        MissingDependencyError: If Minari is not installed.
        ConfigError: If the id is not one, or there is such a data set already.
        ScilabRLError: If Minari does not read what was written.
    """
    target = claim_id(dataset_id)
    collector, layer = EpisodeCollector(), observed_layer(agent.env)
    layer.observers.append(collector)
    try:
        summary = agent.evaluate(n_episodes, seed=seed)
    finally:
        layer.observers.remove(collector)
    origin = Origin(
        agent.cfg, agent.observation_space, agent.action_space, agent.cfg.algorithm.name
    )
    write_episodes(target, dataset_id, collector.episodes, origin, _card(agent, summary, seed))
    return target, summary


def write_episodes(
    target: Path,
    dataset_id: str,
    episodes: Sequence[RecordedEpisode],
    origin: Origin,
    card: str,
    page: str | None = None,
) -> None:
    """Write a data set, which appears when Minari has read it and each number was compared.

    Args:
        target: From `claim_id`.
        dataset_id: Its id.
        episodes: All of them.
        origin: Where they are from.
        card: What the data set's metadata say of it.
        page: The same in more words, as the file ``README.md``; None: no file.

    Raises:
        ScilabRLError: If Minari does not read what was written.
    """
    unfinished = target.parent / f".{target.name}.unfinished"
    files.discard(unfinished)
    with _minari_folder(unfinished):
        _create(origin, dataset_id, episodes, card)
        _check(dataset_id, episodes)
    if page is not None:
        files.write_text(unfinished / dataset_id / PAGE_FILE, page)
    (unfinished / dataset_id).rename(target)
    files.discard(unfinished)


def claim_id(dataset_id: str) -> Path:
    """Return the folder in which Minari looks for a data set, whose id must be free.

    Raises:
        MissingDependencyError: If Minari is not installed.
        ConfigError: If the id is not one, or there is such a data set already.
    """
    if importlib.util.find_spec("minari") is None:
        raise MissingDependencyError("minari", "minari", "to write a Minari data set")
    from minari.dataset.minari_dataset import DATASET_ID_RE
    from minari.namespace import create_namespace, list_local_namespaces
    from minari.storage.datasets_root_dir import get_dataset_path

    match = DATASET_ID_RE.fullmatch(dataset_id)
    if match is None or match["version"] is None:
        raise ConfigError(
            f"--minari must be the id of a data set, such as FetchReach/expert-v0, but it is "
            f"'{dataset_id}'."
        )
    target = Path(get_dataset_path(dataset_id))
    if target.exists():
        raise ConfigError(
            f"There is a Minari data set '{dataset_id}' already ({target}); take another id, such "
            f"as --minari {dataset_id[: match.start('version')]}{int(match['version']) + 1}."
        )
    if match["namespace"] and match["namespace"] not in list_local_namespaces():
        create_namespace(match["namespace"])
    target.parent.mkdir(parents=True, exist_ok=True)
    return target


@contextlib.contextmanager
def _minari_folder(folder: Path) -> Iterator[None]:
    """Let Minari write to and read from a folder."""
    before = os.environ.get(_FOLDER)
    os.environ[_FOLDER] = str(folder)
    try:
        yield
    finally:
        if before is None:
            del os.environ[_FOLDER]
        else:
            os.environ[_FOLDER] = before


def _create(
    origin: Origin, dataset_id: str, episodes: Sequence[RecordedEpisode], card: str
) -> None:
    import minari
    from minari.data_collector import EpisodeBuffer

    buffers = [
        EpisodeBuffer(
            observations=_stacked(episode.observations),
            actions=_stacked(episode.actions),
            rewards=episode.rewards,
            terminations=episode.terminated,
            truncations=episode.truncated,
            infos=_infos(episode),
        )
        for episode in episodes
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # about authors and links that it has not
        minari.create_dataset_from_buffers(
            dataset_id,
            buffers,
            env=_recoverable(origin),
            observation_space=origin.observation_space,
            action_space=origin.action_space,
            algorithm_name=origin.policy,
            description=card,
            data_format="arrow",
            requirements=requirements(),
        )


def _recoverable(origin: Origin) -> EnvSpec | None:
    """Return the environment without the run's wrappers; None where they change its spaces."""
    import gymnasium

    env = gymnasium.make(origin.cfg.env, **origin.cfg.env_kwargs)
    try:
        same = (env.observation_space, env.action_space) == (
            origin.observation_space, origin.action_space,
        )  # fmt: skip
        return env.spec if same else None
    finally:
        env.close()


def _check(dataset_id: str, episodes: Sequence[RecordedEpisode]) -> None:
    """Read the data set as others will, and compare it with what was recorded."""
    import minari

    loaded = list(minari.load_dataset(dataset_id))
    if len(loaded) != len(episodes):
        raise ScilabRLError(f"Minari reads {len(loaded)} of {len(episodes)} episodes.")
    for index, (read, episode) in enumerate(zip(loaded, episodes, strict=True)):
        pairs: list[tuple[Any, Any]] = [
            (read.observations, _stacked(episode.observations)),
            (read.actions, _stacked(episode.actions)),
            (read.rewards, np.array(episode.rewards)),
            (read.terminations, np.array(episode.terminated)),
            (read.truncations, np.array(episode.truncated)),
        ]
        if not all(_is_equal(*pair) for pair in pairs):
            raise ScilabRLError(f"Minari reads another episode {index} than was written.")


def _card(agent: Agent, summary: EvaluationSummary, seed: int | None) -> str:
    fingerprint = recorded_fingerprint(agent.run) or "not recorded"
    return (
        f"{summary.n_episodes} episodes of {agent.cfg.algorithm.name} in {agent.cfg.env}, by its "
        f"most likely actions: {summary}. Run {agent.run}, policy {agent.policy.name}, seed "
        f"{agent.unseen_seed if seed is None else seed} of the episodes. Fingerprint of the "
        f"environment: {fingerprint}. Written by Scilab-RL."
    )


def requirements() -> list[str]:
    """Return the packages that made the episodes, with their versions."""
    found = []
    for package in _PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            found.append(f"{package}=={metadata.version(package)}")
    return found


def _infos(episode: RecordedEpisode) -> dict[str, list[bool]] | None:
    """Return success after each step, and before the first one."""
    if all(success is None for success in episode.success):
        return None
    return {"success": [False, *(bool(success) for success in episode.success)]}


def _copied(observation: Observation) -> Observation:
    if isinstance(observation, dict):
        return {key: np.array(value) for key, value in observation.items()}
    return np.array(observation)


def _stacked(values: list[Any]) -> Any:
    if isinstance(values[0], dict):
        return {key: np.stack([value[key] for value in values]) for key in values[0]}
    return np.stack(values)


def _is_equal(one: Any, other: Any) -> bool:
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(_is_equal(one[key], other[key]) for key in one)
    return np.array_equal(one, other)
