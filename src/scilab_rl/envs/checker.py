"""The checks that the doctor makes on an environment, in plain words."""

from __future__ import annotations

import itertools
import pickle
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

from scilab_rl.check_results import FAIL, INFO, OK, WARN, CheckResult
from scilab_rl.envs.fingerprint import fingerprint, scripted_action
from scilab_rl.envs.random_rollout import RandomRollout, random_rollout
from scilab_rl.envs.run_env import RunEnv
from scilab_rl.envs.stability import UNSTABLE_KEY, guard
from scilab_rl.relabeling import (
    INFO_KEYS,
    GoalFunction,
    answers_batches,
    for_batches,
    info_needs,
)

_GOAL_KEYS = ("observation", "achieved_goal", "desired_goal")
_SEED = 4321
_N_RESETS = 30
_MANY_TRIVIAL = 0.5
# Gymnasium's checker finds fault with what is usual: unbounded observations, no render mode, a
# method `seed` in addition to the seed of the reset.
_HARMLESS = (
    "infinity", "render", "not within the normal range", "symmetric and normalized",
    "different from", "`seed` function",
)  # fmt: skip


@dataclass
class CheckContext:
    """An environment that is being checked.

    Attributes:
        make: Makes another one just like it.
        env: With its step limit.
        rollout: A random policy's steps in it.
        known_fingerprints: Fingerprints that it is known to have.
        make_drawn: Makes one that can be drawn; None: pictures are not checked.
    """

    make: Callable[[], gym.Env]
    env: gym.Env
    rollout: RandomRollout
    known_fingerprints: tuple[str, ...] = ()
    make_drawn: Callable[[], RunEnv] | None = None

    @property
    def has_goals(self) -> bool:
        """Whether observations carry an achieved and a desired goal."""
        space = self.env.observation_space
        return isinstance(space, spaces.Dict) and all(key in space.spaces for key in _GOAL_KEYS)

    def compute(self, what: str) -> Any:
        """Return ``compute_reward`` or the like, of the environment or a wrapper, if there is one.

        Args:
            what: ``reward`` or ``terminated``.
        """
        name = f"compute_{what}"
        return self.env.get_wrapper_attr(name) if self.env.has_wrapper_attr(name) else None

    def answer(self, what: str) -> GoalFunction:
        """Return the same for batches of goals, as replay buffers ask it."""
        goals = self.rollout.goals("achieved_goal"), self.rollout.goals("desired_goal")
        return for_batches(self.compute(what), *goals, self.rollout.infos)


def check_environment(
    make: Callable[[], gym.Env],
    *,
    n_steps: int = 1000,
    known_fingerprints: Iterable[str] = (),
    make_drawn: Callable[[], RunEnv] | None = None,
) -> Iterator[CheckResult]:
    """Yield what is found, check by check; a check that itself breaks is a finding too.

    Args:
        make: Makes the environment, as ``gymnasium.make`` does.
        n_steps: Random steps on which rewards and endings are compared.
        known_fingerprints: Those that the environment may have.
        make_drawn: Makes one with ``render_mode="rgb_array"``; None: pictures are not checked.
    """
    env = guard(make())
    try:
        rollout = random_rollout(env, n_steps, _SEED)
    except Exception as error:  # noqa: BLE001 - a broken environment may raise anything
        yield CheckResult(
            "random steps", FAIL, f"{type(error).__name__}: {error}", "repair step/reset"
        )
        return
    context = CheckContext(make, env, rollout, tuple(known_fingerprints), make_drawn)
    for check in CHECKS if context.has_goals else PLAIN_CHECKS:
        try:
            yield from check(context)
        except Exception as error:  # noqa: BLE001 - as above
            name = check.__name__.removeprefix("check_").replace("_", " ")
            yield CheckResult(
                name, FAIL, f"{type(error).__name__}: {error}", "repair what raises this"
            )
    env.close()


def check_interface(context: CheckContext) -> Iterator[CheckResult]:
    """Run Gymnasium's own checker."""
    check, env = "Gymnasium's checker", context.make().unwrapped
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            check_env(env, skip_render_check=True)
        except Exception as error:  # noqa: BLE001 - it asserts, and calls code of the environment
            first = next(iter(str(error).splitlines()), type(error).__name__)
            yield CheckResult(check, FAIL, first, "see gymnasium.farama.org, 'Env'")
            return
        finally:
            env.close()
    complaints = [str(warning.message) for warning in caught]
    serious = [text for text in complaints if not any(word in text for word in _HARMLESS)]
    if serious:
        yield CheckResult(check, WARN, serious[0], "see gymnasium.farama.org, 'Env'")
    else:
        yield CheckResult(check, OK, "no complaint")


def check_goal_shapes(context: CheckContext) -> Iterator[CheckResult]:
    """Compare the goals' shapes with each other and observations with their space."""
    space: Any = context.env.observation_space
    achieved, desired = space["achieved_goal"].shape, space["desired_goal"].shape
    if achieved != desired:
        found = f"achieved_goal has shape {achieved}, desired_goal {desired}"
        yield CheckResult("goals", FAIL, found, "return both in the same shape")
        return
    outside = [o for o in context.rollout.observations if not space.contains(o)]
    if outside:
        found = f"{len(outside)} observations are outside of the observation space"
        yield CheckResult("goals", FAIL, found, "check keys, shapes, dtypes and bounds")
    else:
        yield CheckResult("goals", OK, f"achieved and desired, shape {achieved}")


def check_vectorised_reward(context: CheckContext) -> Iterator[CheckResult]:
    """Compare ``compute_reward`` of all transitions with the rewards of the steps."""
    record = context.rollout
    goals = record.goals("achieved_goal"), record.goals("desired_goal")
    answer = context.answer("reward")
    rewards = answer(*goals, record.infos)
    check, n_steps = "rewards of a batch", len(record.rewards)
    n_wrong = int((~np.isclose(rewards, record.rewards, atol=1e-6)).sum())
    if n_wrong:
        found = f"{n_wrong} of {n_steps} differ from the rewards of the steps"
        fix = "step() must return compute_reward(achieved_goal, desired_goal, info) of that step"
        yield CheckResult(check, FAIL, found, fix)
    elif not answers_batches(answer):
        found = "compute_reward answers for one goal at a time: replay buffers become slow"
        yield CheckResult(check, WARN, found, "compute over axis=-1, not over everything")
    else:
        yield CheckResult(check, OK, f"equal on {n_steps} steps")


def check_info_needs(context: CheckContext) -> Iterator[CheckResult]:
    """Tell what ``compute_reward`` and ``compute_terminated`` need from the infos of steps."""
    record = context.rollout
    goals = record.goals("achieved_goal"), record.goals("desired_goal")
    for what in ("reward", "terminated"):
        if (function := context.compute(what)) is None:
            continue
        keys = info_needs(function, *goals, record.infos).keys
        if keys:
            found = f"compute_{what} reads {', '.join(keys)} of the infos"
            fix = f"with hindsight replay, add ++{INFO_KEYS}=[{','.join(keys)}]"
            yield CheckResult("infos of relabeled goals", WARN, found, fix)


def check_success(context: CheckContext) -> Iterator[CheckResult]:
    """Check that success is reported, and that reached goals are paid better than others."""
    record, check = context.rollout, "reward and success"
    reported = np.array([success is not None for success in record.successes])
    if not reported.any():
        fix = 'put info["is_success"] into the info of each step, or of the last one'
        yield CheckResult(check, FAIL, "info does not report success", fix)
        return
    achieved = record.goals("achieved_goal")
    at_goal = context.answer("reward")(achieved, achieved, record.infos)[reported]
    success = np.array(record.successes, dtype=object)[reported].astype(bool)
    rewards = np.array(record.rewards)[reported]
    if rewards[success].min(initial=np.inf) <= rewards[~success].max(initial=-np.inf):
        yield CheckResult(
            check, FAIL, "a failure gets the same reward as a success", "use one threshold"
        )
    elif (at_goal <= rewards)[~success].any():
        found = "a goal that is reached exactly is paid no better than a failure"
        yield CheckResult(check, FAIL, found, "check compute_reward")
    else:
        yield CheckResult(check, OK, f"agree; {int(success.sum())} of {len(success)} steps succeed")


def check_endings(context: CheckContext) -> Iterator[CheckResult]:
    """Check that episodes end, and that ``compute_terminated`` and ``_truncated`` say the same."""
    record, limit = context.rollout, context.env.spec and context.env.spec.max_episode_steps
    if not record.lengths and not limit:
        found = f"no episode ended within {len(record.rewards)} steps, and there is no step limit"
        yield CheckResult("endings", WARN, found, "register it with max_episode_steps=...")
    elif limit and max(record.lengths, default=0) > limit:
        yield CheckResult(
            "endings", FAIL, f"an episode was longer than {limit} steps", "use TimeLimit"
        )
    else:
        ended = f"{len(record.lengths)} episodes ended"
        yield CheckResult("endings", OK, f"{ended}; step limit {limit or 'none'}")
    if context.has_goals:
        yield from _computed_endings(context)


def _computed_endings(context: CheckContext) -> Iterator[CheckResult]:
    record = context.rollout
    if context.compute("terminated") is None:
        fix = "define it, or no relabeled transition will ever end an episode"
        yield CheckResult("endings of relabeled goals", WARN, "no compute_terminated", fix)
        return
    goals = record.goals("achieved_goal"), record.goals("desired_goal")
    computed = np.asarray(context.answer("terminated")(*goals, record.infos), dtype=bool)
    n_wrong = int((computed != record.terminated).sum())
    if n_wrong:
        found = f"compute_terminated differs from step() on {n_wrong} steps"
        yield CheckResult("endings of relabeled goals", FAIL, found, "let step() call it")
    else:
        yield CheckResult("endings of relabeled goals", OK, "compute_terminated agrees with step()")


def check_goal_resampled(context: CheckContext) -> Iterator[CheckResult]:
    """Check that resets draw new goals, of an environment that has been seeded once."""
    goals = [context.env.reset()[0]["desired_goal"] for _ in range(_N_RESETS)]
    n_distinct = len({goal.tobytes() for goal in goals})
    found = f"{n_distinct} different goals in {_N_RESETS} resets"
    fix = None if n_distinct > 1 else "sample the goal in reset(), from self.np_random"
    yield CheckResult("new goals", OK if n_distinct > 1 else FAIL, found, fix)


def check_goal_untouched(context: CheckContext) -> Iterator[CheckResult]:
    """Check that observations are copies: what one keeps or changes is one's own."""
    env, rng = context.env, np.random.default_rng(_SEED)
    kept = env.reset(seed=_SEED)[0]
    copy = {key: np.copy(value) for key, value in kept.items()}
    env.step(scripted_action(env.action_space, rng))
    moved = [key for key, value in kept.items() if not np.array_equal(value, copy[key])]
    kept["desired_goal"] += 1.0
    following = env.step(scripted_action(env.action_space, rng))[0]["desired_goal"]
    if moved or np.array_equal(following, kept["desired_goal"]):
        found = f"{', '.join(moved) or 'desired_goal'} of an earlier observation is not a copy"
        yield CheckResult("copies", FAIL, found, "return .copy() of arrays that you keep")
    else:
        yield CheckResult("copies", OK, "observations are copies")


def check_seeding(context: CheckContext) -> Iterator[CheckResult]:
    """Check that a seed fixes the episode, here and in another instance, and that it matters."""
    env, other = context.env, context.make()
    courses = [course(env, _SEED), course(env, _SEED), course(other, _SEED)]
    different = course(other, _SEED + 1)
    other.close()
    fix = "draw every random number from self.np_random, and reset everything in reset()"
    if not equal(courses[0], courses[1]):
        yield CheckResult("seeds", FAIL, "a second episode with the same seed is another one", fix)
    elif not equal(courses[0], courses[2]):
        yield CheckResult("seeds", FAIL, "another instance with the same seed differs", fix)
    elif equal(courses[0], different):
        yield CheckResult("seeds", WARN, "another seed gives the same episode", fix)
    else:
        yield CheckResult("seeds", OK, "same seed, same episode, in two instances")


def check_replay(context: CheckContext) -> Iterator[CheckResult]:
    """Check that an episode can be taken up in the middle, by another instance."""
    first, second = (RunEnv(context.make()) for _ in range(2))
    rng = np.random.default_rng(_SEED)
    first.reset(seed=_SEED)
    for _ in range(2):  # other instances have seen fewer episodes
        first.reset()
    for _ in range(10):
        before = first.step(scripted_action(first.action_space, rng))[0]
    second.reset(seed=_SEED + 1)
    same = equal(before, second.replay_episode(first.episode_state()))
    action = scripted_action(first.action_space, rng)
    same = same and equal(first.step(action)[:2], second.step(action)[:2])
    first.close()
    second.close()
    if same:
        yield CheckResult("resume", OK, "the state within an episode is restored exactly")
    else:
        found = "an episode repeated by its actions leads elsewhere: resumed runs will differ"
        yield CheckResult(
            "resume", WARN, found, "let all state follow from reset() and the actions"
        )


def check_pickling(context: CheckContext) -> Iterator[CheckResult]:
    """Check that a pickled environment is the same again."""
    made = context.make()
    original = made.unwrapped
    try:
        copy = pickle.loads(pickle.dumps(original))
    except Exception as error:  # noqa: BLE001 - pickling fails in many ways
        found = f"{type(error).__name__}: {error}"
        yield CheckResult("pickling", WARN, found, "inherit from gymnasium.utils.EzPickle")
        return
    same = equal(original.reset(seed=_SEED)[0], copy.reset(seed=_SEED)[0])
    made.close()
    copy.close()
    if same:
        yield CheckResult("pickling", OK, "a copy is the same again")
    else:
        fix = "give EzPickle.__init__ all arguments of the constructor"
        yield CheckResult("pickling", FAIL, "a copy begins another episode", fix)


def check_difficulty(context: CheckContext) -> Iterator[CheckResult]:
    """Tell how often a goal is reached at the reset already, and by random actions."""
    record = context.rollout
    if record.first_successes:
        share = float(np.mean(record.first_successes))
        found = f"{share:.0%} of {len(record.first_successes)} goals are reached at the reset"
        fix = "sample goals farther away" if share > _MANY_TRIVIAL else None
        yield CheckResult("trivial goals", WARN if fix else OK, found, fix)
    if record.outcomes:
        found = f"{float(np.mean(record.outcomes)):.0%} of {len(record.outcomes)} episodes"
        n_silent = record.final_reported.count(None)
        if n_silent:
            found += f"; {n_silent} reported nothing at their end and count as not successful"
        fix = "report success and failure alike, at the end of each episode" if n_silent else None
        yield CheckResult("success of random actions", WARN if n_silent else INFO, found, fix)


def check_speed(context: CheckContext) -> Iterator[CheckResult]:
    """Tell how long steps and resets take."""
    record = context.rollout
    step = 1e3 * record.step_seconds / len(record.rewards)
    reset = 1e3 * record.reset_seconds / len(record.first_observations)
    yield CheckResult("speed", INFO, f"{step:.2f} ms per step, {reset:.2f} ms per reset")


def check_stability(context: CheckContext) -> Iterator[CheckResult]:
    """Count how often MuJoCo reset an unstable simulation."""
    n_unstable = sum(UNSTABLE_KEY in info for info in context.rollout.infos)
    if n_unstable:
        found = f"the simulation became unstable {n_unstable} times and was reset by MuJoCo"
        yield CheckResult("stability", WARN, found, "a smaller timestep, or weaker forces")
    else:
        yield CheckResult("stability", OK, "no numerical warning")


def check_pictures(context: CheckContext) -> Iterator[CheckResult]:
    """Check that drawing a scene does not change what follows."""
    if context.make_drawn is None:
        return
    env, other = context.make_drawn(), context.make_drawn()
    env.reset(seed=_SEED)
    start = time.perf_counter()
    picture = env.draw()
    seconds = time.perf_counter() - start
    if isinstance(picture, str):
        yield CheckResult("pictures", INFO, f"none: {picture}")
    elif all(  # the second episode is drawn from what the first one has left
        equal(course(env, seed, after_step=env.draw), course(other, seed)) for seed in (_SEED, None)
    ):
        height, width, _ = picture.shape
        found = f"{width} x {height} pixels, the first in {1e3 * seconds:.0f} ms"
        yield CheckResult("pictures", OK, f"{found}; drawing changes no step")
    else:
        found = "an episode that is drawn is another one"
        fix = "render() must neither change the state nor use self.np_random"
        yield CheckResult("pictures", FAIL, found, fix)
    env.close()
    other.close()


def check_fingerprint(context: CheckContext) -> Iterator[CheckResult]:
    """Tell the fingerprint, and whether it is a known one."""
    env = context.make()
    found = fingerprint(env)
    env.close()
    if not context.known_fingerprints:
        yield CheckResult("fingerprint", INFO, found)
    elif found in context.known_fingerprints:
        yield CheckResult("fingerprint", OK, f"{found}, as when it was released")
    else:
        fix = "pip install -c constraints.txt; else compare results of this machine only"
        found = f"{found}, but it was {' or '.join(context.known_fingerprints)}"
        yield CheckResult("fingerprint", WARN, found, fix)


PLAIN_CHECKS: tuple[Callable[[CheckContext], Iterator[CheckResult]], ...] = (
    check_interface,
    check_endings,
    check_seeding,
    check_replay,
    check_pickling,
    check_difficulty,
    check_stability,
    check_speed,
    check_pictures,
    check_fingerprint,
)
CHECKS = (
    check_goal_shapes,
    check_vectorised_reward,
    check_info_needs,
    check_success,
    check_goal_resampled,
    check_goal_untouched,
    *PLAIN_CHECKS,
)


def course(
    env: gym.Env, seed: int | None, n_steps: int = 20, *, after_step: Callable[[], object] = bool
) -> list[object]:
    """Return the observations and rewards of an episode; its actions are always the same."""
    rng = np.random.default_rng(_SEED)
    observed: list[object] = [env.reset(seed=seed)[0]]
    for _ in range(n_steps):
        observation, reward, terminated, truncated, _ = env.step(
            scripted_action(env.action_space, rng)
        )
        observed.append((observation, reward))
        after_step()
        if terminated or truncated:
            break
    return observed


def equal(first: Any, second: Any) -> bool:
    """Return whether nested observations are equal to the last bit."""
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(equal(first[k], second[k]) for k in first)
    if isinstance(first, (tuple, list)):
        pairs = itertools.zip_longest(first, second)
        return len(first) == len(second) and all(equal(a, b) for a, b in pairs)
    return bool(np.array_equal(first, second))
