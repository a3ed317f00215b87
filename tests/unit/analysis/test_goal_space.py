"""Free dimensions of goals, cells, and their connected regions."""

from __future__ import annotations

import numpy as np

from scilab_rl.analysis.goal_space import GoalSpace, Grid, free_dimensions

# A tower of two blocks: places x, y, z each.
X, Y = np.random.default_rng(0).uniform(0, 1, (2, 50))
TOWERS = np.stack([X, Y, np.full(50, 0.4), X, Y, np.full(50, 0.45)], axis=1)


def test_blocks_of_a_tower_follow_the_first():
    assert free_dimensions(TOWERS) == ([0, 1], {3: 0, 4: 1})
    space = GoalSpace.of(TOWERS)
    assert space.axes == (0, 1) and space.others == ()
    goals = space.goals(np.array([[0.25, 0.75]]), np.random.default_rng(0))
    np.testing.assert_allclose(goals, [[0.25, 0.75, 0.4, 0.25, 0.75, 0.45]])


def test_of_more_than_three_dimensions_the_widest_two_are_examined():
    drawn = np.random.default_rng(0).uniform(0, [1, 3, 0.5, 2], (100, 4))
    space = GoalSpace.of(drawn)
    assert space.axes == (1, 3) and space.others == (0, 2)
    goals = space.goals(np.zeros((30, 2)), np.random.default_rng(0))
    assert set(goals[:, 0]) <= set(drawn[:, 0]) and len(set(goals[:, 0])) > 10
    assert (goals[:, [1, 3]] == 0).all()


def test_cells_and_regions():
    grid = Grid((np.linspace(0, 3, 4), np.linspace(0, 2, 3)))
    assert grid.shape == (3, 2) and grid.n_cells == 6
    np.testing.assert_allclose(grid.centers[:3], [[0.5, 0.5], [0.5, 1.5], [1.5, 0.5]])
    assert grid.count(np.array([[0.1, 0.1], [0.2, 0.9], [2.9, 1.9]])).tolist() == [2, 0, 0, 0, 0, 1]
    # 1 5     cells (column, row) with the second axis upwards
    # 0 2 4   those chosen: 0, 2 and 5
    chosen = np.array([True, False, True, False, False, True])
    assert [region.tolist() for region in grid.regions(chosen)] == [[0, 2], [5]]
    assert grid.extent(np.array([0, 2])) == [(0.0, 2.0), (0.0, 1.0)]
