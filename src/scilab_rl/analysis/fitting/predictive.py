"""What people do and what the fitted models would do: the behavior itself, not only its score."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from scilab_rl.analysis.fitting.estimation import Fit
from scilab_rl.analysis.fitting.panel import Panel, make_panel
from scilab_rl.analysis.fitting.simulation import simulate

WIN = 0.5
N_BINS = 10
_FIRST = 0
Behavior = dict[str, np.ndarray]  # condition -> a share per participant


def simulated_panel(
    fitted: Fit, env: str, n_trials: int, env_kwargs: Mapping[str, Any], seed: int = 0
) -> Panel:
    """Let each participant's fitted model act in the task."""
    rows = simulate(
        fitted.model, fitted.values, env, n_trials=n_trials, env_kwargs=env_kwargs, seed=seed
    )
    return make_panel(rows, f"the choices of {fitted.name}")


def stay_probabilities(panel: Panel, probabilities: np.ndarray | None = None) -> Behavior:
    """Return how often a response is repeated, by what it had brought.

    After a win or a loss; in a two-step task the first response, also by whether the transition was
    the common one (response 0 to state 1, response 1 to state 2).

    Args:
        panel: The choices.
        probabilities: Of the responses, from `choice_probabilities`: what a model expects given the
            actual trials; None: what was chosen.

    Shapes:
        probabilities: ``(n_participants, n_choices, n_actions)``; results: ``(n_participants,)``.
    """
    if panel.n_stages == 2:
        return _two_step(panel, probabilities)
    before = np.asarray(panel.seen.response)
    stays = _stays(panel.responses, before, probabilities)
    counts = panel.counts * ~panel.seen.is_first
    won = panel.seen.feedback > WIN
    return {"after a win": _mean(stays, counts * won), "after a loss": _mean(stays, counts * ~won)}


def _two_step(panel: Panel, probabilities: np.ndarray | None) -> Behavior:
    first, second = slice(0, None, 2), slice(1, None, 2)
    responses, counts = panel.responses[:, first], panel.counts[:, first]
    n = panel.responses[:, second].shape[1]
    responses, counts = responses[:, :n], counts[:, :n]
    common = panel.seen.state[:, second] == responses + 1
    # What was seen before the next first choice is the feedback of the second one.
    paid = panel.seen.feedback[:, first][:, 1:n] > WIN
    expected = None if probabilities is None else probabilities[:, first][:, 1:n]
    stays = _stays(responses[:, 1:], responses[:, :-1], expected)
    counts = counts[:, 1:] * ~panel.seen.is_first[:, first][:, 1:n]
    return {
        f"{money}, {kind}": _mean(stays, counts * (paid == is_paid) * (common[:, :-1] == is_common))
        for money, is_paid in (("paid", True), ("not paid", False))
        for kind, is_common in (("common", True), ("rare", False))
    }


def _stays(
    responses: np.ndarray, before: np.ndarray, probabilities: np.ndarray | None
) -> np.ndarray:
    if probabilities is None:
        return (responses == before).astype(float)
    return np.take_along_axis(probabilities, before[..., None], axis=2)[..., 0]


def _mean(values: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return the means of those that count; NaN for participants who have none."""
    n = counts.sum(axis=1)
    return np.where(n > 0, (values * counts).sum(axis=1) / np.maximum(n, 1), np.nan)


def learning_curve(panel: Panel) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the share of correct free choices over the trials; None if the table has none.

    Shapes:
        trials, shares: ``(n_bins,)``, ``(n_participants, n_bins)``.
    """
    if "correct" not in panel.rows[0][0] or "trial" not in panel.rows[0][0]:
        return None
    n_trials = 1 + max(int(float(row["trial"])) for rows in panel.rows for row in rows)
    n_bins = min(N_BINS, n_trials)
    sums, counts = np.zeros((2, len(panel.rows), n_bins))
    for person, rows in enumerate(panel.rows):
        for row in rows:
            if float(row.get("forced") or 0) == 0:
                place = int(float(row["trial"])) * n_bins // n_trials
                sums[person, place] += float(row["correct"])
                counts[person, place] += 1
    middle = (np.arange(n_bins) + 0.5) * n_trials / n_bins
    return middle, np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
