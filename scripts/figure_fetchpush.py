"""The figure of the Scilab-RL paper: does the critics' variance rise when the block falls?

Takes an agent that was trained on FetchPush, pushes the block over the edge of the table by a
script, at least 20 times, and looks at the variance of its critics before, at and after the fall.
Writes a picture, a table and a Wilcoxon test, whatever they say.

Run: make figure-fetchpush, or python scripts/figure_fetchpush.py RUN [--falls 20]
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import wilcoxon

from scilab_rl.config.recorded import load_recorded
from scilab_rl.config.workspace import open_project
from scilab_rl.drawing import COLORS
from scilab_rl.envs.frames import NEARER, move_camera, simplify_scene
from scilab_rl.envs.vectorize import make_eval_env
from scilab_rl.learning.inspector import AgentInspector
from scilab_rl.recording.gl import choose_backend
from scilab_rl.run.checks import complete, prepare_torch
from scilab_rl.run.directory import CONFIG_FILE, find_run
from scilab_rl.run.parts import make_algorithm
from scilab_rl.training.policy import load_policy

STEPS_PER_EPISODE = 120
ACTIONS = ("executed", "policy")  # of which the variance is measured
CROP = np.s_[150:470, 100:]  # pixels of a frame: gripper, block and table
WINDOW = 10  # steps before and after the fall
FALL_BEGINS_METRES = 0.03  # below its resting height the block has left the table
GRIPPER, BLOCK = slice(0, 3), slice(3, 6)  # of FetchPush's observation
PUSH_HEIGHT, TRAVEL_HEIGHT, BEHIND = 0.425, 0.50, 0.08  # metres
GAIN = 12.0  # action per metre of distance; actions are cut at 1


class ScriptedPush:
    """Goes behind the block, down, and pushes it over the far edge of the table (+x)."""

    def __init__(self) -> None:
        self.phase = "above"

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return the action. Shapes: observation ``(25,)``; result ``(4,)``."""
        gripper, block = observation[GRIPPER], observation[BLOCK]
        start = np.array([block[0] - BEHIND, block[1], TRAVEL_HEIGHT])
        if self.phase == "above" and np.linalg.norm(gripper - start) < 0.02:
            self.phase = "down"
        if self.phase == "down" and gripper[2] < PUSH_HEIGHT + 0.01:
            self.phase = "push"
        goal = {
            "above": start,
            "down": np.array([start[0], start[1], PUSH_HEIGHT]),
            "push": np.array([block[0] + 0.1, block[1], PUSH_HEIGHT]),
        }[self.phase]
        return np.append(np.clip(GAIN * (goal - gripper), -1, 1), 0.0).astype(np.float32)


def main() -> None:
    """Measure, draw, and print the table."""
    options = _parse()
    open_project()
    run = find_run(options.run, options.base_logdir)
    env, model = _agent(run)
    falls: list[dict[str, Any]] = []
    attempts = 0
    while len(falls) < options.falls and attempts < 4 * options.falls:
        attempts += 1
        fall = _push_once(env, model, seed=options.seed + attempts, with_frames=not falls)
        if fall is not None:
            falls.append(fall)
    env.close()
    result = _statistics(falls, attempts)
    options.output.parent.mkdir(parents=True, exist_ok=True)
    _draw(falls, result, options.output)
    kept = {name: [_around(fall, name).tolist() for fall in falls] for name in ACTIONS}
    text = json.dumps(result | {"traces": kept}, indent=2)
    options.output.with_suffix(".json").write_text(f"{text}\n")
    _print(result, options.output)


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", help="a run of sac_var, or any algorithm with critics, on FetchPush")
    parser.add_argument("--base-logdir", type=Path, default=Path("data"))
    parser.add_argument("--falls", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--output", type=Path, default=Path("docs/images/fetchpush_fall.png"))
    return parser.parse_args()


def _agent(run: Any) -> tuple[Any, Any]:
    cfg = complete(load_recorded(run / CONFIG_FILE))
    prepare_torch(cfg)
    choose_backend()
    arguments = {**cfg.algorithm.arguments, "buffer_size": 1000}
    cfg = dataclasses.replace(
        cfg,
        env_kwargs={"max_episode_steps": STEPS_PER_EPISODE},
        algorithm=dataclasses.replace(cfg.algorithm, arguments=arguments),
    )
    env = make_eval_env(cfg, "rgb_array")
    simplify_scene(env.envs[0])
    model = make_algorithm(cfg, env)
    load_policy(model, run / "rl_model_finished")
    return env, model


def _push_once(env: Any, model: Any, seed: int, with_frames: bool) -> dict[str, Any] | None:
    """Push in one episode; return what happened around the fall, or None when nothing fell."""
    inspector, script = AgentInspector(model), ScriptedPush()
    env.seed(seed)
    observations = env.reset()
    if with_frames:
        env.envs[0].render()  # there is no camera before
        move_camera(env.envs[0], NEARER)
    resting = observations["observation"][0][BLOCK][2]
    variances: dict[str, list[float]] = {"executed": [], "policy": []}
    frames, fell_at = [], None
    for step in range(STEPS_PER_EPISODE - 1):
        observation = {key: value[0] for key, value in observations.items()}
        action = script.act(observation["observation"])
        wanted, _ = model.predict(observation, deterministic=True)
        for name, considered in (("executed", action), ("policy", wanted)):
            variances[name].append(float(np.var(inspector.q_values(observation, considered))))
        if with_frames:
            frames.append(env.envs[0].render())
        if fell_at is None and observation["observation"][BLOCK][2] < resting - FALL_BEGINS_METRES:
            fell_at = step
        if fell_at is not None and step >= fell_at + WINDOW:
            break
        observations, *_ = env.step(action[None])
    if fell_at is None or fell_at < WINDOW or len(variances["policy"]) <= fell_at + WINDOW:
        return None
    return {"fell_at": fell_at, "variances": variances, "frames": frames}


def _statistics(falls: list[dict[str, Any]], attempts: int) -> dict[str, Any]:
    """Compare the mean variance before the fall with those at and after it, pair by pair."""
    result: dict[str, Any] = {"falls": len(falls), "attempts": attempts}
    for name in ACTIONS:
        around = np.array([_around(fall, name) for fall in falls])
        before = around[:, :WINDOW].mean(axis=1)
        at, after = around[:, WINDOW], around[:, WINDOW + 1 :].mean(axis=1)
        result[name] = {
            "median_before": float(np.median(before)),
            "median_at": float(np.median(at)),
            "median_after": float(np.median(after)),
            "median_ratio_after_to_before": float(np.median(after / before)),
            "falls_with_a_rise": int((after > before).sum()),
            "wilcoxon_p_rise_at": float(wilcoxon(at, before, alternative="greater").pvalue),
            "wilcoxon_p_rise_after": float(wilcoxon(after, before, alternative="greater").pvalue),
            "wilcoxon_p_two_sided_after": float(wilcoxon(after, before).pvalue),
        }
    return result


def _around(fall: dict[str, Any], name: str) -> np.ndarray:
    start = fall["fell_at"] - WINDOW
    return np.array(fall["variances"][name][start : start + 2 * WINDOW + 1])


def _draw(falls: list[dict[str, Any]], result: dict[str, Any], path: Path) -> None:
    """Draw three scenes of the first fall, and the variance around all falls."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    first = falls[0]
    offsets = (-WINDOW, 0, WINDOW)
    figure, axes = plt.subplots(1, 4, figsize=(15, 3.8), width_ratios=[1, 1, 1, 1.6])
    for axis, offset, letter in zip(axes, offsets, "abc", strict=False):
        axis.imshow(first["frames"][first["fell_at"] + offset][CROP])
        when = "the block leaves the table" if offset == 0 else f"step {offset:+d}"
        axis.set_title(f"{letter}: {when}", fontsize=10)
        axis.axis("off")
    _draw_traces(axes[3], falls, offsets)
    axes[3].set_title(f"critic variance around {result['falls']} falls", fontsize=10, pad=18)
    figure.tight_layout()
    figure.savefig(path, dpi=80)


def _draw_traces(axes: Any, falls: list[dict[str, Any]], offsets: tuple[int, ...]) -> None:
    steps = np.arange(-WINDOW, WINDOW + 1)
    for name, label, color in (
        ("policy", "the agent's own action", COLORS[0]),
        ("executed", "the scripted action", COLORS[1]),
    ):
        around = np.array([_around(fall, name) for fall in falls])
        axes.plot(steps, around.T, color=color, linewidth=0.6, alpha=0.25)
        median = np.median(around, axis=0)
        axes.plot(steps, median, color=color, linewidth=2.4, label=f"{label}, median")
    for offset, letter in zip(offsets, "abc", strict=True):
        axes.axvline(offset, color="grey", linewidth=0.8, linestyle=":")
        axes.annotate(letter, (offset, 1.02), xycoords=("data", "axes fraction"), ha="center")
    axes.set(xlabel="steps from the fall", yscale="log")
    axes.legend(frameon=False, fontsize=8)
    axes.spines[["top", "right"]].set_visible(False)


def _print(result: dict[str, Any], path: Path) -> None:
    write = sys.stdout.write
    write(f"{result['falls']} falls in {result['attempts']} pushes; picture: {path}\n")
    write("action    before    at        after     after/before  rises  p (rise, Wilcoxon)\n")
    for name in ACTIONS:
        row = result[name]
        write(
            f"{name:<9} {row['median_before']:<9.3g} {row['median_at']:<9.3g} "
            f"{row['median_after']:<9.3g} {row['median_ratio_after_to_before']:<13.2f} "
            f"{row['falls_with_a_rise']:>2}/{result['falls']}  {row['wilcoxon_p_rise_after']:.2g}\n"
        )


if __name__ == "__main__":
    main()
