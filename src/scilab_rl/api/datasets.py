"""Data sets of a task for offline learning: by an agent, with noise, by a script, by chance."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scilab_rl.analysis.estimates import Estimate, success_interval
from scilab_rl.api.minari_data import (
    Origin,
    RecordedEpisode,
    claim_id,
    id_of,
    requirements,
    write_episodes,
)
from scilab_rl.config.schema import RunConfig
from scilab_rl.metrics.success import success_of
from scilab_rl.run.controllers import (
    RANDOM,
    SCRIPTED,
    RandomActions,
    Step,
    controlled_env,
    play_episode,
)
from scilab_rl.run.provenance import fingerprint_of
from scilab_rl.seeding import derive_seed

EXPERT, MEDIUM = "expert", "medium"
KINDS = (EXPERT, MEDIUM, SCRIPTED, RANDOM)


@dataclass(frozen=True)
class DatasetSettings:
    """What a data set is made of.

    Attributes:
        cfg: Names the environment.
        kind: ``expert``: an agent's most likely actions; ``medium``: the same with a share of
            random ones; ``scripted``: a controller; ``random``: chance.
        agent: A run or ``agent:NAME``, for expert and medium.
        n_episodes: How many episodes; failures are kept.
        random_share: Share of uniformly random actions of ``medium``.
        seed: Of the episodes.
        license: For example ``MIT``.
    """

    cfg: RunConfig
    kind: str
    agent: str
    n_episodes: int = 1000
    random_share: float = 0.5
    seed: int = 0
    license: str = "MIT"

    @property
    def policy(self) -> str:
        """Who acts, in words."""
        by_agent = f"the most likely actions of {self.agent}"
        return {
            EXPERT: by_agent,
            MEDIUM: f"{by_agent}, {self.random_share:g} of them replaced by uniformly random ones",
            SCRIPTED: "the scripted controller of the task",
            RANDOM: "uniformly random actions",
        }[self.kind]


def write_dataset(settings: DatasetSettings) -> tuple[Path, Estimate | None]:
    """Play episodes and write them as a Minari data set with a card.

    Returns:
        The data set's folder, and the share of its episodes that ended in success, with Wilson's
        95 % interval; None for a task without success.

    Raises:
        MissingDependencyError: If Minari is not installed.
        ConfigError: If there is no such controller, or such a data set is there already.
        ScilabRLError: If Minari does not read what was written.
    """
    dataset_id = id_of(settings.cfg.env, settings.kind)
    target = claim_id(dataset_id)
    seed = derive_seed(settings.seed, f"dataset/{settings.kind}")
    name = settings.agent if settings.kind in (EXPERT, MEDIUM) else settings.kind
    with controlled_env(name, settings.cfg, seed, key="dataset") as (env, controller):
        fingerprint = fingerprint_of(env) or "not recorded"
        if settings.kind == MEDIUM:
            controller = RandomActions(env, seed, settings.random_share, controller)
        episodes = [
            _recorded(play_episode(env, controller, None if index else seed))
            for index in range(settings.n_episodes)
        ]
        origin = Origin(settings.cfg, env.observation_space, env.action_space, settings.kind)
    outcomes = [episode.success[-1] for episode in episodes]
    success = None
    if None not in outcomes:
        success = success_interval(sum(map(bool, outcomes)), len(outcomes))
    page = "\n".join(_page(dataset_id, settings, episodes, success, fingerprint)) + "\n"
    card = (
        f"{len(episodes)} episodes of {settings.cfg.env} by {settings.policy}; success {success}. "
        f"Seed {settings.seed}. Fingerprint of the environment: {fingerprint}. License: "
        f"{settings.license}. Written by Scilab-RL."
    )
    write_episodes(target, dataset_id, episodes, origin, card, page)
    return target, success


def _recorded(steps: Sequence[Step]) -> RecordedEpisode:
    return RecordedEpisode(
        observations=[steps[0].observation, *(step.next_observation for step in steps)],
        actions=[step.action for step in steps],
        rewards=[step.reward for step in steps],
        terminated=[step.terminated for step in steps],
        truncated=[step.truncated for step in steps],
        success=[success_of(step.info) for step in steps],
    )


def _page(
    dataset_id: str,
    settings: DatasetSettings,
    episodes: Sequence[RecordedEpisode],
    success: Estimate | None,
    fingerprint: str,
) -> Iterator[str]:
    """Yield the lines of the card."""
    returns = [sum(episode.rewards) for episode in episodes]
    rows = [
        ("environment", f"`{settings.cfg.env}`"),
        ("policy", settings.policy),
        ("episodes", f"{len(episodes):,}, failures included"),
        ("steps", f"{sum(len(episode.rewards) for episode in episodes):,}"),
        ("success", f"{success} (at the end of an episode; Wilson's 95 % interval)"),
        ("return", f"{np.mean(returns):.4g} on average, {min(returns):.4g} to {max(returns):.4g}"),
        ("seed", str(settings.seed)),
        ("fingerprint", f"`{fingerprint}` of the environment"),
        ("versions", ", ".join(requirements())),
        ("license", settings.license),
    ]
    yield f"# {dataset_id}\n"
    yield "Written by `scilab-rl dataset`, from the episodes themselves; do not edit.\n"
    yield f'```python\nimport minari\n\ndata = minari.load_dataset("{dataset_id}")\n```\n'
    yield "| | |\n|---|---|"
    yield from (f"| {name} | {value} |" for name, value in rows)
