"""The checks that the doctor makes on an environment, in plain words."""

from __future__ import annotations

import itertools
import pickle
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

from scilab_rl.envs.fingerprint import fingerprint, scripted_action
from scilab_rl.envs.rehearsal import Rehearsal, rehearse
from scilab_rl.envs.replayable import ReplayableEpisode
from scilab_rl.envs.stability import UNSTABLE_KEY, guard
from scilab_rl.findings import FAIL, INFO, OK, WARN, Finding

_GOAL_KEYS = ("observation", "achieved_goal", "desired_goal")
_SEED = 4321
_N_RESETS = 30
_MANY_TRIVIAL = 0.5
# Gymnasium's checker finds fault with what is usual: unbounded observations, no render mode, a
# method `seed` beside the seed of the reset.
_HARMLESS = (
    "infinity", "render", "not within the normal range", "symmetric and normalized",
    "different from", "`seed` function",
)  # fmt: skip


@dataclass
class Patient:
    """An environment under examination.

    Attributes:
        make: Makes another one just like it.
        env: With its step limit.
        rehearsal: A random policy's steps in it.
        known_fingerprints: Fingerprints that it is known to have.
    """

    make: Callable[[], gym.Env]
    env: gym.Env
    rehearsal: Rehearsal
    known_fingerprints: tuple[str, ...] = ()

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


def examine(
    make: Callable[[], gym.Env], *, n_steps: int = 1000, known_fingerprints: Iterable[str] = ()
) -> Iterator[Finding]:
    """Yield what is found, check by check; a check that itself breaks is a finding too.

    Args:
        make: Makes the environment, as ``gymnasium.make`` does.
        n_steps: Random steps on which rewards and endings are compared.
        known_fingerprints: Those that the environment may have.
    """
    env = guard(make())
    try:
        rehearsal = rehearse(env, n_steps, _SEED)
    except Exception as error:  # noqa: BLE001 - a broken environment may raise anything
        yield Finding("random steps", FAIL, f"{type(error).__name__}: {error}", "repair step/reset")
        return
    patient = Patient(make, env, rehearsal, tuple(known_fingerprints))
    for check in CHECKS if patient.has_goals else PLAIN_CHECKS:
        try:
            yield from check(patient)
        except Exception as error:  # noqa: BLE001 - as above
            name = check.__name__.removeprefix("check_").replace("_", " ")
            yield Finding(name, FAIL, f"{type(error).__name__}: {error}", "repair what raises this")
    env.close()


def check_interface(patient: Patient) -> Iterator[Finding]:
    """Run Gymnasium's own checker."""
    check, env = "Gymnasium's checker", patient.make().unwrapped
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            check_env(env, skip_render_check=True)
        except Exception as error:  # noqa: BLE001 - it asserts, and calls code of the environment
            first = next(iter(str(error).splitlines()), type(error).__name__)
            yield Finding(check, FAIL, first, "see gymnasium.farama.org, 'Env'")
            return
        finally:
            env.close()
    complaints = [str(warning.message) for warning in caught]
    serious = [text for text in complaints if not any(word in text for word in _HARMLESS)]
    if serious:
        yield Finding(check, WARN, serious[0], "see gymnasium.farama.org, 'Env'")
    else:
        yield Finding(check, OK, "no complaint")


def check_goal_shapes(patient: Patient) -> Iterator[Finding]:
    """Compare the goals' shapes with each other and observations with their space."""
    space: Any = patient.env.observation_space
    achieved, desired = space["achieved_goal"].shape, space["desired_goal"].shape
    if achieved != desired:
        found = f"achieved_goal has shape {achieved}, desired_goal {desired}"
        yield Finding("goals", FAIL, found, "return both in the same shape")
        return
    outside = [o for o in patient.rehearsal.observations if not space.contains(o)]
    if outside:
        found = f"{len(outside)} observations are outside of the observation space"
        yield Finding("goals", FAIL, found, "check keys, shapes, dtypes and bounds")
    else:
        yield Finding("goals", OK, f"achieved and desired, shape {achieved}")


def check_vectorised_reward(patient: Patient) -> Iterator[Finding]:
    """Compare ``compute_reward`` of all transitions at once with the rewards of the steps."""
    record = patient.rehearsal
    goals = record.goals("achieved_goal"), record.goals("desired_goal")
    rewards = np.asarray(patient.compute("reward")(*goals, np.array(record.infos)))
    check, n_steps = "rewards of a batch", len(record.rewards)
    if rewards.shape != (n_steps,):
        found = f"compute_reward of {n_steps} goals has shape {rewards.shape}"
        yield Finding(check, FAIL, found, "compute over axis=-1, not over everything")
        return
    n_wrong = int((~np.isclose(rewards, record.rewards, atol=1e-6)).sum())
    if n_wrong:
        found = f"{n_wrong} of {n_steps} differ from the rewards of the steps"
        fix = "step() must return compute_reward(achieved_goal, desired_goal, info) of that step"
        yield Finding(check, FAIL, found, fix)
    else:
        yield Finding(check, OK, f"equal on {n_steps} steps")


def check_success(patient: Patient) -> Iterator[Finding]:
    """Check that success is reported, and that reached goals are paid better than others."""
    record, check = patient.rehearsal, "reward and success"
    if None in record.successes:
        fix = 'put info["is_success"] into the info of each step'
        yield Finding(check, FAIL, "info does not tell success", fix)
        return
    achieved = record.goals("achieved_goal")
    at_goal = np.asarray(patient.compute("reward")(achieved, achieved, np.array(record.infos)))
    success, rewards = np.array(record.successes, dtype=bool), np.array(record.rewards)
    if rewards[success].min(initial=np.inf) <= rewards[~success].max(initial=-np.inf):
        yield Finding(check, FAIL, "a failure is paid as well as a success", "use one threshold")
    elif (at_goal <= rewards)[~success].any():
        found = "a goal that is reached exactly is paid no better than a failure"
        yield Finding(check, FAIL, found, "check compute_reward")
    else:
        yield Finding(check, OK, f"agree; {int(success.sum())} of {len(success)} steps succeed")


def check_endings(patient: Patient) -> Iterator[Finding]:
    """Check that episodes end, and that ``compute_terminated`` and ``_truncated`` say the same."""
    record, limit = patient.rehearsal, patient.env.spec and patient.env.spec.max_episode_steps
    if not record.lengths and not limit:
        found = f"no episode ended within {len(record.rewards)} steps, and there is no step limit"
        yield Finding("endings", WARN, found, "register it with max_episode_steps=...")
    elif limit and max(record.lengths, default=0) > limit:
        yield Finding("endings", FAIL, f"an episode was longer than {limit} steps", "use TimeLimit")
    else:
        ended = f"{len(record.lengths)} episodes ended"
        yield Finding("endings", OK, f"{ended}; step limit {limit or 'none'}")
    if patient.has_goals:
        yield from _computed_endings(patient)


def _computed_endings(patient: Patient) -> Iterator[Finding]:
    record, compute = patient.rehearsal, patient.compute("terminated")
    if compute is None:
        fix = "define it, or no relabelled transition will ever end an episode"
        yield Finding("endings of relabelled goals", WARN, "no compute_terminated", fix)
        return
    goals = record.goals("achieved_goal"), record.goals("desired_goal")
    singles = [bool(compute(a, d, i)) for a, d, i in zip(*goals, record.infos, strict=True)]
    n_wrong = int((np.array(singles) != record.terminated).sum())
    if n_wrong:
        found = f"compute_terminated differs from step() on {n_wrong} steps"
        yield Finding("endings of relabelled goals", FAIL, found, "let step() call it")
    else:
        yield Finding("endings of relabelled goals", OK, "compute_terminated agrees with step()")


def check_goal_resampled(patient: Patient) -> Iterator[Finding]:
    """Check that resets draw new goals, of an environment that has been seeded once."""
    goals = [patient.env.reset()[0]["desired_goal"] for _ in range(_N_RESETS)]
    n_distinct = len({goal.tobytes() for goal in goals})
    found = f"{n_distinct} different goals in {_N_RESETS} resets"
    fix = None if n_distinct > 1 else "sample the goal in reset(), from self.np_random"
    yield Finding("new goals", OK if n_distinct > 1 else FAIL, found, fix)


def check_goal_untouched(patient: Patient) -> Iterator[Finding]:
    """Check that observations are copies: what one keeps or changes is one's own."""
    env, rng = patient.env, np.random.default_rng(_SEED)
    kept = env.reset(seed=_SEED)[0]
    copy = {key: np.copy(value) for key, value in kept.items()}
    env.step(scripted_action(env.action_space, rng))
    moved = [key for key, value in kept.items() if not np.array_equal(value, copy[key])]
    kept["desired_goal"] += 1.0
    following = env.step(scripted_action(env.action_space, rng))[0]["desired_goal"]
    if moved or np.array_equal(following, kept["desired_goal"]):
        found = f"{', '.join(moved) or 'desired_goal'} of an earlier observation is not a copy"
        yield Finding("copies", FAIL, found, "return .copy() of arrays that you keep")
    else:
        yield Finding("copies", OK, "observations are copies")


def check_seeding(patient: Patient) -> Iterator[Finding]:
    """Check that a seed fixes the episode, here and in another instance, and that it matters."""
    env, other = patient.env, patient.make()
    courses = [course(env, _SEED), course(env, _SEED), course(other, _SEED)]
    different = course(other, _SEED + 1)
    other.close()
    fix = "draw every random number from self.np_random, and reset everything in reset()"
    if not equal(courses[0], courses[1]):
        yield Finding("seeds", FAIL, "a second episode with the same seed is another one", fix)
    elif not equal(courses[0], courses[2]):
        yield Finding("seeds", FAIL, "another instance with the same seed differs", fix)
    elif equal(courses[0], different):
        yield Finding("seeds", WARN, "another seed gives the same episode", fix)
    else:
        yield Finding("seeds", OK, "same seed, same episode, in two instances")


def check_replay(patient: Patient) -> Iterator[Finding]:
    """Check that an episode can be taken up in the middle, by another instance."""
    first, second = (ReplayableEpisode(patient.make()) for _ in range(2))
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
        yield Finding("resume", OK, "the middle of an episode is found again exactly")
    else:
        found = "an episode repeated by its actions leads elsewhere: resumed runs will differ"
        yield Finding("resume", WARN, found, "let all state follow from reset() and the actions")


def check_pickling(patient: Patient) -> Iterator[Finding]:
    """Check that a pickled environment is the same again."""
    made = patient.make()
    original = made.unwrapped
    try:
        copy = pickle.loads(pickle.dumps(original))
    except Exception as error:  # noqa: BLE001 - pickling fails in many ways
        found = f"{type(error).__name__}: {error}"
        yield Finding("pickling", WARN, found, "inherit from gymnasium.utils.EzPickle")
        return
    same = equal(original.reset(seed=_SEED)[0], copy.reset(seed=_SEED)[0])
    made.close()
    copy.close()
    if same:
        yield Finding("pickling", OK, "a copy is the same again")
    else:
        fix = "give EzPickle.__init__ all arguments of the constructor"
        yield Finding("pickling", FAIL, "a copy begins another episode", fix)


def check_difficulty(patient: Patient) -> Iterator[Finding]:
    """Tell how often a goal is reached at the reset already, and by random actions."""
    record = patient.rehearsal
    if record.first_successes:
        share = float(np.mean(record.first_successes))
        found = f"{share:.0%} of {len(record.first_successes)} goals are reached at the reset"
        fix = "sample goals farther away" if share > _MANY_TRIVIAL else None
        yield Finding("trivial goals", WARN if fix else OK, found, fix)
    if record.final_successes:
        share = float(np.mean(record.final_successes))
        found = f"{share:.0%} of {len(record.final_successes)} episodes"
        yield Finding("success of random actions", INFO, found)


def check_speed(patient: Patient) -> Iterator[Finding]:
    """Tell how long steps and resets take."""
    record = patient.rehearsal
    step = 1e3 * record.step_seconds / len(record.rewards)
    reset = 1e3 * record.reset_seconds / len(record.first_observations)
    yield Finding("speed", INFO, f"{step:.2f} ms per step, {reset:.2f} ms per reset")


def check_stability(patient: Patient) -> Iterator[Finding]:
    """Count how often MuJoCo reset an unstable simulation."""
    n_unstable = sum(UNSTABLE_KEY in info for info in patient.rehearsal.infos)
    if n_unstable:
        found = f"the simulation became unstable {n_unstable} times and was reset by MuJoCo"
        yield Finding("stability", WARN, found, "a smaller timestep, or weaker forces")
    else:
        yield Finding("stability", OK, "no numerical warning")


def check_fingerprint(patient: Patient) -> Iterator[Finding]:
    """Tell the fingerprint, and whether it is a known one."""
    env = patient.make()
    found = fingerprint(env)
    env.close()
    if not patient.known_fingerprints:
        yield Finding("fingerprint", INFO, found)
    elif found in patient.known_fingerprints:
        yield Finding("fingerprint", OK, f"{found}, as when it was released")
    else:
        fix = "pip install -c constraints.txt; else compare results of this machine only"
        found = f"{found}, but it was {' or '.join(patient.known_fingerprints)}"
        yield Finding("fingerprint", WARN, found, fix)


PLAIN_CHECKS: tuple[Callable[[Patient], Iterator[Finding]], ...] = (
    check_interface,
    check_endings,
    check_seeding,
    check_replay,
    check_pickling,
    check_difficulty,
    check_stability,
    check_speed,
    check_fingerprint,
)
CHECKS = (
    check_goal_shapes,
    check_vectorised_reward,
    check_success,
    check_goal_resampled,
    check_goal_untouched,
    *PLAIN_CHECKS,
)


def course(env: gym.Env, seed: int, n_steps: int = 20) -> list[Any]:
    """Return the observations and rewards of an episode; its actions are always the same."""
    rng = np.random.default_rng(_SEED)
    observed: list[Any] = [env.reset(seed=seed)[0]]
    for _ in range(n_steps):
        observation, reward, terminated, truncated, _ = env.step(
            scripted_action(env.action_space, rng)
        )
        observed.append((observation, reward))
        if terminated or truncated:
            break
    return observed


def equal(first: Any, second: Any) -> bool:
    """Tell whether nested observations are equal to the last bit."""
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(equal(first[k], second[k]) for k in first)
    if isinstance(first, (tuple, list)):
        pairs = itertools.zip_longest(first, second)
        return len(first) == len(second) and all(equal(a, b) for a, b in pairs)
    return bool(np.array_equal(first, second))
