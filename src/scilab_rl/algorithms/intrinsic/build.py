"""From ``intrinsic: rnd`` in a configuration to a reward that an algorithm learns from.

One-file algorithms have a parameter ``intrinsic`` and call `make_intrinsic_reward`. Off-policy
algorithms of Stable-Baselines3 need not be changed: they learn from what their replay buffer
samples, and `with_intrinsic_reward` makes a buffer of the same kind whose samples carry the mixed
reward. It is computed at sampling, with the models of that moment, and so also for the goals that
hindsight replay puts in.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Mapping
from typing import Any

import torch
from stable_baselines3.common.buffers import ReplayBuffer

from scilab_rl.algorithms.intrinsic.agents import make_agent_view
from scilab_rl.algorithms.intrinsic.base import IntrinsicReward
from scilab_rl.config.workspace import PROJECT_ALGORITHMS
from scilab_rl.errors import ConfigError, did_you_mean, listing
from scilab_rl.learning.values import constructor_parameters
from scilab_rl.seeding import derive_seed

_HERE, _PROJECT = "scilab_rl.algorithms.intrinsic", "custom_algorithms"
INTRINSIC_REWARDS = {
    "critic_variance": f"{_HERE}.critic_variance.CriticVariance",
    "disagreement": f"{_HERE}.disagreement.Disagreement",
    "icm": f"{_HERE}.icm.IntrinsicCuriosityModule",
    "morphological": f"{_HERE}.morphological.MorphologicalComputation",
    "rnd": f"{_HERE}.rnd.RandomNetworkDistillation",
}


def make_intrinsic_reward(
    chosen: str | Mapping[str, object] | None, algorithm: Any
) -> IntrinsicReward | None:
    """Make the intrinsic reward that a configuration names.

    Call it last in an algorithm's constructor. The global random generators stay as they are.

    Args:
        chosen: A name, a mapping with ``name`` and settings, or None.
        algorithm: The algorithm to be rewarded.

    Raises:
        ConfigError: If there is no such reward or setting, or it does not fit the algorithm.
    """
    if chosen is None:
        return None
    settings = {"name": chosen} if isinstance(chosen, str) else dict(chosen)
    name = settings.pop("name", None)
    cls = intrinsic_reward_class(name)
    _check_settings(str(name), cls, settings)
    seed = derive_seed(algorithm.seed or 0, "intrinsic")
    # The weights are drawn on the CPU.
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)
        return cls(make_agent_view(algorithm), seed=seed, **settings)


def intrinsic_reward_class(name: object) -> type[IntrinsicReward]:
    """Return the class of a shipped reward, or of a project's own.

    Args:
        name: ``rnd``; ``my_curiosity`` for ``custom_algorithms.my_curiosity.MyCuriosity``, or such
            a path.

    Raises:
        ConfigError: If there is none.
    """
    path = INTRINSIC_REWARDS.get(str(name), name)
    if isinstance(path, str) and (PROJECT_ALGORITHMS / f"{path}.py").is_file():
        words = (word.capitalize() for word in path.split("_"))
        path = f"{_PROJECT}.{path}.{''.join(words)}"
    if isinstance(path, str) and path.startswith((_HERE, f"{_PROJECT}.")):
        module, _, cls_name = path.rpartition(".")
        try:
            cls = getattr(importlib.import_module(module), cls_name)
        except (ImportError, AttributeError) as error:
            raise ConfigError(f"algorithm.intrinsic: '{name}' cannot be found: {error}.") from error
        if isinstance(cls, type) and issubclass(cls, IntrinsicReward):
            return cls
        raise ConfigError(f"algorithm.intrinsic: '{name}' is not a subclass of IntrinsicReward.")
    raise ConfigError(
        f"algorithm.intrinsic must name an intrinsic reward, but it is {name!r}."
        f"{did_you_mean(str(name), INTRINSIC_REWARDS)} There are: {listing(INTRINSIC_REWARDS)}; "
        "with settings: algorithm.intrinsic={name: rnd, weight: 0.5}."
    )


def allowed_settings(cls: type[IntrinsicReward]) -> list[str]:
    """Return the settings of a reward: its own first, then those that all have."""
    return [
        parameter.name
        for parameter in constructor_parameters(cls).values()
        if parameter.kind is parameter.KEYWORD_ONLY and parameter.name != "seed"
    ]


class _IntrinsicReward:
    """A replay buffer, mixed in before its class, whose samples carry the intrinsic reward."""

    intrinsic: IntrinsicReward | None = None

    def sample(self, *args: Any, **kwargs: Any) -> Any:
        """Sample transitions and mix the intrinsic reward into theirs."""
        batch = super().sample(*args, **kwargs)  # type: ignore[misc]
        return batch if self.intrinsic is None else self.intrinsic.apply(batch)


@functools.cache
def with_intrinsic_reward(buffer_class: type[ReplayBuffer]) -> type[ReplayBuffer]:
    """Return a kind of replay buffer whose samples carry the intrinsic reward."""
    return type(f"IntrinsicReward{buffer_class.__name__}", (_IntrinsicReward, buffer_class), {})


def attach_intrinsic_reward(algorithm: Any, chosen: str | Mapping[str, object]) -> None:
    """Let an off-policy algorithm of Stable-Baselines3 learn from an intrinsic reward too.

    Args:
        algorithm: Built with a replay buffer of `with_intrinsic_reward`.
        chosen: As for `make_intrinsic_reward`.
    """
    algorithm.intrinsic = make_intrinsic_reward(chosen, algorithm)
    algorithm.replay_buffer.intrinsic = algorithm.intrinsic


def _check_settings(name: str, cls: type[IntrinsicReward], settings: Mapping[str, object]) -> None:
    allowed = allowed_settings(cls)
    for setting, value in settings.items():
        if setting not in allowed:
            raise ConfigError(
                f"The intrinsic reward '{name}' has no setting '{setting}'."
                f"{did_you_mean(str(setting), allowed)} It has: {listing(allowed)}."
            )
        if setting == "weight" and not isinstance(value, (int, float)):
            raise ConfigError(
                f"algorithm.intrinsic.weight must be from 0 to 1, but it is {value!r}."
            )
