"""ButtonUnlock: press the blue buttons to open the cage over the red one, then reach it."""

from __future__ import annotations

from typing import Any

import numpy as np

from scilab_rl.envs.fetch_task import STEP_LENGTH, TABLE_HEIGHT, FetchTask
from scilab_rl.envs.goal import require_choice

_MAX_BUTTONS = 2
_PRESSED = 0.008  # how far a button sinks, in m
_CAGE, _GLASS, _CAGE_HEIGHT = 0.05, 0.003, 0.05  # half width, half thickness, half height, in m
_HIDDEN = (0.0, 0.0, -1.0)


class ButtonUnlock(FetchTask):
    """Move the gripper at a fixed height over the table, from button to button.

    The goal is the place of the red button. A glass cage keeps the gripper out until each blue
    button has been pressed, in any order, by moving over it. The observation is the gripper's
    place, its movement per step, the places of the blue buttons, and for each whether it is pressed
    (1) or not (0).

    Args:
        n_buttons: Blue buttons, from 0 to 2. Allow 50 steps per button, the red one included:
            ``env_kwargs.max_episode_steps``.
        threshold: Distance up to which a button counts as reached, in m.
        kwargs: Those of `GoalEnv`: reward_type (sparse | dense), ...
    """

    action_size = 2
    fingers_closed = True
    start_height = 0.445
    work_range = 0.16
    apart = 0.13

    def __init__(self, n_buttons: int = 1, *, threshold: float = 0.03, **kwargs: Any) -> None:
        require_choice("n_buttons", n_buttons, range(_MAX_BUTTONS + 1))
        self.n_buttons = n_buttons
        self.pressed = np.zeros(n_buttons, dtype=bool)
        super().__init__(_buttons_xml(n_buttons), threshold=threshold, **kwargs)

    def set_up(self) -> None:
        """Look up the movable parts, and settle."""
        names = [*(f"button{index}" for index in range(self.n_buttons)), "red"]
        self._buttons = np.array([int(self.model.body(name).mocapid[0]) for name in names])
        self._cage = int(self.model.body("cage").mocapid[0])
        super().set_up()

    def place_objects(self) -> None:
        """Put the buttons on the table, apart from one another and from the gripper."""
        places = [self.start[:2]]
        while len(places) <= len(self._buttons):
            offset = self.np_random.uniform(-self.work_range, self.work_range, 2)
            place = self.start[:2] + offset
            if min(np.linalg.norm(place - other) for other in places) > self.apart:
                places.append(place)
        self.pressed[:] = False
        self.data.mocap_pos[self._buttons, :2] = places[1:]
        self.data.mocap_pos[self._buttons, 2] = TABLE_HEIGHT
        locked = (*places[-1], TABLE_HEIGHT) if self.n_buttons else _HIDDEN
        self.data.mocap_pos[self._cage] = locked

    def sample_goal(self) -> np.ndarray:
        """Return the place of the red button."""
        return self.data.mocap_pos[self._buttons[-1], :2]

    def achieved_goal(self) -> np.ndarray:
        """Return the gripper's place. Shapes: ``(2,)`` in m."""
        return self.gripper_position()[:2]

    def get_observation(self) -> np.ndarray:
        """Return places, movement and locks. Shapes: ``(4 + 3 n_buttons,)``."""
        return np.concatenate(
            [
                self.gripper_position()[:2],
                self.gripper_velocity()[:2],
                self._blue_places().ravel(),
                self.pressed,
            ]
        )

    def movement(self, action: np.ndarray) -> np.ndarray:
        """Move in the plane and hold the height."""
        height = self.start[2] - self.gripper_position()[2]
        return np.array([*(STEP_LENGTH * action), height])

    def apply_action(self, action: np.ndarray) -> None:
        """Move, press what is below the gripper, and open the cage after the last button."""
        super().apply_action(action)
        distances = np.linalg.norm(self._blue_places() - self.achieved_goal(), axis=1)
        self.pressed |= distances <= self.threshold
        self.data.mocap_pos[self._buttons[:-1], 2] = TABLE_HEIGHT - _PRESSED * self.pressed
        if self.pressed.all():
            self.data.mocap_pos[self._cage] = _HIDDEN

    def _blue_places(self) -> np.ndarray:
        return self.data.mocap_pos[self._buttons[:-1], :2]


def _buttons_xml(n_buttons: int) -> str:
    """Return buttons and cage as bodies that are moved by hand and that physics leaves alone."""
    button = (
        '<body name="{name}" mocap="true" pos="{x} 1.6 0.4"><geom type="cylinder" size="0.02 0.01" '
        'contype="0" conaffinity="0" rgba="{color} 1"/></body>'
    )
    parts = [
        button.format(name=f"button{index}", x=1.0 + 0.1 * index, color="0.2 0.4 0.9")
        for index in range(n_buttons)
    ]
    parts.append(button.format(name="red", x=1.3, color="0.9 0.15 0.15"))
    walls = [(f"{sign * _CAGE} 0", f"{_GLASS} {_CAGE}") for sign in (-1, 1)] + [
        (f"0 {sign * _CAGE}", f"{_CAGE} {_GLASS}") for sign in (-1, 1)
    ]
    glass = "".join(
        f'<geom type="box" pos="{place} {_CAGE_HEIGHT}" size="{size} {_CAGE_HEIGHT}" '
        'rgba="0.6 0.85 0.95 0.35"/>'
        for place, size in walls
    )
    parts.append(f'<body name="cage" mocap="true" pos="0 0 -1">{glass}</body>')
    return "\n".join(parts)
