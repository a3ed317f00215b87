"""The environments of Scilab-RL, and the long ids that name their variants.

The variants of a maze are not thousands of registered ids: the name is read, and this one variant
is registered on request, also that of ``gymnasium.make``. Variants that are few, such as
``Blocks-o2-gripper_above-v1``, are registered from the beginning, so that lists have them.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias

from gymnasium.envs import registration
from gymnasium.envs.registration import EnvSpec

from scilab_rl.errors import ConfigError, nearest_word

Arguments: TypeAlias = dict[str, Any]
_VERSION = r"(?:-v\d+)?"


@dataclass(frozen=True)
class Family:
    """One environment with its variants.

    Attributes:
        env_id: The registered id.
        entry_point: ``module:Class``.
        max_episode_steps: Step limit of the registered id; None where the task itself ends.
        grammar: What the names of its variants look like, for people.
        pattern: The same as a regular expression; its groups are keyword arguments.
        read: Turns the groups into keyword arguments and, under ``max_episode_steps``, the limit.
        variants: Names of the variants, without version, where they are few: those are registered
            from the beginning, for Gymnasium's lists.
    """

    env_id: str
    entry_point: str
    max_episode_steps: int | None
    grammar: str = ""
    pattern: str = "(?!)"
    read: Callable[[Mapping[str, str]], Arguments] = field(default=lambda groups: {})
    variants: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The id without its version."""
        return self.env_id.rpartition("-v")[0]

    @property
    def version(self) -> str:
        """The version, as in ``v1``."""
        return self.env_id.rpartition("-")[2]


def _read_blocks(groups: Mapping[str, str]) -> Arguments:
    n_blocks = int(groups["n_blocks"])
    return {
        "n_blocks": n_blocks,
        "gripper_goal": groups["gripper_goal"],
        "max_episode_steps": 50 * max(1, n_blocks),
    }


def _read_hook(groups: Mapping[str, str]) -> Arguments:
    n_blocks = int(groups["n_blocks"])
    return {"n_blocks": n_blocks, "max_episode_steps": 50 if n_blocks == 0 else 100 * n_blocks}


def _read_buttons(groups: Mapping[str, str]) -> Arguments:
    n_buttons = int(groups["n_buttons"])
    return {"n_buttons": n_buttons, "max_episode_steps": 50 * (n_buttons + 1)}


def _read_maze(groups: Mapping[str, str]) -> Arguments:
    continues = groups["continuing"] == "1"
    whole = {name: int(groups[name]) for name in ("frame_skip", "n_objects") if name in groups}
    return {
        "maze_map": groups["maze_map"],
        "reward_type": groups["reward_type"],
        "threshold": float(groups["threshold"]),
        "continuing": continues,
        # An episode that ends at the goal has no use for another one: rt1 has no effect then.
        "reset_target": continues and groups["reset_target"] == "1",
        **whole,
        "max_episode_steps": int(groups["max_episode_steps"]),
    }


def _read_bandit(groups: Mapping[str, str]) -> Arguments:
    return {"schedule": groups["schedule"], "n_arms": int(groups["n_arms"])}


_MAPS = ("open", "open_dg", "open_dgr", "small_open_dg", "small_open_dgr", "medium_custom_dgr")
_REWARDS = ("sparse", "sparseneg", "dense")
_REWARD = rf"-(?P<reward_type>{'|'.join(_REWARDS)})"
_PLACE = (
    r"-(?P<threshold>\d+(?:\.\d*)?|\.\d+)"
    rf"-(?P<maze_map>{'|'.join(_MAPS)})"
    r"-c(?P<continuing>[01])-rt(?P<reset_target>[01])-s(?P<max_episode_steps>[1-9]\d*)"
)
_PLACE_GRAMMAR = f"THRESHOLD-MAP-c{{0,1}}-rt{{0,1}}-sSTEPS-v0, MAP one of {', '.join(_MAPS)}"
_REWARD_GRAMMAR = f"{{{','.join(_REWARDS)}}}"
_GRIPPERS = ("gripper_none", "gripper_random", "gripper_above")
_BLOCKS = tuple(f"Blocks-o{n}-{goal}" for n in range(1, 5) for goal in _GRIPPERS)
_SCHEDULES = ("static", "reversal", "drifting")

FAMILIES = (
    Family("Reach1DOF-v0", "scilab_rl.envs.reach_1dof:Reach1DOF", 50),
    Family(
        "Blocks-v1",
        "scilab_rl.envs.blocks:Blocks",
        50,
        "Blocks-o{0..4}-gripper_{none,random,above}-v1, with o0 only gripper_random",
        r"Blocks-(?!o0-gripper_(?:none|above))"
        r"o(?P<n_blocks>[0-4])-gripper_(?P<gripper_goal>none|random|above)",
        _read_blocks,
        ("Blocks-o0-gripper_random", *_BLOCKS),
    ),
    Family("CoppeliaReach-v0", "scilab_rl.envs.coppeliasim_tasks:CoppeliaReach", 50),
    Family("CoppeliaDrive-v0", "scilab_rl.envs.coppeliasim_tasks:CoppeliaDrive", 100),
    Family("CueMemory-v0", "scilab_rl.envs.cue_memory:CueMemory", 100),
    Family(
        "Hook-v1",
        "scilab_rl.envs.hook:Hook",
        100,
        "Hook-o{0..2}-v1",
        r"Hook-o(?P<n_blocks>[0-2])",
        _read_hook,
        tuple(f"Hook-o{n}" for n in range(3)),
    ),
    Family(
        "ButtonUnlock-v1",
        "scilab_rl.envs.button_unlock:ButtonUnlock",
        100,
        "ButtonUnlock-o{0..2}-v1",
        r"ButtonUnlock-o(?P<n_buttons>[0-2])",
        _read_buttons,
        tuple(f"ButtonUnlock-o{n}" for n in range(3)),
    ),
    Family(
        "PointGym-v0",
        "scilab_rl.envs.mazes:PointMaze",
        500,
        f"PointGym-{_REWARD_GRAMMAR}-{_PLACE_GRAMMAR}",
        f"PointGym{_REWARD}{_PLACE}",
        _read_maze,
    ),
    Family(
        "PointObjGym-v0",
        "scilab_rl.envs.mazes:PointObjMaze",
        300,
        f"PointObjGym-{_REWARD_GRAMMAR}-o{{0..8}}-{_PLACE_GRAMMAR}",
        rf"PointObjGym{_REWARD}-o(?P<n_objects>[0-8]){_PLACE}",
        _read_maze,
    ),
    Family(
        "AntGym-v0",
        "scilab_rl.envs.mazes:AntMaze",
        500,
        f"AntGym-{_REWARD_GRAMMAR}-FRAME_SKIP-{_PLACE_GRAMMAR}",
        rf"AntGym{_REWARD}-(?P<frame_skip>[1-9]\d*){_PLACE}",
        _read_maze,
    ),
    Family(
        "Bandit-v0",
        "scilab_rl.envs.choices.bandit:Bandit",
        None,
        f"Bandit-{{{','.join(_SCHEDULES)}}}-a{{2..10}}-v0",
        rf"Bandit-(?P<schedule>{'|'.join(_SCHEDULES)})-a(?P<n_arms>[2-9]|10)",
        _read_bandit,
    ),
    Family("ProbabilisticReversal-v0", "scilab_rl.envs.choices.bandit:ProbabilisticReversal", None),
    Family("TwoStep-v0", "scilab_rl.envs.choices.two_step:TwoStep", None),
    Family("Horizon-v0", "scilab_rl.envs.choices.horizon:Horizon", None),
    Family("HiddenGoal-v0", "scilab_rl.envs.choices.hidden_goal:HiddenGoal", None),
)


_WORDS = (*(f.name for f in FAMILIES if f.grammar), *_MAPS, *_REWARDS, *_GRIPPERS, *_SCHEDULES)


def register_shipped() -> None:
    """Make the ids known; nothing is imported before one of them is made."""
    _let_gymnasium_read_long_ids()
    for family in FAMILIES:
        if family.env_id not in registration.registry:
            registration.register(
                family.env_id,
                entry_point=family.entry_point,
                max_episode_steps=family.max_episode_steps,
            )
        for name in family.variants:
            register_variant(name)


def is_variant(env_id: str) -> bool:
    """Return whether an id names a variant of one of our environments."""
    return any(f.grammar and env_id.startswith(f"{f.name}-") for f in FAMILIES) and not any(
        env_id == family.env_id for family in FAMILIES
    )


def register_variant(name: str) -> tuple[str, str] | None:
    """Register the variant that a long id names.

    Args:
        name: For example ``Blocks-o0-gripper_random-v1``; another version or none means ours.

    Returns:
        The id and a notice of one line about its meaning, or None when it names no variant.

    Raises:
        ConfigError: If it begins like a variant and is none.
    """
    for family in FAMILIES:
        if not family.grammar or not name.startswith(f"{family.name}-"):
            continue
        if re.fullmatch(rf"{family.name}-v\d+", name):
            return None
        match = re.fullmatch(family.pattern + _VERSION, name)
        if match is None:
            raise ConfigError(
                f"No environment '{name}'.{_did_you_mean(name)} Its variants are {family.grammar}."
            )
        env_id = f"{re.sub(_VERSION + '$', '', name)}-{family.version}"
        return env_id, _register(family, env_id, family.read(match.groupdict()))
    if name not in registration.registry and (suggestion := _did_you_mean(name)):
        raise ConfigError(f"No environment '{name}'.{suggestion}")
    return None


@functools.cache
def _let_gymnasium_read_long_ids() -> None:
    """Let ``gymnasium.make`` and ``make_vec`` register the variant that they are given, once.

    Gymnasium asks nobody about an id that it does not know. This is the one function with which
    both look an id up.
    """
    find_spec = registration._find_spec

    @functools.wraps(find_spec)
    def find_spec_or_variant(env_id: str) -> EnvSpec:
        name = env_id.rpartition(":")[2]
        if name in registration.registry:
            return find_spec(env_id)
        variant = register_variant(name)
        return find_spec(env_id if variant is None else variant[0])

    registration._find_spec = find_spec_or_variant


def _did_you_mean(name: str) -> str:
    """Return a suggestion with each misspelled word of a long id put right, if there is one."""
    right = "-".join(nearest_word(word, _WORDS) or word for word in name.split("-"))
    if right != name and any(re.fullmatch(f.pattern + _VERSION, right) for f in FAMILIES):
        return f" Did you mean '{right}'?"
    return ""


def _register(family: Family, env_id: str, arguments: Arguments) -> str:
    limit = arguments.pop("max_episode_steps", family.max_episode_steps)
    if env_id not in registration.registry:
        registration.register(env_id, family.entry_point, max_episode_steps=limit, kwargs=arguments)
    meaning = ", ".join(f"{key}={value}" for key, value in arguments.items())
    steps = "" if limit is None else f", {limit} steps"
    return f"{env_id} is {family.env_id} with {meaning}{steps}."
