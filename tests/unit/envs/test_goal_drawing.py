"""Pictures of goal tasks, measured in pixels."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from scilab_rl.drawing import ACHIEVED, DESIRED, REACHED
from scilab_rl.envs.goal import GoalEnv
from scilab_rl.envs.goal_drawing import SIDE, tint

LEFT, TOP, AREA = 44, 50, 404  # the square of the scene
PER_UNIT = AREA / 2  # pixels, with axes from -1 to 1


class Point(GoalEnv):
    """A point that moves by the action."""

    n, threshold, drawn_range = 2, 0.25, (-1.0, 1.0)

    def __init__(self, n=2, **kwargs):
        self.n = self.action_size = n
        super().__init__(**kwargs)

    def reset_state(self):
        self.place = np.full(self.n, -0.5)

    def sample_goal(self):
        return np.full(self.n, 0.5)

    def apply_action(self, action):
        self.place = self.place + action

    def achieved_goal(self):
        return self.place

    def get_observation(self):
        return self.place


def made(n, goal=None, cls=Point, **kwargs):
    env = cls(n, render_mode="rgb_array", **kwargs)
    env.reset(seed=1, options={"desired_goal": goal} if goal is not None else None)
    return env


def where(frame, color, *, tolerance=8):
    """Return the pixels of a color below the legend. Shapes: ``(n, 2)``, x and y."""
    wanted = [int(color[i : i + 2], 16) for i in (1, 3, 5)]
    ys, xs = np.nonzero((np.abs(frame.astype(int) - wanted) <= tolerance).all(axis=2))
    return np.stack([xs, ys], axis=1)[ys > TOP - 10]


def pixel(x, y):
    return [LEFT + (x + 1) * PER_UNIT, TOP + (1 - y) * PER_UNIT]


@pytest.mark.parametrize("goal", [(0.5, 0.5), (-0.25, 0.6), (0.1, -0.6)])
def test_the_plane_is_to_scale(goal):
    env = made(2, goal)
    frame = env.render()
    assert frame.shape == (SIDE, SIDE, 3)
    assert frame.dtype == np.uint8
    disc = where(frame, tint(DESIRED, 0.16))
    assert (disc.min(0) + disc.max(0) + 1) / 2 == pytest.approx(pixel(*goal), abs=1.5)
    assert (np.ptp(disc, axis=0) + 1) / 2 == pytest.approx(0.25 * PER_UNIT, abs=1.5)
    dot = where(frame, ACHIEVED)
    assert dot.mean(0) + 0.5 == pytest.approx(pixel(-0.5, -0.5), abs=1)


def test_the_trail_goes_where_the_point_went_and_ends_with_the_episode():
    env = made(2, (0.9, 0.9))
    for action in ((0.75, 0.0), (0.0, 0.5)):
        env.step(np.array(action))
    frame = env.render()
    for place in ((-0.1, -0.5), (0.25, -0.2)):
        x, y = np.round(pixel(*place)).astype(int)
        near = frame[y - 2 : y + 3, x - 2 : x + 3].astype(int)
        assert (near[..., 2] - near[..., 0]).max() > 40, place  # blue
    env.reset()
    x, y = np.round(pixel(-0.1, -0.5)).astype(int)
    near = env.render()[y - 2 : y + 3, x - 2 : x + 3].astype(int)
    assert (near[..., 2] - near[..., 0]).max() < 10


def test_on_a_line_the_threshold_is_an_interval_and_the_past_lies_above():
    env = made(1)
    env.step(np.array([0.9]))
    frame = env.render()
    bar = where(frame, REACHED)
    assert bar[:, 0].min() == pytest.approx(LEFT + 1.25 * PER_UNIT, abs=1.5)
    assert bar[:, 0].max() == pytest.approx(LEFT + 1.75 * PER_UNIT, abs=1.5)
    assert (where(frame, ACHIEVED).mean(0) + 0.5)[0] == pytest.approx(LEFT + 1.4 * PER_UNIT, abs=1)
    # One step ago it was at -0.5, five pixels higher.
    base = where(frame, ACHIEVED)[:, 1].mean()
    start = frame[round(base) - 8 : round(base), round(LEFT + 0.5 * PER_UNIT) :][:, :12].astype(int)
    assert (start[..., 2] - start[..., 0]).max() > 25
    assert (start[:4, ..., 2] - start[:4, ..., 0]).max() > (
        start[6:, ..., 2] - start[6:, ..., 0]
    ).max()


def test_in_a_box_a_ball_stays_as_large_wherever_it_is():
    sizes = []
    for goal in ((0.7, 0.7, 0.7), (-0.7, 0.7, 0.0), (0.0, 0.0, 0.5)):
        disc = where(made(3, goal).render(), tint(DESIRED, 0.75), tolerance=20)
        sizes.append(np.ptp(disc, axis=0))
    assert np.ptp(sizes, axis=0).max() <= 2
    width, height = np.mean(sizes, axis=0)
    assert width == pytest.approx(height, abs=3)
    twice = where(
        made(3, (0.0, 0.0, 0.5), threshold=0.5).render(), tint(DESIRED, 0.75), tolerance=20
    )
    assert np.ptp(twice[:, 0]) == pytest.approx(2 * width, rel=0.06)


def test_up_is_up_in_a_box():
    heights = [
        where(made(3, (0.0, 0.0, z)).render(), tint(DESIRED, 0.16))[:, 1].mean()
        for z in (-0.5, 0.5)
    ]
    assert heights[0] > heights[1] + 50


@pytest.mark.parametrize("n", [1, 2, 3, 5, 20])
def test_success_is_seen(n):
    env = made(n)
    far = env.render()
    assert len(where(far, DESIRED)) > 10
    assert not len(where(far, REACHED))
    env.step(np.ones(n))
    near = env.render()
    assert len(where(near, REACHED)) > 10
    assert not len(where(near, DESIRED))


def test_axes_grow_and_never_shrink():
    class Free(Point):
        drawn_range = None

    env = made(2, cls=Free)
    env.render()
    env.step(np.ones(2))
    env.step(np.ones(2))
    middle = where(env.render(), tint(DESIRED, 0.16), tolerance=3)
    env.reset()
    again = where(env.render(), tint(DESIRED, 0.16), tolerance=3)
    assert again.mean(0) == pytest.approx(middle.mean(0), abs=2)


def test_a_distance_of_ones_own_has_no_round_threshold():
    class Cornered(Point):
        def distance(self, achieved_goal, desired_goal):
            return np.abs(np.asarray(achieved_goal) - np.asarray(desired_goal)).max(axis=-1)

    frame = made(2, cls=Cornered).render()
    assert not len(where(frame, tint(DESIRED, 0.16)))
    assert len(where(frame, DESIRED)) > 10


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_numbers_that_are_none_are_left_out(n):
    env = made(n)
    env.place = np.full(n, np.nan)
    env.step(np.zeros(n))
    env.place = np.full(n, 1e12)
    env.step(np.zeros(n))
    assert env.render().shape == (SIDE, SIDE, 3)


def test_a_constructor_that_does_not_pass_on_the_mode_is_drawn_all_the_same():
    env = Point(2)
    env.reset(seed=1)
    assert len(where(env.render(), ACHIEVED)) > 50


@pytest.mark.filterwarnings("ignore:.*WARN")  # of spaces without bounds
@pytest.mark.parametrize("n", [1, 2, 3])
def test_gymnasiums_checks_pass(n):
    gym.register("Drawn-v0", entry_point=Point, max_episode_steps=20)
    check_env(gym.make("Drawn-v0", n=n, render_mode="rgb_array").unwrapped)
    gym.registry.pop("Drawn-v0")


def test_the_template_draws_itself():
    from scilab_rl.envs.templates.minimal import MyTask

    env = MyTask(render_mode="rgb_array")
    env.reset(seed=1)
    assert env.metadata["render_modes"] == ["rgb_array"]
    assert len(where(env.render(), ACHIEVED)) > 50


def test_drawing_changes_nothing():
    drawn, other = made(2), Point(2)
    other.reset(seed=1, options=None)
    for _ in range(3):
        action = np.array([0.1, 0.2])
        first, second = drawn.step(action), other.step(action)
        drawn.render()
        assert first[0]["achieved_goal"].tolist() == second[0]["achieved_goal"].tolist()
    assert other._drawing is None  # nothing is kept where nothing is drawn
