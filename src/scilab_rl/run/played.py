"""What people have played, played again: the seed and their keys lead to the same steps."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from scilab_rl.config.schema import RunConfig
from scilab_rl.envs.scripted import Controller
from scilab_rl.errors import ConfigError
from scilab_rl.run.controllers import Step, play_episode
from scilab_rl.run.human import SETTINGS_FILE, TRIALS, episode_seed, options_of


@dataclass(frozen=True)
class PlayedEpisode:
    """What a person did in an episode that has ended.

    Attributes:
        seed: Of its reset.
        keys: One per step, as browsers name them.
        rewards: One per step.
    """

    seed: int
    keys: Sequence[str]
    rewards: Sequence[float]


class Repeated(Controller):
    """Takes actions that are known, one after the other."""

    def __init__(self, actions: Sequence[Any]) -> None:
        self._actions = iter(actions)

    def act(self, observation: Any) -> Any:
        """Return the next action.

        Raises:
            StopIteration: If there are no more.
        """
        return next(self._actions)


def read_played(source: str, cfg: RunConfig) -> list[PlayedEpisode]:
    """Read the episodes that ended from the table of ``scilab-rl human``.

    Args:
        source: The table, or its folder.
        cfg: Names the environment that was played.

    Raises:
        ConfigError: If there is no such table, or it is one of another environment.
    """
    path = Path(source)
    path = path / f"{TRIALS}.csv" if path.is_dir() else path
    try:
        played = json.loads((path.parent / SETTINGS_FILE).read_text(encoding="utf-8"))
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"'{source}' is no table of `scilab-rl human` with its {SETTINGS_FILE}: {error}"
        ) from error
    if (played["env"], played["env_kwargs"]) != (cfg.env, dict(cfg.env_kwargs)):
        raise ConfigError(
            f"'{source}' was played in {played['env']}, which is not {cfg.env} with these "
            "env_kwargs; name a table of the same environment."
        )
    # Participants may have played at the same time: their rows then alternate.
    rows.sort(key=lambda row: (row["participant_id"], int(row["episode"]), int(row["step"])))
    episodes = []
    for (code, number), group in groupby(rows, lambda r: (r["participant_id"], int(r["episode"]))):
        steps = list(group)
        if "True" in (steps[-1]["terminated"], steps[-1]["truncated"]):
            seed = episode_seed(int(steps[0]["run_seed"]), code, TRIALS, number)
            rewards = [float(step["reward"]) for step in steps]
            episodes.append(PlayedEpisode(seed, [step["key"] for step in steps], rewards))
    return episodes


def play_again(source: str, cfg: RunConfig) -> Iterator[list[Step]]:
    """Yield the steps of what was played, with observations as an agent gets them.

    Raises:
        ConfigError: If the environment now does something else, or as `read_played`.
    """
    from scilab_rl.envs.vectorize import make_single_env

    env = make_single_env(cfg)
    try:
        actions = {option.key: option.action for option in options_of(env)}
        for episode in read_played(source, cfg):
            known = Repeated([actions[key] for key in episode.keys])
            try:
                steps = play_episode(env, known, episode.seed)
            except StopIteration:
                steps = []
            if [step.reward for step in steps] != list(episode.rewards):
                raise ConfigError(
                    f"'{source}': {cfg.env} does not do again what was played in it, so that the "
                    "steps are not known; it has changed since."
                )
            yield steps
    finally:
        env.close()
