"""What people do and what models and agents do: the behavior itself, not only its score."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from scilab_rl.analysis.fitting.panel import Panel, make_panel
from scilab_rl.analysis.fitting.simulation import simulate
from scilab_rl.learning.cognitive import CognitiveModel

WIN = 0.5
N_BINS = 10
N_SAMPLES = 4  # of the horizon task, before the first free choice
_BEFORE, _AFTER = 5, 10  # trials around a reversal
Behavior = dict[str, np.ndarray]  # condition -> a share per participant


@dataclass(frozen=True)
class Curve:
    """Shares of choices of each participant in several places.

    Attributes:
        title: What it is about.
        x_label: What the places are.
        y_label: What is counted.
        places: Where.
        shares: NaN where a participant has no such choice.
        marks: Places and what happens there.

    Shapes:
        places: ``(n_places,)``; shares: ``(n_participants, n_places)``.
    """

    title: str
    x_label: str
    y_label: str
    places: np.ndarray
    shares: np.ndarray
    marks: tuple[tuple[float, str], ...] = ()


def simulated_panel(
    model: type[CognitiveModel],
    values: Mapping[str, np.ndarray],
    size: tuple[int | None, int],
    env: str,
    env_kwargs: Mapping[str, Any],
    seed: int = 0,
) -> Panel:
    """Let participants with a model act in a task.

    Args:
        model: Their model.
        values: Parameters by name, a value per participant.
        size: Trials of a block, and blocks, see `size_of`.
        env: Id of the task.
        env_kwargs: Its arguments.
        seed: Of tasks and choices.
    """
    n_trials, n_blocks = size
    rows = simulate(
        model, values, env,
        n_trials=n_trials, n_blocks=n_blocks, env_kwargs=env_kwargs, seed=seed,
    )  # fmt: skip
    return make_panel(rows, f"the choices of {model.__name__.lower()}")


def size_of(panel: Panel) -> tuple[int | None, int]:
    """Return the trials of the longest block, None where blocks end early, and the most blocks."""
    starts = [np.flatnonzero(begins) for begins in panel.seen.is_first]
    n_blocks = max(map(len, starts))
    if panel.has("visits"):  # a search ends when it succeeds: the longest is not the limit
        return None, n_blocks
    ends = [np.append(own, len(rows)) for own, rows in zip(starts, panel.rows, strict=True)]
    return max(int(np.diff(own).max()) for own in ends) // panel.n_stages, n_blocks


def task_behavior(panel: Panel) -> Behavior:
    """Return what is done in this task, by the measures of its field.

    In the horizon task the first free choices (Wilson et al., 2014), in a search how often new
    cells are entered, elsewhere `stay_probabilities`.

    Shapes:
        results: ``(n_participants,)``.
    """
    if panel.has("information") and panel.has("horizon"):
        return _first_free_choices(panel)
    if panel.has("visits"):
        return {
            "enters a new cell": _mean(np.nan_to_num(panel.column("correct")), panel.counts),
            "finds the goal": _ends_in_success(panel),
        }
    return stay_probabilities(panel)


def task_curves(panel: Panel) -> list[Curve]:
    """Return how behavior changes over trials and around reversals, as far as the table tells."""
    curves = (learning_curve(panel), reversal_curve(panel))
    return [curve for curve in curves if curve is not None]


def _first_free_choices(panel: Panel) -> Behavior:
    """Return choices of the less known machine (1 of 4 samples) and of the worse one (2 of 4)."""
    forced, horizon = panel.column("forced"), panel.column("horizon")
    is_first = np.zeros(forced.shape, bool)
    is_first[:, N_SAMPLES:] = (forced[:, N_SAMPLES:] == 0) & (forced[:, N_SAMPLES - 1 : -1] == 1)
    person, place = np.nonzero(is_first)
    samples = person[:, None], place[:, None] - np.arange(N_SAMPLES, 0, -1)
    right, points = panel.responses[samples], panel.column("feedback")[samples]
    n_right = right.sum(axis=1)
    means = [
        (points * (right == side)).sum(axis=1) / np.maximum((right == side).sum(axis=1), 1)
        for side in (0, 1)
    ]
    behavior = {}
    for name, target, fits in (
        ("the less known", n_right < N_SAMPLES / 2, n_right != N_SAMPLES / 2),
        ("the worse", means[1] < means[0], n_right == N_SAMPLES / 2),
    ):
        for length in (1, 6):
            counts, shares = np.zeros((2, *forced.shape))
            counts[person, place] = fits & (horizon[person, place] == length)
            shares[person, place] = panel.responses[person, place] == target
            free = "1 free choice" if length == 1 else f"{length} free choices"
            behavior[f"{name}, {free}"] = _mean(shares, counts)
    return behavior


def _ends_in_success(panel: Panel) -> np.ndarray:
    feedback = np.nan_to_num(panel.column("feedback"))
    n_blocks = panel.seen.is_first.sum(axis=1)
    return (feedback > WIN).sum(axis=1) / n_blocks


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


def learning_curve(panel: Panel) -> Curve | None:
    """Return the share of correct free choices over the trials; None if the table has none."""
    if not (panel.has("correct") and panel.has("trial")):
        return None
    trial, correct = panel.column("trial"), panel.column("correct")
    counts = panel.counts * np.isfinite(correct)
    n_trials = 1 + int(np.nanmax(trial))
    n_bins = min(N_BINS, n_trials)
    bins = np.nan_to_num(trial).astype(int) * n_bins // n_trials
    middle = (np.arange(n_bins) + 0.5) * n_trials / n_bins
    shares = [_mean(np.nan_to_num(correct), counts * (bins == place)) for place in range(n_bins)]
    new = panel.has("visits")
    return Curve(
        "Search" if new else "Learning",
        "trial",
        "share of moves into new cells" if new else "share of correct choices",
        middle,
        np.stack(shares, axis=1),
    )


def reversal_curve(panel: Panel) -> Curve | None:
    """Return the share of correct choices around reversals; None if the table has none.

    The trials before a reversal are compared with what was correct before it, the others with what
    is correct after it; neither reaches into another reversal or block.
    """
    if not (panel.has("reversals") and panel.has("correct")):
        return None
    offsets = np.arange(-_BEFORE, _AFTER)
    correct, n_reversals = panel.column("correct"), panel.column("reversals")
    blocks = panel.seen.is_first.cumsum(axis=1)
    sums, counts = np.zeros((2, len(correct), len(offsets)))
    changes = (np.diff(n_reversals, axis=1) == 1) & (np.diff(blocks, axis=1) == 0)
    for person, place in zip(*np.nonzero(changes), strict=True):
        for index, offset in enumerate(offsets):
            at = place + 1 + offset
            if not 0 <= at < correct.shape[1]:
                continue
            expected = n_reversals[person, place + (offset >= 0)]
            if n_reversals[person, at] == expected and blocks[person, at] == blocks[person, place]:
                sums[person, index] += correct[person, at]
                counts[person, index] += 1
    if not counts.any():
        return None
    shares = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
    return Curve(
        "Reversals",
        "trials since the reversal",
        "share of correct choices",
        offsets.astype(float),
        shares,
        ((0.0, "reversal"),),
    )
