"""Environments of a few lines and a few microseconds per step, one for each kind of task.

They are made to test with: every random number comes from ``self.np_random``, all of them can be
pickled and copied in the middle of an episode, and their rewards and ends can be computed by hand.
"""

from __future__ import annotations

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from scilab_rl.envs.types import Info, ResetResult, StepResult

Observation = dict[str, np.ndarray]

_MODULE = "scilab_rl.testing.environments"
# id -> (class, steps until an episode is cut)
TINY_ENVIRONMENTS: dict[str, tuple[str, int]] = {
    "TinyReach-v0": ("TinyReach", 15),
    "TinyReachDiscrete-v0": ("TinyReachDiscrete", 15),
    "TinyBox-v0": ("TinyBox", 15),
    "TinyDiscrete-v0": ("TinyDiscrete", 20),
    "TinyPixels-v0": ("TinyPixels", 10),
}


def register() -> None:
    """Register the tiny environments with Gymnasium, once."""
    for env_id, (name, max_episode_steps) in TINY_ENVIRONMENTS.items():
        if env_id not in gym.registry:
            gym.register(
                env_id,
                entry_point=f"{_MODULE}:{name}",
                max_episode_steps=max_episode_steps,
                disable_env_checker=True,  # it costs more than the step itself
            )


class TinyReach(gym.Env):
    """A point in a square moves to a goal; the smallest task for hindsight replay.

    Places are in [-1, 1] x [-1, 1], and an action moves the point by at most 0.25 per axis. The
    reward is 0 within 0.2 of the goal and -1 elsewhere. As with the Fetch tasks, only the step
    limit ends an episode.
    """

    STEP_LENGTH = 0.25
    THRESHOLD = 0.2

    def __init__(self) -> None:
        self.action_space: spaces.Space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        place = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = spaces.Dict(
            {"observation": place, "achieved_goal": place, "desired_goal": place}
        )
        self._position = np.zeros(2, np.float32)
        self._goal = np.zeros(2, np.float32)

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> ResetResult:
        """Put the point and the goal at random places."""
        super().reset(seed=seed)
        self._position = self._random_place()
        self._goal = self._random_place()
        observation = self._observe()
        return observation, self._info(observation)

    def step(self, action: np.ndarray) -> StepResult:
        """Move the point.

        Args:
            action: Movement per axis, in [-1, 1]. Shapes: ``(2,)``.
        """
        moved = self._position + self.STEP_LENGTH * self._movement(action)
        self._position = np.clip(moved, -1.0, 1.0).astype(np.float32)
        observation = self._observe()
        achieved, desired = observation["achieved_goal"], observation["desired_goal"]
        info = self._info(observation)
        return (
            observation,
            float(self.compute_reward(achieved, desired, info)),
            self.compute_terminated(achieved, desired, info),
            self.compute_truncated(achieved, desired, info),
            info,
        )

    def compute_reward(
        self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: object
    ) -> np.ndarray:
        """Return 0 where the goal is reached and -1 elsewhere.

        Shapes:
            achieved_goal, desired_goal: ``(2,)`` or ``(n, 2)``; the result is ``()`` or ``(n,)``.
        """
        return -(self._distance(achieved_goal, desired_goal) > self.THRESHOLD).astype(np.float32)

    def compute_terminated(
        self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: object
    ) -> bool:
        """Return False: reaching the goal does not end the episode, staying there counts."""
        return False

    def compute_truncated(
        self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: object
    ) -> bool:
        """Return False: the step limit is a wrapper's business."""
        return False

    def _movement(self, action: np.ndarray) -> np.ndarray:
        return np.clip(action, -1.0, 1.0)

    def _random_place(self) -> np.ndarray:
        return self.np_random.uniform(-0.9, 0.9, 2).astype(np.float32)

    def _observe(self) -> Observation:
        # Copies, so that stored observations do not change.
        return {
            "observation": self._position.copy(),
            "achieved_goal": self._position.copy(),
            "desired_goal": self._goal.copy(),
        }

    def _info(self, observation: Observation) -> Info:
        distance = self._distance(observation["achieved_goal"], observation["desired_goal"])
        return {"is_success": bool(distance <= self.THRESHOLD)}

    @staticmethod
    def _distance(achieved_goal: np.ndarray, desired_goal: np.ndarray) -> np.ndarray:
        return np.sqrt(np.square(achieved_goal - desired_goal).sum(axis=-1))


class TinyReachDiscrete(TinyReach):
    """TinyReach with five actions: right, left, up, down, stay."""

    _MOVEMENTS = np.array([[1, 0], [-1, 0], [0, 1], [0, -1], [0, 0]], np.float32)

    def __init__(self) -> None:
        super().__init__()
        self.action_space = spaces.Discrete(len(self._MOVEMENTS))

    def _movement(self, action: np.ndarray) -> np.ndarray:
        return self._MOVEMENTS[int(action)]


class TinyBox(gym.Env):
    """TinyReach as one vector of place and goal, with minus their distance as reward."""

    def __init__(self) -> None:
        self._reach = TinyReach()
        self.action_space = self._reach.action_space
        self.observation_space = spaces.Box(-1.0, 1.0, (4,), np.float32)

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> ResetResult:
        """Put the point and the goal at random places."""
        super().reset(seed=seed)
        self._reach.np_random = self.np_random
        observation, info = self._reach.reset()
        return self._flat(observation), info

    def step(self, action: np.ndarray) -> StepResult:
        """Move the point; the reward is minus its distance to the goal."""
        observation, _, terminated, truncated, info = self._reach.step(action)
        distance = TinyReach._distance(observation["achieved_goal"], observation["desired_goal"])
        return self._flat(observation), -float(distance), terminated, truncated, info

    @staticmethod
    def _flat(observation: Observation) -> np.ndarray:
        return np.concatenate([observation["observation"], observation["desired_goal"]])


class TinyDiscrete(gym.Env):
    """A corridor with two doors: one pays 1, the other costs 1, and both end the episode.

    The walker starts near the middle of [-1, 1] and steps left (0) or right (1) by 0.2. The
    observation is its place and the side of the door that pays (-1 or 1).
    """

    STEP_LENGTH = 0.2

    def __init__(self) -> None:
        self.action_space = spaces.Discrete(2)
        self.observation_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self._place = 0.0
        self._paying_side = 1.0

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> ResetResult:
        """Put the walker near the middle and choose the door that pays."""
        super().reset(seed=seed)
        self._place = float(self.np_random.uniform(-0.3, 0.3))
        self._paying_side = 1.0 if self.np_random.random() < 0.5 else -1.0
        return self._observe(), {"is_success": False}

    def step(self, action: np.ndarray) -> StepResult:
        """Take a step to the left (0) or to the right (1)."""
        direction = 1.0 if int(action) == 1 else -1.0
        self._place = min(1.0, max(-1.0, self._place + self.STEP_LENGTH * direction))
        terminated = abs(self._place) >= 1.0
        reward = self._place * self._paying_side if terminated else 0.0
        return self._observe(), reward, terminated, False, {"is_success": reward > 0.0}

    def _observe(self) -> np.ndarray:
        return np.array([self._place, self._paying_side], np.float32)


class TinyPixels(gym.Env):
    """Frames, observations and rewards all say which step of which episode they belong to.

    Episodes count from 0 with each reset, steps from 0 at the reset. The observation is
    ``(episode, step)``, the reward ``episode + step / 100``, and `decode_frame` reads both numbers
    from a frame. The blocks of a frame are large enough to survive video compression.

    Args:
        render_mode: ``rgb_array``, or None for no frames.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012 - Gymnasium's name

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.observation_space = spaces.Box(0.0, np.inf, (2,), np.float32)
        self._episode = -1
        self._step = 0

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> ResetResult:
        """Begin the next episode."""
        super().reset(seed=seed)
        self._episode += 1
        self._step = 0
        return self._observe(), {}

    def step(self, action: np.ndarray) -> StepResult:
        """Count one step on; the action does not matter."""
        self._step += 1
        return self._observe(), self._episode + self._step / 100, False, False, {}

    def render(self) -> np.ndarray:
        """Return the current frame. Shapes: ``(64, 128, 3)``."""
        return encode_frame(self._episode, self._step)

    def _observe(self) -> np.ndarray:
        return np.array([self._episode, self._step], np.float32)


_BLOCK_PIXELS = 16
_BITS = 16  # per counter: two rows of eight blocks
_BLACK, _WHITE = 16, 235


def encode_frame(episode: int, step: int) -> np.ndarray:
    """Draw two counters as black and white blocks, the lowest bit first.

    Args:
        episode: From 0 to 65535; the upper half of the frame.
        step: From 0 to 65535; the lower half.

    Shapes:
        result: ``(64, 128, 3)``, uint8.
    """
    counters = np.array([[episode], [step]])
    bits = (counters >> np.arange(_BITS) & 1).reshape(4, 8)
    pixels = np.where(bits, _WHITE, _BLACK).astype(np.uint8)
    blocks = np.kron(pixels, np.ones((_BLOCK_PIXELS, _BLOCK_PIXELS), np.uint8))
    return np.repeat(blocks[:, :, None], 3, axis=2)


def decode_frame(frame: np.ndarray) -> tuple[int, int]:
    """Return the episode and the step that a frame of TinyPixels belongs to.

    Args:
        frame: Also from a compressed video. Shapes: ``(64, 128, 3)``.
    """
    # The middle of a block is far from its compressed edges.
    middle = slice(_BLOCK_PIXELS // 4, 3 * _BLOCK_PIXELS // 4)
    blocks = frame.reshape(4, _BLOCK_PIXELS, 8, _BLOCK_PIXELS, 3)[:, middle, :, middle]
    bits = blocks.mean(axis=(1, 3, 4)) > (_BLACK + _WHITE) / 2
    episode, step = bits.reshape(2, _BITS).astype(int) @ (1 << np.arange(_BITS))
    return int(episode), int(step)
