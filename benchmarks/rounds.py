"""How well a round of a compiled algorithm overlaps: its time compared with the sum of its parts.

FetchPush with the tuned values of `jaxsac`, as a run would build it. Measured in turns, in the
order A B B A: the parts alone (acting, the environments' steps with random actions, drawing the
transitions, the updates), whole rounds with ``overlap``, and whole rounds without. A whole round
also stores its steps and records its metrics, which no part contains.

Prints a table and one JSON object with the milliseconds of each part and of both kinds of rounds
and ``ratio``, a round to the sum of the parts, with ``interval``, 95 % of its bootstrap.

Run: python benchmarks/rounds.py [--rounds N] [--steps N] [--json FILE] [KEY=VALUE ...]
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from turns import publish, relative, take_turns, timed

from scilab_rl.config.compose import compose
from scilab_rl.run.directory import RunDirectory
from scilab_rl.run.run import build_session, complete

PARTS = ("acting", "environments", "drawing", "updates")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=4, help="of two turns each; default 4")
    parser.add_argument("--steps", type=int, default=50, help="of a turn; default 50")
    parser.add_argument("--json", type=Path, help="also write the JSON object to this file")
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="of the run")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        session = make_session(Path(folder), arguments.overrides)
        times = take_turns(make_turns(session, arguments.steps), arguments.rounds)
        session.train_env.close()
        session.eval_env.close()
    per_step = {
        name: [1e3 * turn.wall / arguments.steps for turn in taken] for name, taken in times.items()
    }
    sums = [sum(parts) for parts in zip(*(per_step[name] for name in PARTS), strict=True)]
    rows = {name: statistics.median(values) for name, values in per_step.items()}
    rows["sum of the parts"] = statistics.median(sums)
    report = {"milliseconds": rows, **relative(per_step["overlapped round"], sums)}
    lines = [f"{name:20}{milliseconds:8.2f} ms" for name, milliseconds in rows.items()]
    publish("\n".join([*lines, f"{'ratio':20}{report['ratio']:8.2f}"]), report, arguments.json)


def make_session(folder: Path, overrides: list[str]) -> Any:
    """Build a run that has learned a little, so that everything is compiled."""
    given = ["algorithm=jaxsac", "env=FetchPush", "seed=1", "mlflow=0", f"base_logdir={folder}"]
    cfg = complete(compose([*given, *overrides]))
    session = build_session(cfg, RunDirectory.create(folder, cfg.env, "rounds", 1))
    session.trackers.trackers.clear()
    model: Any = session.algorithm
    model.learn(model.learning_starts + 20 * model.n_envs)
    return session


def make_turns(session: Any, n: int) -> dict[str, Callable[[], Any]]:
    """Return what does each part, and each kind of round, n times."""
    model, env = session.algorithm, session.train_env

    def act() -> None:
        model.explore()

    def step() -> None:
        env.step(model.sample_env_actions())

    def draw() -> None:
        model.draw(model.updates_per_round)

    batch = model.draw(model.updates_per_round)

    def update() -> None:
        model.rounds.start(batch)
        model.finish_round()

    def learn(overlap: bool) -> None:
        model.finish_round()
        model.overlap = overlap
        model.learn(n * model.n_envs, reset_num_timesteps=False)

    def repeated(call: Callable[[], None]) -> Callable[[], Any]:
        return lambda: timed(lambda: [call() for _ in range(n)] and None)

    parts = dict(zip(PARTS, map(repeated, (act, step, draw, update)), strict=True))
    return {
        **parts,
        "overlapped round": lambda: timed(lambda: learn(overlap=True)),
        "separate round": lambda: timed(lambda: learn(overlap=False)),
    }


if __name__ == "__main__":
    main()
