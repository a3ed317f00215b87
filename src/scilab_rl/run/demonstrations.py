"""Demonstrations for off-policy learning: where they come from, and into which ring they go.

Vecerik et al., 2017, arXiv 1707.08817, and Nair et al., 2018, arXiv 1709.10089, keep demonstrations
next to what the agent experiences, and draw a share of each batch from them. Here they lie in a
ring of the hindsight replay buffer. They are collected once, before the first step; a checkpoint
has them, so that a resumed run needs neither their source nor the time.

The data set of an offline algorithm takes the same way; it is all that there is to draw from.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from scilab_rl.config.schema import RunConfig
from scilab_rl.errors import ConfigError, MissingDependencyError, did_you_mean
from scilab_rl.learning.arguments import DATA, DEMOS
from scilab_rl.metrics.success import success_of
from scilab_rl.run.controllers import RANDOM, SCRIPTED, Step, controlled_env, play_episode
from scilab_rl.seeding import derive_seed

if TYPE_CHECKING:  # heavy
    import gymnasium as gym

    from scilab_rl.envs.scripted import Controller
    from scilab_rl.learning.algorithm import Algorithm
    from scilab_rl.learning.replay import HindsightReplayBuffer

HUMAN = "human"
_EXAMPLES = {
    SCRIPTED: "scripted:100", RANDOM: "random:100", "run": "run:RUN:100", "minari": "minari:ID",
    HUMAN: "human:FILE",
}  # fmt: skip
_DATA_KINDS = tuple(_EXAMPLES)
_DEMO_KINDS = tuple(kind for kind in _EXAMPLES if kind != RANDOM)
_SETTINGS = ("source", "share")
_N_EPISODES = 100  # of a run, by default
_MOST_TRIES = 50  # per demonstration: what succeeds so rarely is not one
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class DemoSettings:
    """The key ``algorithm.demos``, or ``algorithm.data`` of an offline algorithm.

    Attributes:
        kind: ``scripted``, ``run``, ``minari``, ``human`` or, as data, ``random``.
        name: Of the run, the data set or the file.
        n_episodes: How many; 0: all of a data set of Minari, or of a file.
        share: Of each batch. Data are all of it, and their failures count too.
    """

    kind: str
    name: str
    n_episodes: int
    share: float

    @property
    def is_data_set(self) -> bool:
        """Whether there is nothing else to learn from."""
        return self.share == 1

    @property
    def key(self) -> str:
        """What the user has set."""
        return f"algorithm.{DATA if self.is_data_set else DEMOS}"


def parse_demos(chosen: object) -> DemoSettings:
    """Read ``algorithm.demos``: a source, or a mapping with ``source`` and ``share``.

    Raises:
        ConfigError: If it is neither.

    >>> parse_demos("scripted:100")
    DemoSettings(kind='scripted', name='', n_episodes=100, share=0.5)
    >>> parse_demos({"source": "run:agent:FetchPush:20", "share": 0.25})
    DemoSettings(kind='run', name='agent:FetchPush', n_episodes=20, share=0.25)
    """
    settings = dict(chosen) if isinstance(chosen, Mapping) else {"source": chosen}
    for key in settings:
        if key not in _SETTINGS:
            raise ConfigError(
                f"There is no algorithm.demos.{key}.{did_you_mean(str(key), _SETTINGS)} There are "
                "source and share."
            )
    share = settings.get("share", 0.5)
    if isinstance(share, bool) or not isinstance(share, (int, float)) or not 0 < share < 1:
        raise ConfigError(
            f"algorithm.demos.share must be a number between 0 and 1, but it is {share!r}."
        )
    return _parse_source("algorithm.demos", settings.get("source"), _DEMO_KINDS, float(share))


def parse_data(source: object) -> DemoSettings:
    """Read ``algorithm.data``: the source of a data set.

    Raises:
        ConfigError: If it is none.

    >>> parse_data("random:100")
    DemoSettings(kind='random', name='', n_episodes=100, share=1.0)
    """
    return _parse_source("algorithm.data", source, _DATA_KINDS, 1.0)


def _parse_source(key: str, given: object, kinds: Sequence[str], share: float) -> DemoSettings:
    source = str(given)
    kind, _, rest = source.partition(":")
    name, _, number = rest.rpartition(":")
    has_name = kind not in (SCRIPTED, RANDOM)
    if has_name and not (name and number.isdigit()):
        name, number = rest, str(_N_EPISODES if kind == "run" else 0)
    is_whole = number.isdigit() and (kind in ("minari", HUMAN) or int(number) > 0)
    if kind not in kinds or not rest or not is_whole or (name and not has_name):
        examples = [_EXAMPLES[kind] for kind in kinds]
        raise ConfigError(
            f"{key} must be {', '.join(examples[:-1])} or {examples[-1]}, but it is {source!r}."
            f"{did_you_mean(kind, kinds)}"
        )
    return DemoSettings(kind, name, int(number), share)


def chosen_source(cfg: RunConfig, algorithm: Algorithm) -> DemoSettings | None:
    """Return the demonstrations or the data set that a configuration names.

    Raises:
        ConfigError: If an offline algorithm is given no data.
    """
    arguments = cfg.algorithm.arguments
    if not getattr(algorithm, "learns_offline", False):
        return None if arguments.get(DEMOS) is None else parse_demos(arguments[DEMOS])
    if arguments.get(DATA) is None:
        raise ConfigError(
            f"{cfg.algorithm.name} learns from a data set alone; name one: algorithm.data="
            f"{' or '.join(_EXAMPLES.values())}."
        )
    return parse_data(arguments[DATA])


def prepare_demos(cfg: RunConfig, algorithm: Algorithm) -> None:
    """Make an empty ring for the demonstrations that a configuration names, if it names any.

    Raises:
        ConfigError: If the algorithm or the environment cannot use them.
    """
    from scilab_rl.learning.replay import HindsightReplayBuffer

    settings, buffer = chosen_source(cfg, algorithm), getattr(algorithm, "replay_buffer", None)
    if settings is None:
        return
    if not isinstance(buffer, HindsightReplayBuffer):
        raise ConfigError(
            f"algorithm.demos needs our own hindsight replay, which {cfg.algorithm.name} does not "
            f"have in {cfg.env}; use an environment with goals and "
            "++algorithm.replay_buffer_class=auto, or algorithm.demos=null."
        )
    seed = derive_seed(cfg.seed, "demos")
    buffer.use_demos(_n_rows(settings, cfg, algorithm), settings.share, seed)


def collect_demos(cfg: RunConfig, algorithm: Algorithm) -> None:
    """Fill the ring of `prepare_demos`, if there is one.

    Raises:
        ConfigError: If the source does not exist or gives too few demonstrations.
    """
    ring = getattr(getattr(algorithm, "replay_buffer", None), "demos", None)
    if ring is None:
        return
    settings, n_episodes, n_steps = chosen_source(cfg, algorithm), 0, 0
    assert settings is not None  # the ring was made for it
    for episode in _episodes(settings, cfg):
        for step in episode:
            _store(ring, algorithm, step)
        ring.truncate_last_trajectory()
        n_episodes, n_steps = n_episodes + 1, n_steps + len(episode)
    if not n_episodes:
        raise ConfigError(f"{settings.key}: '{settings.name}' has no episode that can be used.")
    normalizer = getattr(algorithm, "normalizer", None)
    if normalizer is not None:
        normalizer.update(ring.rows[: n_steps + n_episodes, 0])
    _log.info(
        "%s: %d episodes with %d steps from %s.", settings.key, n_episodes, n_steps, settings.kind
    )


def _n_rows(settings: DemoSettings, cfg: RunConfig, algorithm: Algorithm) -> int:
    """Return how many rows the demonstrations take at most."""
    from scilab_rl.learning.compatibility import longest_episode

    if settings.kind == "minari":
        data = _data_set(settings.name)
        return int(data.total_steps + data.total_episodes)
    if settings.kind == HUMAN:
        from scilab_rl.run.played import read_played

        return sum(len(episode.keys) + 1 for episode in read_played(settings.name, cfg))
    longest = longest_episode(algorithm.get_env())
    if longest is None:
        raise ConfigError(
            f"{settings.key} needs episodes with a step limit, and this environment has none; add "
            "+env_kwargs.max_episode_steps=N."
        )
    return settings.n_episodes * (longest + 1)


def _store(ring: HindsightReplayBuffer, algorithm: Any, step: Step) -> None:
    from scilab_rl.canonical_spaces import conversions
    from scilab_rl.learning.observations import batch_of_one

    actions = conversions(algorithm.get_env())[0].from_env(np.asarray(step.action)[None])
    if hasattr(algorithm, "from_env_actions"):
        actions = algorithm.from_env_actions(actions)
    elif hasattr(algorithm.action_space, "low"):  # of Stable-Baselines3
        actions = algorithm.policy.scale_action(actions)
    info = {**step.info, "TimeLimit.truncated": step.truncated and not step.terminated}
    observation: Any = batch_of_one(step.observation)
    next_observation: Any = batch_of_one(step.next_observation)
    done = np.array([step.terminated or step.truncated])
    ring.add(observation, next_observation, actions, np.array([step.reward]), done, [info])


def _episodes(settings: DemoSettings, cfg: RunConfig) -> Iterator[list[Step]]:
    if settings.kind == "minari":
        yield from _stored_episodes(settings)
        return
    if settings.kind == HUMAN:
        yield from _played_episodes(settings, cfg)
        return
    seed = derive_seed(cfg.seed, "demos")
    name = settings.name or settings.kind
    with controlled_env(name, cfg, seed, key=settings.key) as (env, controller):
        if settings.is_data_set:
            yield from _all_episodes(settings, env, controller, seed)
        else:
            yield from _successes(settings, env, controller, seed)


def _all_episodes(
    settings: DemoSettings, env: gym.Env, controller: Controller, seed: int
) -> Iterator[list[Step]]:
    n_successes = 0
    for index in range(settings.n_episodes):
        episode = play_episode(env, controller, None if index else seed)
        n_successes += bool(success_of(episode[-1].info))
        yield episode
    _log.info("%d of %d episodes were successful.", n_successes, settings.n_episodes)


def _successes(
    settings: DemoSettings, env: gym.Env, controller: Controller, seed: int
) -> Iterator[list[Step]]:
    """Yield episodes that end in success; all of them where the task does not report it."""
    n_found = 0
    for n_tries in range(1, _MOST_TRIES * settings.n_episodes + 1):
        episode = play_episode(env, controller, seed if n_tries == 1 else None)
        if success_of(episode[-1].info) is False:
            continue
        yield episode
        n_found += 1
        if n_found == settings.n_episodes:
            _log.info("%d of %d episodes were successful.", n_found, n_tries)
            return
    raise ConfigError(
        f"algorithm.demos: only {n_found} of {n_tries} episodes were successful, and "
        f"{settings.n_episodes} demonstrations are wanted; take another source."
    )


def _played_episodes(settings: DemoSettings, cfg: RunConfig) -> Iterator[list[Step]]:
    from scilab_rl.run.played import play_again

    for number, episode in enumerate(play_again(settings.name, cfg)):
        if settings.n_episodes and number == settings.n_episodes:
            return
        if settings.is_data_set or success_of(episode[-1].info) is not False:
            yield episode


def _data_set(name: str) -> Any:
    """Return a Minari data set that is on this machine.

    Raises:
        ConfigError: If it is not here.
        MissingDependencyError: If Minari is not installed.
    """
    try:
        import minari

        return minari.load_dataset(name)
    except ImportError as error:  # Minari, or what reads its files
        raise MissingDependencyError("minari", "minari", "to read demonstrations") from error
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"There is no Minari data set '{name}' on this machine; get it with: "
            f"minari download {name}"
        ) from error


def _stored_episodes(settings: DemoSettings) -> Iterator[list[Step]]:
    for number, episode in enumerate(_data_set(settings.name).iterate_episodes()):
        if settings.n_episodes and number == settings.n_episodes:
            return
        observations = episode.observations
        if not isinstance(observations, dict) or "desired_goal" not in observations:
            raise ConfigError(
                f"{settings.key}: the observations of '{settings.name}' have no goals."
            )
        rows = [
            {key: observations[key][i] for key in ("observation", "achieved_goal", "desired_goal")}
            for i in range(len(episode.actions) + 1)
        ]
        yield [
            Step(rows[i], action, float(episode.rewards[i]), bool(episode.terminations[i]),
                 bool(episode.truncations[i]), {}, rows[i + 1])
            for i, action in enumerate(episode.actions)
        ]  # fmt: skip
