"""The outcome of one run."""

from __future__ import annotations

import dataclasses
import os
import signal

EXIT_REQUEUE = 75
# Two statuses of a run that ended with epochs left.
SOLVED, PRUNED = "solved", "pruned"


@dataclasses.dataclass(frozen=True)
class RunResult:
    """The outcome of one run, as stored in its ``result.json``.

    Attributes:
        status: ``running``, ``finished`` (all epochs), ``solved`` (the early-stop metric held its
            threshold, with epochs left), ``pruned`` (a study ended it), ``interrupted`` or
            ``failed``.
        score: Last value of ``hyperopt_criterion``; None when the run failed or never evaluated.
        epochs: Completed epochs, that is evaluations.
        steps: Environment steps over all environments.
        seconds: Wall time.
        run_dir: The directory of the run.
        metrics: The last value of each evaluation metric.
        error: One line that says why the run failed.
        signal_number: The signal that interrupted the run, or 0.
    """

    status: str
    score: float | None
    epochs: int
    steps: int
    seconds: float
    run_dir: str
    metrics: dict[str, float] = dataclasses.field(default_factory=dict)
    error: str | None = None
    signal_number: int = 0

    @property
    def exit_code(self) -> int:
        """The exit code: 0, or 128 plus the signal that interrupted the run.

        Under a job scheduler an interrupted run asks to be queued again (75, EX_TEMPFAIL).
        """
        if not self.signal_number:
            return 0
        if self.signal_number == signal.SIGTERM and "SLURM_JOB_ID" in os.environ:
            return EXIT_REQUEUE
        return 128 + self.signal_number
