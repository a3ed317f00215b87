"""Where in the space of its goals an agent fails, in Python."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from scilab_rl.analysis.estimates import Estimate
from scilab_rl.analysis.goal_report import GoalReport, examine
from scilab_rl.analysis.goals import GoalSettings
from scilab_rl.api.agent import Agent, find
from scilab_rl.api.isolation import isolated
from scilab_rl.api.shown import Page
from scilab_rl.api.tables import as_table
from scilab_rl.run.directory import find_policy

if TYPE_CHECKING:  # heavy
    import pandas


class GoalSummary(Page):
    """Where an agent succeeds, what it expects, and what it was asked for; a page in a notebook.

    Args:
        report: What was found and written.

    Attributes:
        report: The same.
        path: The page.
    """

    def __init__(self, report: GoalReport) -> None:
        super().__init__(report.page)
        self.report = report

    @property
    def success(self) -> Estimate:
        """Success rate over the goal space, all cells alike, with Wilson's 95 % interval."""
        return self.report.study.overall

    @property
    def findings(self) -> list[str]:
        """What was found, in sentences."""
        return self.report.study.findings

    @property
    def cells(self) -> pandas.DataFrame:
        """A row per cell of the goal space: its center, success, interval, and how often asked for.

        Raises:
            MissingDependencyError: If pandas is not installed.
        """
        study = self.report.study
        return as_table(
            [
                {
                    **{f"goal_{a}": x for a, x in zip(study.space.axes, center, strict=True)},
                    "success": rate.value, "low": rate.low, "high": rate.high, "asked": int(asked),
                }
                for center, rate, asked in zip(
                    study.grid.centers, study.rates, study.asked, strict=True
                )
            ]
        )  # fmt: skip

    def __str__(self) -> str:
        study = self.report.study
        lines = [
            f"success over the goal space: {self.success}, {study.settings.episodes} episodes "
            "per goal",
            f"with the goals that are asked for: {study.own}",
        ]
        if study.calibration is not None:
            lines.append(f"AUC of the value as a predictor of success: {study.calibration.auc}")
        return "\n".join([*lines, *(f"* {finding}" for finding in self.findings)])


@isolated()
def goals(
    agent: Agent | str,
    *,
    cells: Sequence[int] | None = None,
    episodes: int = 4,
    axes: Sequence[int] | None = None,
    seed: int = 1,
    checkpoints: Sequence[str] = (),
    record: int = 3,
    progress: Callable[[int, int], None] | None = None,
) -> GoalSummary:
    """Map where in its goal space an agent succeeds; the same as ``scilab-rl goals``.

    Args:
        agent: A trained agent, or how `load` finds it.
        cells: Cells on each axis; None: 15 x 15, or about as many in one or three dimensions.
        episodes: Of each cell.
        axes: Dimensions of the goal; None: the free ones.
        seed: Of all chance.
        checkpoints: Saved policies whose values are shown too, as ``best``; ``["all"]``: all.
        record: How many failed episodes are recorded.
        progress: Called after each episode: how many are done, and of how many.

    Raises:
        ConfigError: If the environment has no goals, or they cannot be chosen.
    """
    agent = find(agent) if isinstance(agent, str) else agent
    chosen = [None if numbers is None else tuple(numbers) for numbers in (cells, axes)]
    settings = GoalSettings(chosen[0], episodes, chosen[1], seed)
    if list(checkpoints) == ["all"]:
        saved = sorted(agent.run.path.glob("rl_model_*"))
    else:
        saved = [find_policy(agent.run, name) for name in checkpoints]
    return GoalSummary(
        examine(
            agent.run,
            agent.policy,
            settings,
            checkpoints=saved,
            n_recorded=record,
            progress=progress,
        )
    )
