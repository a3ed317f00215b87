"""Drawing into a rendered scene at places of the world."""

from __future__ import annotations

import numpy as np

from scilab_rl.envs.scene_painting import Scene, paint

# A camera at the height of 2 m that looks straight down at the floor; 1 m of it is 50 pixels.
SIDE = 101
_OFFSETS = (np.arange(SIDE) - SIDE // 2) / (SIDE // 2)
RAYS = np.stack([*np.meshgrid(_OFFSETS, -_OFFSETS), -np.ones((SIDE, SIDE))], axis=-1)
RED, BLUE = [255, 0, 0], [0, 0, 255]


def scene(depth=2.0):
    picture = np.full((SIDE, SIDE, 3), 100, np.uint8)
    return Scene(picture, np.full((SIDE, SIDE), depth), np.array([0.0, 0.0, 2.0]), RAYS)


def test_places_are_seen_where_the_camera_projects_them():
    np.testing.assert_allclose(scene().pixel([0, 0, 0]), [50, 50], atol=1e-9)
    # To the right by half of what is seen at that depth; up in the picture is north.
    np.testing.assert_allclose(scene().pixel([1, 0.5, 0]), [75, 37.5], atol=1e-9)
    np.testing.assert_allclose(scene().pixel([0.5, 0, 1]), [75, 50], atol=1e-9)


def test_a_map_is_painted_cell_by_cell():
    colors = np.array([[RED], [BLUE]], np.uint8)  # two cells along the first side
    painted = paint(scene(), np.zeros(3), np.array([[1.0, 0, 0], [0, 1.0, 0]]), colors)
    assert painted[45, 55, 0] > 180 and painted[45, 55, 2] < 60  # x = 0.2, y = 0.2
    assert painted[45, 70, 2] > 180 and painted[45, 70, 0] < 60  # x = 0.8, y = 0.2
    for row, column in ((45, 45), (55, 55), (45, 80), (20, 55)):  # outside, on all four sides
        assert (painted[row, column] == 100).all()


def test_what_is_before_the_map_hides_it():
    sides = np.array([[1.0, 0, 0], [0, 1.0, 0]])
    colors = np.full((1, 1, 3), RED, np.uint8)
    assert (paint(scene(depth=1.5), np.zeros(3), sides, colors) == 100).all()


def test_one_dimension_is_a_strip():
    painted = paint(
        scene(), np.zeros(3), np.array([[1.0, 0, 0]]), np.full((4, 1, 3), RED, np.uint8)
    )
    assert painted[50, 60, 0] > 180 and (painted[45, 60] == 100).all()
