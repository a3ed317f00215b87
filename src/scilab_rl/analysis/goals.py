"""The goal microscope: where in the space of its goals does an agent fail, and does it know?

The goal space is divided into cells. The policy plays episodes whose desired goal is the middle of
a cell, many environments side by side. What it achieves, what it expected, and which goals the
environment and the replay buffer ask for are compared cell by cell.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from scilab_rl.analysis.calibration import Calibration, calibrate
from scilab_rl.analysis.estimates import Estimate, success_interval
from scilab_rl.analysis.goal_space import GoalSpace, Grid
from scilab_rl.errors import ConfigError
from scilab_rl.seeding import derive_seed

if TYPE_CHECKING:  # heavy
    from stable_baselines3.common.vec_env import VecEnv

    from scilab_rl.learning.algorithm import Algorithm
    from scilab_rl.learning.replayed_goals import ReplayedGoals

N_ENVS = 16
BUFFER_SIZE = 200_000  # transitions of the task's own episodes
_OWN_EPISODES = 8  # of each environment, with the goals that it draws itself
_DRAWS_PER_CELL = 10
_N_RETESTED = 24  # episodes in a region that seems to fail
_MOST_REGIONS = 5
_MOST_BY_CHANCE = 8  # failures without any success: fewer may be chance
_FEWEST_EXPECTED = 5.0  # drawn goals in a region that is called never asked for
NOT_REACHED, WEAK, NEVER_ASKED = "not reached", "weak", "never asked for"
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class GoalSettings:
    """How closely to look.

    Attributes:
        cells: Cells on each axis; None: 15 x 15, or about as many in one or three dimensions.
        episodes: Of each cell.
        axes: Dimensions of the goal to examine; None: the free ones.
        seed: Of all chance.
    """

    cells: tuple[int, ...] | None = None
    episodes: int = 4
    axes: tuple[int, ...] | None = None
    seed: int = 1


@dataclass(frozen=True)
class DrawnGoals:
    """Desired goals of resets.

    Attributes:
        goals: Shapes: ``(n, goal_size)``.
        is_resampled: Whether a reset without seed draws another goal.
    """

    goals: np.ndarray
    is_resampled: bool


@dataclass(frozen=True)
class PlayedGoals:
    """Episodes, one entry for each.

    Attributes:
        cells: Number of the cell. Shapes: ``(n,)``.
        seeds: Of the reset. Shapes: ``(n,)``.
        goals: Shapes: ``(n, goal_size)``.
        achieved: At the end. Shapes: ``(n, goal_size)``.
        successes: Whether the goal was reached at the end. Shapes: ``(n,)``, of truth values.
        values: Of the first observation; NaN where the algorithm has none. Shapes: ``(n,)``.
    """

    cells: np.ndarray
    seeds: np.ndarray
    goals: np.ndarray
    achieved: np.ndarray
    successes: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class Region:
    """Connected cells with something in common.

    Attributes:
        kind: `NOT_REACHED`, `WEAK` or `NEVER_ASKED`.
        cells: Their numbers.
        finding: What was found, in a sentence.
    """

    kind: str
    cells: np.ndarray
    finding: str


@dataclass(frozen=True)
class GoalStudy:
    """All that was found about the goals of an agent.

    Attributes:
        settings: How closely was looked.
        drawn: The goals that the environment draws.
        space: The free dimensions.
        grid: The cells.
        played: The episodes with chosen goals.
        own: Success rate in the episodes with the environment's own goals.
        asked: How many of the drawn goals are in each cell. Shapes: ``(n_cells,)``.
        regions: Regions that the policy does not reach or seldom does, or that are never asked for.
        notes: Other findings, in sentences.
        calibration: Whether values predict success; None where nothing can be said.
        replayed: Goals of the replay buffer.
        costs: Episodes with chosen goals, their seconds and the CPU seconds of all threads.
    """

    settings: GoalSettings
    drawn: DrawnGoals
    space: GoalSpace
    grid: Grid
    played: PlayedGoals
    own: Estimate
    asked: np.ndarray
    regions: tuple[Region, ...]
    notes: tuple[str, ...]
    calibration: Calibration | None
    replayed: ReplayedGoals
    costs: Mapping[str, float]

    @cached_property
    def successes(self) -> np.ndarray:
        """Successful episodes of each cell. Shapes: ``(n_cells,)``."""
        return _count(self.played.cells[self.played.successes], self.grid)

    @cached_property
    def rates(self) -> list[Estimate]:
        """Success rate of each cell, with Wilson's interval."""
        pairs = zip(self.successes, _count(self.played.cells, self.grid), strict=True)
        return [success_interval(int(won), int(n)) for won, n in pairs]

    @cached_property
    def overall(self) -> Estimate:
        """Success rate over all cells alike; goals that are asked for may lie otherwise."""
        return success_interval(int(self.played.successes.sum()), len(self.played.successes))

    @property
    def findings(self) -> list[str]:
        """All findings, in sentences."""
        return [*self.notes, *(region.finding for region in self.regions)]

    def worst(self, n: int) -> list[int]:
        """Return failed episodes of the worst cells, no two of neighboring cells.

        Among cells that are equally bad, those come first whose value was highest: the agent
        expected to succeed.

        Args:
            n: At most so many.

        Returns:
            Numbers of episodes in `played`.
        """
        failed = np.flatnonzero(~self.played.successes)
        rates = np.array([rate.value for rate in self.rates])[self.played.cells[failed]]
        values = np.nan_to_num(self.played.values[failed])
        chosen: list[int] = []
        taken: set[int] = set()
        for episode in failed[np.lexsort((-values, rates))].tolist():
            cell = int(self.played.cells[episode])
            if len(chosen) < n and cell not in taken:
                chosen.append(episode)
                taken |= {cell, *self.grid.neighbors(cell)}
        return chosen


def study_goals(
    algorithm: Algorithm,
    env: VecEnv,
    settings: GoalSettings,
    name: str,
    *,
    progress: Callable[[int, int], None] | None = None,
    training: ReplayedGoals | None = None,
) -> GoalStudy:
    """Examine the goals of an agent.

    Args:
        algorithm: The agent.
        env: Its environments side by side, from `make_eval_env`.
        settings: How closely to look.
        name: The environment's, for messages.
        progress: Called after each episode with chosen goals: how many are done, and of how many.
        training: Goals of the replay buffer that the agent was trained with, if it was kept.

    Raises:
        ConfigError: If the environment has no goals, they cannot be chosen or do not vary, or it
            does not report success.
    """
    refuse_other_environments(env, name)
    n_cells = int(np.prod(settings.cells or (15, 15)))
    drawn = draw_goals(env, _DRAWS_PER_CELL * n_cells, settings.seed)
    own, replayed = _play_own_goals(algorithm, env, settings.seed, name)
    varied = drawn.goals if np.ptp(drawn.goals, axis=0).any() else replayed.achieved
    space = GoalSpace.of(varied, settings.axes)
    grid = Grid.over(space, settings.cells)
    cells = np.repeat(np.arange(grid.n_cells), settings.episodes)
    rng = np.random.default_rng(settings.seed)
    goals = space.goals(grid.centers[cells], rng)
    clocks = time.perf_counter(), time.process_time()
    played = play_goals(algorithm, env, cells, goals, settings.seed, progress)
    costs = {
        "episodes": len(cells),
        "seconds": time.perf_counter() - clocks[0],
        "cpu_seconds": time.process_time() - clocks[1],
    }
    asked = grid.count(drawn.goals[:, space.axes])
    has_values = bool(np.isfinite(played.values).all())
    study = GoalStudy(
        settings, drawn, space, grid, played, own, asked, (), (),
        calibrate(played.values, played.successes, cells, seed=settings.seed)
        if has_values else None,
        training or replayed, costs,
    )  # fmt: skip
    regions = (*_failing(study, algorithm, env, rng), *_never_asked(study))
    return dataclasses.replace(study, regions=regions, notes=tuple(_notes(study, name)))


def refuse_other_environments(env: VecEnv, name: str) -> None:
    """Try a chosen goal in each environment.

    Args:
        env: The environments.
        name: The environment's, for messages.

    Raises:
        ConfigError: If they have no goals, or their goals cannot be chosen.
    """
    from scilab_rl.envs.goal_setting import EpisodePlan
    from scilab_rl.learning.compatibility import is_goal_space

    if not is_goal_space(env.observation_space):
        raise ConfigError(
            f"{name} has no goals: the microscope needs observations with achieved_goal and "
            "desired_goal, such as those of FetchPush."
        )
    drawn = [_desired(_reset(env, [EpisodePlan(seed)] * env.num_envs)) for seed in (1, 2)]
    goal = 0.25 * drawn[0][0] + 0.75 * drawn[1][0]
    if np.array_equal(drawn[0][0], drawn[1][0]):  # never resampled
        goal = drawn[0][0] + 1e-3
    first = _desired(_reset(env, [EpisodePlan(1, goal)] * env.num_envs))
    actions = np.stack([env.action_space.sample() for _ in range(env.num_envs)])
    second = _desired(env.step(actions)[0])
    if not all(np.allclose(seen, goal, rtol=0, atol=1e-5) for seen in (first, second)):
        raise ConfigError(
            f"The goals of {name} cannot be chosen: its reset ignores options['desired_goal'], "
            "which a scilab_rl.envs.goal.GoalEnv takes, and there is no attribute goal to replace."
        )


def draw_goals(env: VecEnv, n: int, seed: int) -> DrawnGoals:
    """Reset environments and look which goals they ask for.

    Args:
        env: The environments.
        n: How many goals, at least.
        seed: Each environment is first reset without one, then with one for each goal.
    """
    from scilab_rl.envs.goal_setting import EpisodePlan

    unseeded = [_desired(_reset(env, [EpisodePlan()] * env.num_envs)) for _ in range(4)]
    is_resampled = bool(np.ptp(np.array(unseeded), axis=0).any())
    goals = [
        _desired(
            _reset(
                env,
                [
                    EpisodePlan(derive_seed(seed, "drawn", turn, index))
                    for index in range(env.num_envs)
                ],
            )
        )
        for turn in range(-(-n // env.num_envs))
    ]
    return DrawnGoals(np.concatenate(goals).astype(np.float64), is_resampled)


def play_goals(
    algorithm: Algorithm,
    env: VecEnv,
    cells: np.ndarray,
    goals: np.ndarray,
    seed: int,
    progress: Callable[[int, int], None] | None = None,
) -> PlayedGoals:
    """Play an episode for each goal.

    Args:
        algorithm: The agent.
        env: Its environments side by side.
        cells: Of each goal, for the result. Shapes: ``(n,)``.
        goals: Shapes: ``(n, goal_size)``.
        seed: Each episode gets one of its own from it.
        progress: As in `study_goals`.
    """
    from scilab_rl.envs.goal_setting import EpisodePlan
    from scilab_rl.training.episode_goals import EpisodeGoals
    from scilab_rl.training.evaluation import Episode, evaluate_side_by_side

    done = 0

    def count(episode: Episode) -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, len(goals))

    shape = env.observation_space["desired_goal"].shape  # type: ignore[index]
    seeds = np.array([derive_seed(seed, "goals", index) for index in range(len(goals))])
    turns = [np.arange(first, len(goals), env.num_envs) for first in range(env.num_envs)]
    plans = [[EpisodePlan(int(seeds[i]), goals[i].reshape(shape)) for i in turn] for turn in turns]
    with _observing(env, EpisodeGoals(env)) as ends:
        episodes = evaluate_side_by_side(
            algorithm, env, plans, [len(turn) for turn in turns], on_episode=count
        )
    order = np.argsort(np.concatenate(turns))

    def in_order(parts: Sequence[Sequence[Any]]) -> list[Any]:
        together = [x for part, turn in zip(parts, turns, strict=True) for x in part[: len(turn)]]
        return [together[index] for index in order]

    first = in_order(ends.first)
    return PlayedGoals(
        cells, seeds, goals,
        np.array([goal.ravel() for goal in in_order(ends.achieved)]),
        np.array([bool(episode.success) for episode in in_order(episodes)]),
        _values(algorithm, {key: np.array([o[key] for o in first]) for key in first[0]}),
    )  # fmt: skip


def _values(algorithm: Algorithm, observations: dict[str, np.ndarray]) -> np.ndarray:
    from scilab_rl.learning.inspector import VALUE, AgentInspector

    inspector = AgentInspector(algorithm)
    if VALUE not in inspector.quantities:
        return np.full(len(observations["desired_goal"]), np.nan)
    return inspector.values(observations)


def _play_own_goals(
    algorithm: Algorithm, env: VecEnv, seed: int, name: str
) -> tuple[Estimate, ReplayedGoals]:
    """Play episodes with the goals that the environment draws, into a replay buffer."""
    from scilab_rl.envs.goal_setting import EpisodePlan
    from scilab_rl.learning.replayed_goals import BufferFiller, replayed_goals
    from scilab_rl.training.evaluation import evaluate_side_by_side

    plans = [[EpisodePlan(derive_seed(seed, "own goals", i))] for i in range(env.num_envs)]
    with _observing(env, BufferFiller(algorithm, BUFFER_SIZE)) as filler:
        played = evaluate_side_by_side(algorithm, env, plans, [_OWN_EPISODES] * env.num_envs)
    episodes = [episode for part in played for episode in part]
    if all(episode.success_once is None for episode in episodes):
        raise ConfigError(
            f"{name} does not report success: info['is_success'] says after each step whether the "
            "goal is reached."
        )
    n_won = sum(bool(episode.success) for episode in episodes)
    kind = "configured as in training" if filler.is_own else "with hindsight that it did not have"
    origin = (
        f"{len(episodes)} new episodes of this policy with the goals that the environment draws, "
        f"in a replay buffer {kind}"
    )
    return success_interval(n_won, len(episodes)), replayed_goals(filler.buffer, origin)


def _failing(
    study: GoalStudy, algorithm: Algorithm, env: VecEnv, rng: np.random.Generator
) -> Iterator[Region]:
    """Yield regions without success and regions with little of it, if new episodes confirm that.

    Regions are chosen because they failed, which is partly chance; the new episodes are not.
    """
    grid = study.grid
    unreached = np.zeros(grid.n_cells, dtype=bool)
    for region in grid.regions(study.successes == 0)[:_MOST_REGIONS]:
        if len(region) * study.settings.episodes >= _MOST_BY_CHANCE:
            rate, again = _play_again(study, region, algorithm, env, rng)
            if rate.value == 0:
                unreached[region] = True
                yield Region(
                    NOT_REACHED, region, _words_of_failure(study, NOT_REACHED, region, rate, again)
                )
    for region in grid.regions(_is_weak(study) & ~unreached)[:_MOST_REGIONS]:
        rate, again = _play_again(study, region, algorithm, env, rng)
        if rate.high < study.overall.value:
            yield Region(WEAK, region, _words_of_failure(study, WEAK, region, rate, again))


def _play_again(
    study: GoalStudy,
    region: np.ndarray,
    algorithm: Algorithm,
    env: VecEnv,
    rng: np.random.Generator,
) -> tuple[Estimate, PlayedGoals]:
    """Play new episodes with the goals of a region."""
    cells = rng.choice(region, _N_RETESTED)
    goals = study.space.goals(study.grid.centers[cells], rng)
    seed = derive_seed(study.settings.seed, "retest", int(region[0]), len(region))
    again = play_goals(algorithm, env, cells, goals, seed)
    return success_interval(int(again.successes.sum()), len(again.successes)), again


def _is_weak(study: GoalStudy) -> np.ndarray:
    """Return the cells which, with their neighbors, are surely below the rate over all cells."""
    n_episodes = _count(study.played.cells, study.grid)
    weak = []
    for cell in range(study.grid.n_cells):
        near = [cell, *study.grid.neighbors(cell)]
        rate = success_interval(int(study.successes[near].sum()), int(n_episodes[near].sum()))
        weak.append(rate.high < study.overall.value)
    return np.array(weak)


def _words_of_failure(
    study: GoalStudy, kind: str, region: np.ndarray, rate: Estimate, again: PlayedGoals
) -> str:
    space, n_cells = study.space, study.grid.n_cells
    asked = study.asked[region].sum() / len(study.drawn.goals)
    words = (
        f"{kind.capitalize()}: {where(study, region)} ({len(region)} of {n_cells} cells, "
        f"{asked:.0%} of the goals that are asked for). {_N_RETESTED} new episodes there: success "
        f"rate {rate.value:.2f} [{rate.low:.2f}, {rate.high:.2f}], over all cells "
        f"{study.overall.value:.2f}."
    )
    if kind == WEAK:
        return words
    ever = np.concatenate([study.replayed.achieved, study.played.achieved, again.achieved])
    visits = int(study.grid.count(ever[:, space.axes])[region].sum())
    if visits:
        return f"{words} {visits:,} of {len(ever):,} achieved goals lie there all the same."
    return (
        f"{words} No goal there was achieved in any episode, whatever was asked for: maybe it "
        "cannot be."
    )


def _never_asked(study: GoalStudy) -> Iterator[Region]:
    """Yield regions in which the environment has drawn no goal."""
    grid, n_drawn = study.grid, len(study.drawn.goals)
    for region in grid.regions(study.asked == 0)[:_MOST_REGIONS]:
        expected = n_drawn * len(region) / grid.n_cells
        if expected < _FEWEST_EXPECTED:
            continue
        n_won = int(study.successes[region].sum())
        rate = success_interval(n_won, len(region) * study.settings.episodes)
        yield Region(
            NEVER_ASKED,
            region,
            f"Never asked for: {where(study, region)} ({len(region)} of {grid.n_cells} cells). "
            f"None of {n_drawn:,} resets drew a goal there; {expected:.0f} would if all cells were "
            f"alike. Asked for it here, the success rate is {rate.value:.2f} "
            f"[{rate.low:.2f}, {rate.high:.2f}].",
        )


def where(study: GoalStudy, region: np.ndarray) -> str:
    """Return where a region is, in words."""
    ends = zip(study.space.axes, study.grid.extent(region), strict=True)
    return ", ".join(f"goal[{axis}] from {low:.3g} to {high:.3g}" for axis, (low, high) in ends)


def _notes(study: GoalStudy, name: str) -> Iterator[str]:
    goals = study.drawn.goals
    if not study.drawn.is_resampled:
        seeds = "Other seeds give other goals." if np.ptp(goals, axis=0).any() else (
            "Other seeds do not change it either, so the cells cover the goals that are achieved."
        )  # fmt: skip
        yield (
            f"Never resampled: a reset of {name} keeps the goal of the episode before. {seeds} "
            "sample_goal() must draw from self.np_random."
        )
    if study.space.others:
        others = ", ".join(f"goal[{axis}]" for axis in study.space.others)
        yield f"Not examined: {others} also vary; each episode has those of a goal that was drawn."
    if study.calibration is None:
        yield (
            "Values and success cannot be compared: all episodes succeeded, all failed, or the "
            "algorithm has no value."
        )


def _count(cells: np.ndarray, grid: Grid) -> np.ndarray:
    return np.bincount(cells, minlength=grid.n_cells)


def _reset(env: VecEnv, plans: Sequence[Any]) -> Any:
    for index, plan in enumerate(plans):
        env.env_method("plan_episodes", [plan], indices=[index])
    return env.reset()


def _desired(observations: Any) -> np.ndarray:
    """Return desired goals as vectors. Shapes: ``(n_envs, goal_size)``."""
    goals = np.array(observations["desired_goal"])
    return goals.reshape(len(goals), -1)


@contextlib.contextmanager
def _observing(env: VecEnv, observer: Any) -> Iterator[Any]:
    """Take an observer away again after the block."""
    from scilab_rl.envs.vectorize import observed_layer

    try:
        yield observer
    finally:
        observed_layer(env).observers.remove(observer)
