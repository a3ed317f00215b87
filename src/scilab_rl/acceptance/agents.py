"""Trained agents: the policy of a run as a small folder, with a card that is measured and written.

The folder has the files of a run, so that it loads as any run does: ``config.yaml``,
``metrics.jsonl`` with the evaluations, ``result.json`` and the policy; and ``card.json`` with
``README.md``, which says the same in words.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
import json
import logging
import os
import platform
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scilab_rl import files, machine
from scilab_rl.acceptance.baselines import PACKAGES
from scilab_rl.analysis.estimates import Estimate, success_interval
from scilab_rl.config.recorded import as_yaml, load_recorded
from scilab_rl.config.schema import KEYS, RunConfig
from scilab_rl.errors import ConfigError
from scilab_rl.run.directory import (
    CONFIG_FILE,
    RunDirectory,
    find_policy,
    read_epochs,
    reports_success,
    slug,
)
from scilab_rl.run.provenance import PROVENANCE_FILE, fingerprint_of
from scilab_rl.seeding import derive_seed

if TYPE_CHECKING:  # heavy
    from scilab_rl.training.evaluation import Episode

CARD_FILE, PAGE_FILE = "card.json", "README.md"
SEEDS = (1, 2, 3, 4, 5)
_POLICY = "rl_model_finished"
_SUCCESS, _RETURN = "eval/success_rate", "eval/mean_reward"
_MOST_ROWS = 12  # of the curve on the page; the file has all
_log = logging.getLogger(__name__)


def write_agent(
    run: RunDirectory, policy: Path, name: str, folder: Path, *, n_episodes: int, license: str
) -> Path:
    """Make a trained agent from a run, and measure it in episodes that the run has never seen.

    The folder appears when it is complete; an older one of the same name is replaced.

    Args:
        run: The run.
        policy: Its saved policy.
        name: The agent's.
        folder: The folder of agents.
        n_episodes: How many episodes, a multiple of the five seeds.
        license: For example ``MIT``.

    Returns:
        The agent's folder.

    Raises:
        ConfigError: If the name is none, or the run has not been evaluated.
    """
    from scilab_rl.training import checkpoint
    from scilab_rl.training.compact import compact

    if slug(name) != name:
        raise ConfigError(f"An agent's name has letters, digits, '-' and '_', and is not '{name}'.")
    if n_episodes % len(SEEDS):
        raise ConfigError(f"--episodes must be a multiple of {len(SEEDS)}, one share per seed.")
    if not read_epochs(run):
        raise ConfigError(f"The run '{run}' has no evaluation yet: it needs one epoch.")
    folder.mkdir(parents=True, exist_ok=True)
    target, unfinished = folder / name, folder / f".{name}.{os.getpid()}.tmp"
    unfinished.mkdir()
    try:
        saved = checkpoint.verify(policy)
        checkpoint.save(
            compact(checkpoint.load(policy)), unfinished / _POLICY, step=saved["step"],
            about={"epoch": saved.get("epoch")},
        )  # fmt: skip
        _write_history(run, unfinished)
        card = _card(run, unfinished, name, policy, saved["step"], n_episodes, license)
        files.write_json(unfinished / CARD_FILE, card)
        files.write_text(unfinished / PAGE_FILE, "\n".join(card_page(card)) + "\n")
        if target.exists():
            files.discard(target)
        unfinished.rename(target)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return target


def read_card(folder: Path) -> dict[str, Any]:
    """Return the card of an agent.

    Raises:
        ConfigError: If it is missing or damaged.
    """
    try:
        return json.loads((folder / CARD_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"The card of the agent '{folder.name}' cannot be read.") from error


def measure(agent: RunDirectory, seeds: Sequence[int], n_episodes: int) -> dict[str, Any]:
    """Evaluate a trained agent with its most likely actions.

    Args:
        agent: The agent.
        seeds: Each gives its own episodes.
        n_episodes: Episodes of each seed.

    Returns:
        ``evaluation``: success and return with 95 % intervals, and the means of each seed;
        ``known_failures``: how and where episodes failed; ``fingerprint`` of the environment.
    """
    from scilab_rl.run.player import load_player
    from scilab_rl.training.episode_goals import EpisodeGoals
    from scilab_rl.training.evaluation import evaluate_seeds

    cfg, policy = load_recorded(agent / CONFIG_FILE), find_policy(agent, "finished")
    env, model = load_player(cfg, policy, record=False, n_envs=len(seeds))
    goals = EpisodeGoals(env)
    try:
        _log.info("%d episodes of each of the seeds %s ...", n_episodes, ", ".join(map(str, seeds)))
        shares = evaluate_seeds(model, env, n_episodes, [derive_seed(s, "card") for s in seeds])
    finally:
        env.close()
    episodes = [episode for share in shares for episode in share.episodes]
    # An environment that has waited for others has begun more.
    desired, achieved = (
        [goal for share in ends for goal in share[:n_episodes]]
        for ends in (goals.desired, goals.achieved)
    )
    knows_success = reports_success(agent)
    values = [share.metrics(reports_success=knows_success) for share in shares]
    evaluation: dict[str, Any] = {
        "episodes": len(episodes),
        "seeds": list(seeds),
        "return": {
            **_mean([sum(episode.rewards) for episode in episodes]),
            "per_seed": [_rounded(value[_RETURN]) for value in values],
        },
        "mean_length": _rounded(sum(len(e.rewards) for e in episodes) / len(episodes)),
    }
    if _SUCCESS in values[0]:
        n_successes = sum(bool(episode.success) for episode in episodes)
        rate = success_interval(n_successes, len(episodes))
        evaluation["success"] = {
            **_as_dict(rate),
            "per_seed": [_rounded(value[_SUCCESS]) for value in values],
        }
    return {
        "evaluation": evaluation,
        "known_failures": _failures(
            episodes, np.array(desired), np.array(achieved), has_success=_SUCCESS in values[0]
        ),
        "fingerprint": _fingerprint(cfg),
    }


def _card(
    run: RunDirectory,
    agent: Path,
    name: str,
    policy: Path,
    step: int,
    n_episodes: int,
    license: str,
) -> dict[str, Any]:
    cfg = load_recorded(agent / CONFIG_FILE)
    measured = measure(RunDirectory(agent), SEEDS, n_episodes // len(SEEDS))
    source = _source(run)
    if source.get("fingerprint") not in (None, measured["fingerprint"]):
        _log.warning(
            "%s behaves differently from when the run was trained (fingerprint %s, was %s).",
            cfg.env, measured["fingerprint"], source["fingerprint"],
        )  # fmt: skip
    epochs, result = read_epochs(run), run.read_result()
    metric = _SUCCESS if _SUCCESS in epochs[-1] else _RETURN
    return {
        "agent": name,
        "env": cfg.env,
        "env_kwargs": cfg.env_kwargs,
        "algorithm": cfg.algorithm.name,
        "policy": policy.name.removeprefix("rl_model_"),
        "date": dt.date.today().isoformat(),
        **measured,
        "training": {
            "seed": cfg.seed,
            "started_from_another_policy": load_recorded(run / CONFIG_FILE).restore_policy
            is not None,
            "steps": step,
            "minutes": round(_seconds([row for row in epochs if row["step"] <= step]) / 60, 1),
            "status": result.status if result is not None else "unknown",
            "machine": source.get("machine") or _processor_of(source),
            "git_commit": source.get("git_commit"),
            "metric": metric,
            "curve": [[row["step"], _rounded(row[metric])] for row in epochs if metric in row],
        },
        "versions": {
            "python": source.get("python"),
            **{k: v for k, v in (source.get("versions") or {}).items() if k in PACKAGES},
        },
        "bytes": sum(path.stat().st_size for path in agent.rglob("*") if path.is_file()),
        "license": license,
    }


def card_page(card: Mapping[str, Any]) -> Iterator[str]:
    """Yield the lines of the page that says what a card says."""
    evaluation, training = card["evaluation"], card["training"]
    kwargs = "".join(f" `env_kwargs.{key}={value}`" for key, value in card["env_kwargs"].items())
    yield f"# {card['agent']}\n"
    yield "Written by `scilab-rl export RUN --agent`, from measurements; do not edit.\n"
    yield f"```bash\nscilab-rl play agent:{card['agent']} --record\n```\n"
    rows = [("environment", f"`{card['env']}`{kwargs}"), ("algorithm", f"`{card['algorithm']}`")]
    for name in ("success", "return"):
        if name in evaluation:
            found = evaluation[name]
            rows.append((name, f"{found['mean']:.4g} (95 % interval {found['low']:.4g} to "
                               f"{found['high']:.4g})"))  # fmt: skip
            rows.append((f"{name} of each seed", ", ".join(f"{v:.4g}" for v in found["per_seed"])))
    seeds = ", ".join(map(str, evaluation["seeds"]))
    rows += [
        (
            "measured in",
            f"{evaluation['episodes']:,} new episodes, seeds {seeds}; most likely actions",
        ),
        ("steps of training", f"{training['steps']:,} until this policy, seed {training['seed']}"),
        ("minutes", f"{training['minutes']:g} until this policy, with evaluations"),
        ("machine", _in_words(training["machine"])),
        ("policy", f"{card['policy']}, {card['bytes'] / 1e6:.2f} MB"),
        ("fingerprint", f"`{card['fingerprint']}` of the environment"),
        ("versions", ", ".join(f"{k} {v}" for k, v in card["versions"].items())),
        ("commit", f"`{training['git_commit'] or 'unknown'}`"),
        ("date", card["date"]),
        ("license", card["license"]),
    ]
    if training["started_from_another_policy"]:
        rows.append(("note", "training started from another policy, whose steps are not counted"))
    yield "| | |\n|---|---|"
    yield from (f"| {name} | {value} |" for name, value in rows)
    yield "\n## Known failures\n"
    yield from _failures_in_words(card["known_failures"], evaluation["episodes"])
    yield "\n## Curve\n"
    yield f"| step | {training['metric']} |\n|---|---|"
    every = -(-len(training["curve"]) // _MOST_ROWS)
    shown = training["curve"][::-every][::-1]
    yield from (f"| {step:,} | {value:.3g} |" for step, value in shown)


def _in_words(found: Mapping[str, Any]) -> str:
    if not found:
        return "unknown"
    n_cores = found.get("cores")
    cores = n_cores and f"{n_cores} core{'s' * (n_cores > 1)}"
    return ", ".join(filter(None, (found["processor"], cores, found.get("gpu"))))


def _failures_in_words(failures: Mapping[str, Any], n_episodes: int) -> Iterator[str]:
    if "lowest_return" in failures:
        yield (
            f"The lowest return of {n_episodes:,} episodes was {failures['lowest_return']:.4g}; "
            f"5 % were at most {failures['return_of_the_worst_5_percent']:.4g}."
        )
        return
    if not failures["episodes"]:
        yield f"None of {n_episodes:,} episodes failed."
        return
    yield (
        f"{failures['episodes']} of {n_episodes:,} episodes failed; "
        f"{failures['reached_and_left_again']} of them had reached the goal before and left it."
    )
    if "final_distance" in failures:
        distance, goals = failures["final_distance"], failures["goals"]
        yield (
            f"\nThey ended {distance['mean']:.3g} from the goal on average, at most "
            f"{distance['highest']:.3g} (Euclidean, in the units of the goal). Where goals lay:\n"
        )
        yield "| goals | mean | lowest | highest |\n|---|---|---|---|"
        for name, extent in goals.items():
            cells = (", ".join(f"{v:.3g}" for v in extent[k]) for k in ("mean", "low", "high"))
            yield f"| {name} | {' | '.join(cells)} |"


def _write_history(run: RunDirectory, agent: Path) -> None:
    """Write configuration, evaluations and result without paths and choices of this machine."""
    cfg = load_recorded(run / CONFIG_FILE)
    neutral = {key.name: key.default for key in KEYS if not key.affects_learning}
    cfg = RunConfig.from_values({**cfg.values(), **neutral, "tracking": {}, "restore_policy": None})
    files.write_text(agent / CONFIG_FILE, as_yaml(cfg.values()))
    rows = [
        {k: v for k, v in row.items() if k in ("kind", "epoch", "step") or k.startswith("eval/")}
        for row in read_epochs(run)
    ]
    files.write_text(agent / "metrics.jsonl", "".join(f"{json.dumps(row)}\n" for row in rows))
    if (result := run.read_result()) is not None:
        kept = dataclasses.replace(result, run_dir="", metrics={}, error=None)
        RunDirectory(agent).write_result(kept)


def _source(run: RunDirectory) -> dict[str, Any]:
    try:
        return json.loads((run / PROVENANCE_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}


def _processor_of(source: Mapping[str, Any]) -> dict[str, Any]:
    """Return the processor where a run was trained that has not recorded it, if that is here."""
    if source.get("platform") != platform.platform():
        return {}
    return {"processor": machine.describe()["processor"]}


def _seconds(epochs: Sequence[Mapping[str, float]]) -> float:
    """Return the time of training and evaluation, also of a run that was resumed."""
    names = ("time/train_seconds", "time/eval_seconds")
    return sum(row.get(name, 0.0) for row in epochs for name in names)


def _fingerprint(cfg: RunConfig) -> str | None:
    from scilab_rl.envs.vectorize import make_eval_env
    from scilab_rl.run.checks import complete

    env = make_eval_env(complete(cfg))
    try:
        return fingerprint_of(env.envs[0])  # type: ignore[attr-defined]
    finally:
        env.close()


def _failures(
    episodes: Sequence[Episode], desired: np.ndarray, achieved: np.ndarray, *, has_success: bool
) -> dict[str, Any]:
    """Return how episodes failed, and for goals where those lay that were not reached.

    Shapes:
        desired, achieved: ``(n_episodes, n_dimensions)``, or nothing where there are no goals.
    """
    if not has_success:
        returns = [sum(episode.rewards) for episode in episodes]
        return {
            "lowest_return": _rounded(min(returns)),
            "return_of_the_worst_5_percent": _rounded(np.quantile(returns, 0.05)),
        }
    failed = np.array([not episode.success for episode in episodes])
    found: dict[str, Any] = {
        "episodes": int(failed.sum()),
        "reached_and_left_again": sum(bool(e.success_once) and not e.success for e in episodes),
    }
    if failed.any() and len(desired) == len(episodes):
        distances = np.linalg.norm(achieved - desired, axis=1)[failed]
        found["final_distance"] = {
            "mean": _rounded(distances.mean()), "highest": _rounded(distances.max()),
        }  # fmt: skip
        found["goals"] = {"failed": _extent(desired[failed]), "all": _extent(desired)}
    return found


def _extent(goals: np.ndarray) -> dict[str, list[float]]:
    """Return mean, lowest and highest of each dimension. Shapes: goals ``(n, n_dimensions)``."""
    rows = {"mean": goals.mean(axis=0), "low": goals.min(axis=0), "high": goals.max(axis=0)}
    return {name: [_rounded(number) for number in row] for name, row in rows.items()}


def _mean(values: Sequence[float]) -> dict[str, float]:
    """Return the mean of many values with its normal interval."""
    half = 1.96 * float(np.std(values)) / len(values) ** 0.5
    mean = float(np.mean(values))
    return _as_dict(Estimate(mean, mean - half, mean + half))


def _as_dict(estimate: Estimate) -> dict[str, float]:
    values = dataclasses.asdict(estimate)
    return {"mean" if key == "value" else key: _rounded(value) for key, value in values.items()}


def _rounded(number: float) -> float:
    return round(float(number), 4)
