"""Draw the figures of the pages under *Understand* into docs/images/.

python -m docs.figures [--train]: with ``--train``, the learning curves are trained again (some
minutes); else they are drawn from docs/figures/curves.json.
"""

from __future__ import annotations

import json
import re
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from scipy.stats import binomtest
from torch import nn

from scilab_rl.config.compose import compose, friendly_override
from scilab_rl.envs.templates.minimal import MyTask
from scilab_rl.metrics.success import success_of
from scilab_rl.run.run import start_run

IMAGES = Path(__file__).parents[1] / "images"
CURVES = Path(__file__).parent / "curves.json"
BLUE, ORANGE, GREY = "#2563eb", "#ea580c", "#6b7280"
ENV = "PointTask-v0"
TRAINING = (
    "algorithm=cleansac", f"env={ENV}", "n_epochs=10", "eval_after_n_steps=250",
    "n_test_rollouts=20", "early_stop_threshold=2", "mlflow=0", "algorithm.learning_rate=1e-3",
    "algorithm.gamma=0.95", "algorithm.tau=0.05", "algorithm.batch_size=128",
    "algorithm.net_arch=[64,64]", "algorithm.buffer_size=10000", "algorithm.learning_starts=200",
)  # fmt: skip
N_SEEDS = 4


def figure_gamma() -> None:
    """What a reward in the future is worth."""
    figure, axes = new_axes("steps until the reward", "what it is worth now")
    steps = np.arange(101)
    for gamma, color in ((0.9, GREY), (0.95, ORANGE), (0.99, BLUE)):
        axes.plot(steps, gamma**steps, color=color, label=f"γ = {gamma}")
    axes.legend(frameon=False, loc="upper right")
    axes.set_ylim(0, 1.02)
    save(figure, "gamma")


def figure_interval() -> None:
    """How much the success of n episodes says."""
    figure, axes = new_axes("episodes played", "success rate: 95 % interval")
    counts = np.arange(5, 201, 5)
    for rate, color in ((0.8, ORANGE), (1.0, BLUE)):
        tests = [binomtest(round(rate * n), int(n)) for n in counts]
        bounds = np.array([test.proportion_ci(method="wilson") for test in tests])
        axes.fill_between(counts, bounds[:, 0], bounds[:, 1], color=color, alpha=0.25, lw=0)
        axes.axhline(rate, color=color)
        axes.annotate(f"{rate:.0%} seen", (160, rate), (0, -14), textcoords="offset points")
    axes.set_ylim(0.3, 1.02)
    save(figure, "interval")


def figure_disagreement() -> None:
    """Five networks that fit the same points agree where the points are."""
    torch.manual_seed(3)
    rng = np.random.default_rng(3)
    states = np.concatenate([rng.uniform(-2, -0.6, 30), rng.uniform(0.4, 1.2, 20)])
    x = torch.as_tensor(states, dtype=torch.float32)[:, None]
    y = torch.sin(2 * x) + 0.05 * torch.randn_like(x)
    grid = torch.linspace(-3, 3, 200)[:, None]
    answers = np.stack([fit(x, y)(grid).detach().numpy()[:, 0] for _ in range(5)])
    figure, (above, below) = plt.subplots(
        2, 1, figsize=(7, 4.2), sharex=True, height_ratios=(2, 1), layout="constrained"
    )
    above.plot(grid[:, 0], answers.T, color=BLUE, lw=1, alpha=0.7)
    above.plot(x[:, 0], y[:, 0], "o", color=ORANGE, ms=4, label="data")
    above.set(ylabel="five networks", ylim=(-3, 3))
    above.legend(frameon=False, loc="upper left")
    below.fill_between(grid[:, 0], answers.var(axis=0), color=BLUE, alpha=0.3, lw=0)
    below.set(ylabel="variance", xlabel="state")
    for axes in (above, below):
        axes.spines[["top", "right"]].set_visible(False)
    save(figure, "disagreement")


def fit(x: torch.Tensor, y: torch.Tensor) -> nn.Module:
    """Return a small network that was fitted to the points, from random weights of its own."""
    net = nn.Sequential(nn.Linear(1, 32), nn.Tanh(), nn.Linear(32, 32), nn.Tanh(), nn.Linear(32, 1))
    optimizer = torch.optim.Adam(net.parameters(), lr=1e-2)
    for _ in range(400):
        optimizer.zero_grad()
        nn.functional.mse_loss(net(x), y).backward()
        optimizer.step()
    return net


def figure_her() -> None:
    """An episode that missed its goal, and the same episode relabeled."""
    env = MyTask()
    observation, _ = env.reset(seed=4)
    env.goal = np.array([0.75, 0.65], dtype=np.float32)
    rng, heading, places = np.random.default_rng(2), 1.0, [observation["achieved_goal"].copy()]
    for _ in range(16):  # a walk with some persistence, as of an agent that is still learning
        heading -= 0.14 + 0.25 * rng.normal()
        action = 0.9 * np.array([np.cos(heading), np.sin(heading)], dtype=np.float32)
        observation, _, _, _, info = env.step(action)
        places.append(observation["achieved_goal"].copy())
    assert not success_of(info)
    path, reached = np.array(places), places[-1]
    figure, panels = plt.subplots(1, 2, figsize=(7, 3.6), layout="constrained", sharey=True)
    titles = ("what was wanted: each step costs 1", "hindsight: as if this had been the goal")
    for axes, title, goal in zip(panels, titles, (env.goal, reached), strict=True):
        axes.plot(*path.T, ".-", color=BLUE, ms=5)
        axes.plot(*path[0], "o", color=BLUE, ms=9)
        circle = plt.Circle(tuple(goal), env.threshold, color=ORANGE, alpha=0.5, lw=0)
        axes.add_patch(circle)
        axes.set(
            title=title, xlim=(-0.4, 1.2), ylim=(-0.5, 1), aspect="equal", xticks=[], yticks=[]
        )
        axes.title.set_fontsize(10)
    panels[0].annotate("goal", env.goal, (-16, 21), textcoords="offset points")
    panels[1].plot(*env.goal, "x", color=GREY)
    panels[1].annotate("reached", reached, (14, -28), textcoords="offset points", ha="right")
    save(figure, "her")


def figure_her_learning() -> None:
    """The same agent with and without hindsight."""
    curves = json.loads(CURVES.read_text(encoding="utf-8"))
    figure, axes = new_axes("training steps", "success rate")
    for name, color in (("with hindsight", BLUE), ("without", ORANGE)):
        values = np.array(curves[name])
        for run in values:
            axes.plot(curves["steps"], run, color=color, alpha=0.2, lw=1)
        axes.plot(curves["steps"], values.mean(axis=0), color=color, lw=2.5, label=name)
    axes.set_ylim(-0.02, 1.02)
    axes.legend(frameon=False, title=f"point task, mean of {N_SEEDS} runs")
    save(figure, "her_learning")


def figure_seeds() -> None:
    """Runs that differ in the seed only."""
    curves = json.loads(CURVES.read_text(encoding="utf-8"))
    figure, axes = new_axes("training steps", "success rate")
    for run in curves["with hindsight"]:
        axes.plot(curves["steps"], run, color=BLUE, alpha=0.6, lw=1.5)
    axes.set_ylim(-0.02, 1.02)
    save(figure, "seeds")


def figure_pictures() -> None:
    """What `GoalEnv` draws of one, two and three numbers, and the example of the page."""
    page = (Path(__file__).parents[1] / "howto" / "draw_environment.md").read_text(encoding="utf-8")
    example = re.search(r"```python title=\"src/custom_envs/open_field.py\"\n(.*?)```", page, re.S)
    assert example is not None
    names: dict[str, Any] = {}
    exec(example[1], names)
    figure, axes = plt.subplots(2, 2, figsize=(7, 7.3), layout="constrained")
    tasks = [Wander(1), Wander(2), Wander(3), names["OpenField"](render_mode="rgb_array")]
    titles = ["one number", "two numbers", "three numbers", "drawn by render()"]
    for axis, task, title in zip(axes.flat, tasks, titles, strict=True):
        task.reset(seed=3)
        direction = np.sign(task.goal - task.achieved_goal())
        for step in range(9):  # towards the goal, on a detour
            task.step(
                (direction * np.roll((0.9, 0.1, 0.5), step // 3)[: len(direction)]).astype(
                    np.float32
                )
            )
        axis.imshow(task.render())
        axis.set_title(title, fontsize=11)
        axis.axis("off")
    save(figure, "pictures")


class Wander(MyTask):
    """The template's task with any number of dimensions."""

    def __init__(self, size: int) -> None:
        self.action_size = size
        super().__init__(render_mode="rgb_array")

    def reset_state(self) -> None:
        """Begin in the middle."""
        self.place = np.zeros(self.action_size)

    def sample_goal(self) -> np.ndarray:
        """Draw a place that is some steps away."""
        return self.np_random.choice([-1, 1], self.action_size) * self.np_random.uniform(
            0.4, 0.9, self.action_size
        )


def train_curves() -> None:
    """Train with and without hindsight, and keep the success rates."""
    gym.register(ENV, MyTask, max_episode_steps=30)
    curves: dict[str, list] = {}
    buffers = {"with hindsight": "auto", "without": "null"}
    with tempfile.TemporaryDirectory() as folder:
        for name, buffer in buffers.items():
            more = (f"algorithm.replay_buffer_class={buffer}", f"base_logdir={folder}")
            curves[name] = [success_rates(seed, *more) for seed in range(1, N_SEEDS + 1)]
    steps = [250 * (epoch + 1) for epoch in range(len(curves["without"][0]))]
    CURVES.write_text(json.dumps({"steps": steps, **curves}) + "\n", encoding="utf-8")


def success_rates(seed: int, *overrides: str) -> list[float]:
    """Train once and return the success rate after each epoch."""
    words = [friendly_override(w) for w in (*TRAINING, f"seed={seed}", *overrides)]
    result = start_run(compose(words), words)
    lines = (Path(result.run_dir) / "metrics.csv").read_text(encoding="utf-8").splitlines()
    column = lines[0].split(",").index("eval/success_rate")
    return [float(line.split(",")[column]) for line in lines[1:]]


def new_axes(x: str, y: str) -> tuple[plt.Figure, Axes]:
    """Return a figure with one pair of axes."""
    figure, axes = plt.subplots(figsize=(7, 3.2), layout="constrained")
    axes.set(xlabel=x, ylabel=y)
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def save(figure: plt.Figure, name: str) -> None:
    """Write a figure to docs/images/."""
    figure.savefig(IMAGES / f"figure_{name}.png", dpi=130)
    plt.close(figure)


FIGURES: tuple[Callable[[], None], ...] = (
    figure_gamma, figure_interval, figure_disagreement, figure_her, figure_her_learning,
    figure_seeds, figure_pictures,
)  # fmt: skip

if __name__ == "__main__":
    if "--train" in sys.argv[1:]:
        train_curves()
    for draw in FIGURES:
        draw()
