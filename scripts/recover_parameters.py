"""A worked example: fit a simple cognitive model to agents' choices and recover what is known.

A DQN agent learns which door pays. Simulated participants then choose with its values: action a
with probability proportional to exp(beta Q(s, a)), where beta, the inverse temperature, is known to
us. `scilab-rl export --softmax BETA` writes their trials; from that table alone beta is estimated
by maximum likelihood, with its standard error from the curvature of the likelihood.

    python scripts/recover_parameters.py                     about a minute
    python scripts/recover_parameters.py --participants 12   how often the interval is right

The same lines fit the choices of people, once their trials have the columns action, q_0, q_1, ...
"""

from __future__ import annotations

import argparse
import csv
import math
import subprocess
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
TRAINING = (
    "algorithm=cleandqn", "env=scilab_rl.testing:TinyDiscrete-v0", "seed=1", "n_epochs=4",
    "eval_after_n_steps=1000", "n_test_rollouts=20", "mlflow=0", "algorithm.learning_rate=1e-3",
    "algorithm.target_update_interval=200", "algorithm.exploration_fraction=0.5",
    "algorithm.gamma=0.8", "algorithm.replay_buffer_class=null", "algorithm.buffer_size=5000",
)  # fmt: skip
KNOWN = (1.0, 3.0, 8.0)


def fit_inverse_temperature(actions: np.ndarray, values: np.ndarray) -> tuple[float, float]:
    """Return the maximum-likelihood estimate of beta and its standard error.

    The log likelihood ``sum_t beta Q_t(a_t) - log sum_a exp(beta Q_t(a))`` is concave in beta; its
    derivative is the chosen minus the expected value, its curvature minus the variance of the value
    under the model. So Newton's method finds the maximum.

    Shapes:
        actions: ``(n_trials,)``; values: ``(n_trials, n_actions)``.
    """
    beta, information = 0.0, 1.0
    chosen = values[np.arange(len(actions)), actions]
    for _ in range(100):
        weights = np.exp(beta * (values - values.max(axis=1, keepdims=True)))
        probabilities = weights / weights.sum(axis=1, keepdims=True)
        expected = (probabilities * values).sum(axis=1)
        information = float((probabilities * values**2).sum() - (expected**2).sum())
        step = float((chosen - expected).sum()) / information
        beta += math.copysign(min(abs(step), 2.0), step)
        if abs(step) < 1e-9:
            break
    return beta, 1 / math.sqrt(information)


def read_trials(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the choices, and the values of all actions, of an exported table."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    names = sorted(name for name in rows[0] if name.startswith("q_") and name != "q_value")
    values = np.array([[float(row[name]) for name in names] for row in rows])
    return np.array([int(row["action"]) for row in rows]), values


def scilab_rl(*arguments: str) -> None:
    """Run the command line."""
    subprocess.run([sys.executable, str(ROOT / "src" / "main.py"), *arguments], check=True)


def main() -> None:
    """Train, export, fit, and tell."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--folder", type=Path, default=Path("data/recovery"), help="for its files")
    parser.add_argument("--episodes", type=int, default=200, help="of each participant")
    parser.add_argument("--participants", type=int, default=1, help="for each known beta")
    options = parser.parse_args()
    base = f"base_logdir={options.folder}"
    scilab_rl(*TRAINING, base)
    n_right = 0
    participants = [(beta, n) for beta in KNOWN for n in range(options.participants)]
    for seed, (beta, number) in enumerate(participants, start=1):
        table = options.folder / f"participant_{beta:g}_{number}.csv"
        scilab_rl(
            "export", "last", "--trials", "--saved=best", f"--softmax={beta}",
            f"--episodes={options.episodes}", f"--seed={seed}", f"--output={table}",
            f"--base-logdir={options.folder}",
        )  # fmt: skip
        actions, values = read_trials(table)
        estimate, error = fit_inverse_temperature(actions, values)
        n_right += abs(estimate - beta) <= 1.96 * error
        sys.stdout.write(
            f"beta {beta:g}: recovered {estimate:.2f} ± {1.96 * error:.2f} from {len(actions)} "
            "choices (95 % interval)\n"
        )
        sys.stdout.flush()
    sys.stdout.write(f"{n_right} of {len(participants)} intervals contain the known beta\n")


if __name__ == "__main__":
    main()
