import gymnasium as gym
import numpy as np
import pytest

from scilab_rl.config.schema import RunConfig
from scilab_rl.envs.frames import FRAME_KEY, frame_rate
from scilab_rl.envs.run_env import RunEnv
from scilab_rl.envs.vectorize import make_eval_env, observed_layer
from scilab_rl.recording.gl import choose_backend
from scilab_rl.testing import decode_frame


class Collecting:
    def __init__(self):
        self.seen = []

    def on_step(self, batch):
        self.seen.append((batch.rewards[0], batch.frames[0]))


def watched():
    cfg = RunConfig("scilab_rl.testing:TinyPixels-v0", seed=1)
    env, collecting = make_eval_env(cfg, "rgb_array"), Collecting()
    observed_layer(env).observers.append(collecting)
    return env, collecting


def test_each_frame_belongs_to_its_step_also_the_last_of_an_episode():
    env, collecting = watched()
    env.env_method("capture_frames", True)
    env.reset()
    firsts = [decode_frame(observed_layer(env).reset_frame)]
    for _ in range(30):
        _, _, dones, _ = env.step(np.zeros((1, 1), np.float32))
        if dones[0]:
            firsts.append(decode_frame(observed_layer(env).reset_frame))
    assert firsts == [(0, 0), (1, 0), (2, 0), (3, 0)]
    decoded = [decode_frame(frame) for _, frame in collecting.seen]
    assert decoded == [(episode, step) for episode in range(3) for step in range(1, 11)]
    for (episode, step), (reward, _) in zip(decoded, collecting.seen, strict=True):
        assert reward == pytest.approx(episode + step / 100)


def test_without_the_switch_nothing_is_drawn():
    env, collecting = watched()
    env.reset()
    env.step(np.zeros((1, 1), np.float32))
    assert observed_layer(env).reset_frame is None
    assert collecting.seen[0][1] is None


def test_capturing_begins_with_an_episode_and_ends_at_once():
    env, collecting = watched()
    env.reset()
    env.env_method("capture_frames", True)
    for step in range(12):
        env.step(np.zeros((1, 1), np.float32))
        if step == 10:
            env.env_method("capture_frames", False)
    drawn = [frame is not None for _, frame in collecting.seen]
    assert drawn == [False] * 10 + [True, False]


def test_frames_do_not_stay_in_the_infos():
    env, _ = watched()
    env.env_method("capture_frames", True)
    env.reset()
    infos = env.step(np.zeros((1, 1), np.float32))[3]
    assert FRAME_KEY not in infos[0]


class Drawing(gym.Env):
    """Returns the frames that it is given, one after the other, then the last one again."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 - Gymnasium's
    observation_space = action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, *frames):
        self.render_mode, self.frames, self.n_rendered = "rgb_array", frames, 0

    def reset(self, *, seed=None, options=None):
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return np.zeros(1, np.float32), 0.0, False, False, {}

    def render(self):
        frame = self.frames[min(self.n_rendered, len(self.frames) - 1)]
        self.n_rendered += 1
        if isinstance(frame, Exception):
            raise frame
        return frame


def captured(*frames):
    """Return what comes in of these frames."""
    env = RunEnv(Drawing(*frames))
    env.capture_frames(True)
    infos = [env.reset()[1], *(env.step(np.zeros(1))[-1] for _ in frames[1:])]
    return [info[FRAME_KEY] for info in infos]


GRAY = np.array([[0, 51, 102], [153, 204, 255]])  # fifths of white; 2 pixels high, 3 wide
RGB = np.stack([GRAY, GRAY[::-1], GRAY[:, ::-1]], axis=-1)
OPAQUE = np.full((2, 3, 1), 255)
REPEATED = np.repeat(GRAY[:, :, None], 3, axis=2)


@pytest.mark.parametrize(
    ("frame", "wanted"),
    [
        (RGB.astype(np.uint8), RGB),
        (np.concatenate([RGB, OPAQUE], axis=2).astype(np.uint8), RGB),
        (np.concatenate([RGB, OPAQUE], axis=2) / 255, RGB),
        (GRAY.astype(np.uint8), REPEATED),
        (GRAY[:, :, None].astype(np.uint8), REPEATED),
        (GRAY / 255, REPEATED),
        ((RGB / 255).astype(np.float16), RGB),
        ((RGB / 255).astype(np.float32), RGB),
        (RGB / 255, RGB),
        (RGB / 255 * 1.001, RGB),  # a filter overshoots
        (RGB.astype(np.float32), RGB),
        (RGB.astype(np.float64) + 0.4, RGB),
        *((RGB.astype(kind), RGB) for kind in ("uint16", "int16", "int32", "int64", "uint64")),
        (np.array([[0, 1]], np.int64), np.array([[[0] * 3, [1] * 3]])),
        (np.array([[False, True]]), np.array([[[0] * 3, [255] * 3]])),
        (RGB.tolist(), RGB),
        (RGB.astype(np.uint8)[::-1, ::-1], RGB[::-1, ::-1]),
    ],
)
def test_every_form_of_a_picture_becomes_one(frame, wanted):
    [picture] = captured(frame)
    assert picture.dtype == np.uint8
    assert picture.flags.c_contiguous
    assert picture.tolist() == wanted.tolist()


def test_what_is_transparent_lies_on_white():
    frame = np.array([[[200, 100, 0, 255], [200, 100, 0, 51], [200, 100, 0, 0]]], np.uint8)
    [picture] = captured(frame)
    assert picture.tolist() == [[[200, 100, 0], [244, 224, 204], [255, 255, 255]]]


def test_a_dark_frame_of_floats_is_as_bright_as_those_before_it():
    bright, dark = np.full((1, 1, 3), 200.0), np.full((1, 1, 3), 1.0)
    assert [frame.max() for frame in captured(bright, dark)] == [200, 1]
    assert [frame.max() for frame in captured(dark)] == [255]


@pytest.mark.parametrize("shape", [(101, 37, 3), (3, 4000, 3), (1, 1, 3)])
def test_sides_stay_as_they_are(shape):
    assert captured(np.zeros(shape, np.uint8))[0].shape == shape


def test_a_frame_that_no_file_can_hold_is_thinned_out():
    assert captured(np.zeros((2, 70000, 3), np.uint8))[0].shape == (1, 3889, 3)


def test_a_frame_is_a_copy():
    canvas = np.zeros((2, 2, 3), np.uint8)
    [picture] = captured(canvas)
    canvas[:] = 9
    assert picture.max() == 0


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        (None, "render() returned None"),
        ("a map in letters", "render() returned text"),
        ({"pixels": RGB}, "render() returned dict"),
        ([RGB, GRAY], "render() returned"),
        (np.full((2, 2, 3), np.nan), "NaN"),
        (np.full((2, 2, 3), np.inf), "infinite"),
        (np.zeros((0, 2, 3), np.uint8), "shape (0, 2, 3)"),
        (np.zeros(7, np.uint8), "shape (7,)"),
        (np.zeros((3, 64, 64), np.uint8), "shape (3, 64, 64)"),
        (np.zeros((5, 64, 64, 3), np.uint8), "shape (5, 64, 64, 3)"),
        (np.array([[-1.0, 1.0]]), "from -1 to 1"),
        (np.array([[0, 256]]), "from 0 to 256"),
        (OSError("no display"), "OSError: no display"),
    ],
)
def test_what_is_no_picture_is_the_reason_and_the_task_goes_on(frame, reason):
    first, second = captured(frame, frame)
    assert reason in first
    assert second == first


def test_one_bad_frame_costs_one_picture():
    good = RGB.astype(np.uint8)
    assert [type(frame) for frame in captured(good, None, good)] == [np.ndarray, str, np.ndarray]


def test_a_renderer_that_fails_is_not_asked_again():
    env = RunEnv(Drawing(OSError("no display")))
    env.capture_frames(True)
    env.reset()
    env.step(np.zeros(1))
    assert env.unwrapped.n_rendered == 1


@pytest.mark.parametrize("fps", [None, 0, -5, float("nan"), float("inf"), "fast"])
def test_without_a_rate_that_is_one_time_passes_at_25_frames_per_second(fps):
    assert frame_rate({"render_fps": fps}) == frame_rate({}) == 25
    assert frame_rate({"render_fps": np.float32(12.5)}) == 12.5


class Wordless(Drawing):
    """Has no parameter for the way it is drawn."""

    def __init__(self):
        super().__init__(None)


def test_an_environment_that_knows_no_render_mode_is_made_all_the_same():
    gym.register("Wordless-v0", entry_point=Wordless)
    env = make_eval_env(RunConfig("Wordless-v0", seed=1), "rgb_array")
    env.env_method("capture_frames", True)
    env.reset()
    assert observed_layer(env).reset_frame == "render() returned None"
    gym.registry.pop("Wordless-v0")


def _scenes(view):
    cfg = RunConfig("FetchPickAndPlace-v4", seed=1, render_view=view)
    env = make_eval_env(cfg, "rgb_array")
    env.env_method("capture_frames", True)
    env.seed(1)
    env.reset()
    first = observed_layer(env).reset_frame
    steps = [env.step(np.full((1, 4), 0.3, np.float32)) for _ in range(3)]
    env.close()
    return first, [step[0]["observation"] for step in steps]


def test_a_nearer_camera_changes_pictures_only():
    pytest.importorskip("gymnasium_robotics")
    choose_backend()
    (frame, seen), (close, seen_close) = _scenes("task"), _scenes("close")
    assert np.array_equal(seen, seen_close)
    assert frame.shape == close.shape
    corner = np.s_[5:60, 400:470]  # the background; it is green in the task
    assert np.abs(close[corner].astype(int) - [238, 240, 244]).max() <= 8
    assert not np.array_equal(frame[corner], close[corner])
