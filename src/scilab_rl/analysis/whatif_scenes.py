"""Pictures of an episode's scenes from near, and where the futures lie in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from scilab_rl.analysis.whatif import Future
from scilab_rl.envs.frames import simplify_scene
from scilab_rl.envs.run_env import RunEnv
from scilab_rl.envs.scenes import EpisodeScenes, change_goal
from scilab_rl.recording.records import Clip, encode_picture

if TYPE_CHECKING:
    from scilab_rl.envs.scene_painting import Scene

_MOST_PLACES = 4  # of a goal that are drawn, for example blocks
# The size of what the camera looks at: in the extent of the places, and at least, so that something
# of the robot is seen, in the extent of the model.
_ZOOM, _SMALLEST = 0.75, 0.12
Pixels = list[list[float]]  # as shares of width and height


@dataclass(frozen=True)
class ScenePictures:
    """Pictures of scenes, all from one camera.

    Attributes:
        pictures: JPEG or PNG by the number of the scene; empty where it could not be drawn.
        view: The camera; None where places of the world cannot be found in the pictures.
    """

    pictures: dict[int, bytes]
    view: Scene | None = None

    def pixels(self, goal: np.ndarray | None) -> Pixels:
        """Return where a goal is seen, as shares of width and height.

        A goal of several places, for example of blocks, is seen several times.
        """
        if self.view is None or goal is None:
            return []
        height, width = self.view.depth.shape
        seen = [self.view.pixel(place) for place in world_places(goal)]
        return [[round(x / width, 4), round(y / height, 4)] for x, y in seen]


def recorded_pictures(clip: Clip, scenes: Sequence[int]) -> ScenePictures:
    """Return the pictures that were recorded; nothing can be drawn into them."""
    return ScenePictures({scene: clip.records[scene].picture for scene in scenes})


def render_scenes(
    env: RunEnv,
    episode: EpisodeScenes,
    scenes: Sequence[int],
    futures: Sequence[Future],
    new_goal: np.ndarray | None,
) -> ScenePictures | None:
    """Render scenes from as near as the places of goals allow.

    Args:
        env: An environment of the task that draws.
        episode: The episode.
        scenes: Numbers of the scenes.
        futures: What will be drawn into them.
        new_goal: Another desired goal than the episode's.

    Returns:
        None where the task is not one of MuJoCo with goals that are places.
    """
    from scilab_rl.envs.scene_painting import view_scene

    places = [p for future in futures for goal in future.achieved for p in world_places(goal)]
    if not places:
        return None
    low, high = np.min(places, axis=0), np.max(places, axis=0)
    env.reset(seed=0)
    simplify_scene(env)
    extent = float(env.unwrapped.model.stat.extent)  # type: ignore[attr-defined]
    size = max(_ZOOM * float(np.linalg.norm(high - low)), _SMALLEST * extent)
    pictures, view = {}, None
    for scene in scenes:
        observation = episode.put(env, scene)
        if new_goal is not None:
            change_goal(env, observation, new_goal)
        view = view_scene(env.env, (low + high) / 2, size)
        if view is None:
            return None
        pictures[scene] = encode_picture(view.picture)
    return ScenePictures(pictures, view)


def world_places(goal: np.ndarray) -> list[np.ndarray]:
    """Return the places (3,) in m of a goal: of three numbers each, or two in a maze."""
    numbers = np.asarray(goal, np.float64).reshape(-1)
    if len(numbers) == 2:
        return [np.array([*numbers, 0.0])]
    return [*numbers[: len(numbers) // 3 * 3].reshape(-1, 3)][:_MOST_PLACES]
