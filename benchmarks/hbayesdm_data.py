"""Choices of people from hBayesDM, fitted hierarchically here and by hBayesDM's own Stan files.

The example data of the package `hbayesdm` (Ahn, Haines & Zhang, 2017, Computational Psychiatry 1)
are two-armed bandit, probabilistic reversal and two-step task. Each is fitted with a model that
hBayesDM defines for it: the same choice rule, links and priors, written as models of Scilab-RL.
Compared are the log-likelihoods at the same parameters, the group means and standard deviations of
the two posteriors, and the processor time.

Run: python benchmarks/hbayesdm_data.py [--only MODEL ...] [--warmup 500] [--samples 1000]

The peers' environment, `make .venv-hbayesdm/.installed`, holds data and Stan files. Without it,
simulated participants are fitted, and there is nothing to compare with.
"""

from __future__ import annotations

import argparse
import csv
import functools
import json
import math
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import jax
import numpy as np
from numpyro.diagnostics import summary
from turns import publish

from scilab_rl.algorithms.models.hybrid import HYBRID
from scilab_rl.algorithms.models.rescorlawagner import RESCORLAWAGNER
from scilab_rl.algorithms.models.rescorlawagner2 import RESCORLAWAGNER2
from scilab_rl.analysis.fitting.estimation import fit, natural, prior_draws
from scilab_rl.analysis.fitting.hierarchical import sample_posterior
from scilab_rl.analysis.fitting.panel import Panel, make_panel
from scilab_rl.analysis.fitting.simulation import simulate
from scilab_rl.learning.cognitive import CognitiveModel, Parameter, log_likelihoods

PEERS = Path(__file__).parents[1] / ".venv-hbayesdm"
PROGRAM = Path(__file__).parent / "peers" / "hbayesdm_stan.py"
N_CHAINS = 4
MOST_Z = 3.0  # standard errors of sampling, above which posteriors differ
MOST_DIFFERENCE = 1e-6  # of log-likelihoods, relative


class Probit(Parameter):
    """A parameter between bounds with Stan's approximate normal link, and hBayesDM's priors."""

    def from_real(self, x: Any, xp: Any = jax.numpy) -> Any:
        """Return low + (high - low) Phi_approx(x)."""
        return self.low + (self.high - self.low) / (1 + xp.exp(-(0.07056 * x**3 + 1.5976 * x)))


SPREAD = 0.2  # sigma ~ normal(0, 0.2), in all of hBayesDM
RATE = Probit(0.0, 1.0, spread_sd=SPREAD)
EXP = Parameter(0.0, spread_sd=SPREAD)


def up_to(high: float) -> Probit:
    """Return a parameter between 0 and a bound."""
    return Probit(0.0, high, spread_sd=SPREAD)


# Outcomes of -1 and 1 are 0 and 1 here, and values begin at 0.5 in place of 0: differences are half
# as large, and inverse temperatures twice those of hBayesDM.
class BANDIT2ARM_DELTA(RESCORLAWAGNER):
    """Rescorla-Wagner, with A = learning rate and tau = inverse temperature / 2."""

    parameters: ClassVar = {"learning_rate": RATE, "inverse_temperature": up_to(10.0)}


class PRL_RP(RESCORLAWAGNER2):
    """Two learning rates (den Ouden et al., 2013), with beta = inverse temperature / 2."""

    parameters: ClassVar = {
        "learning_rate_loss": RATE,
        "learning_rate_gain": RATE,
        "inverse_temperature": up_to(20.0),
    }


class TS_PAR4(HYBRID):
    """The hybrid with one rate and one temperature, as hBayesDM writes it.

    There eligibility is 1 and acts after the second value has changed, and perseveration is outside
    of the inverse temperature. Both are parameters of `hybrid` that depend on the others.
    """

    parameters: ClassVar = {
        "rate": RATE, "temperature": EXP, "perseveration": up_to(5.0), "weight": RATE,
    }  # fmt: skip

    @staticmethod
    def as_hybrid(parameters: Mapping[str, Any]) -> dict[str, Any]:
        """Return the parameters of `hybrid`."""
        rate, temperature = parameters["rate"], parameters["temperature"]
        return {
            "learning_rate_1": rate,
            "learning_rate_2": rate,
            "inverse_temperature_1": temperature,
            "inverse_temperature_2": temperature,
            "eligibility": 1 - rate,
            "model_based_weight": parameters["weight"],
            "stickiness": parameters["perseveration"] / temperature,
        }

    @staticmethod
    def update(parameters: Any, memory: Any, trial: Any) -> Any:
        """Learn as `hybrid`."""
        return HYBRID.update(TS_PAR4.as_hybrid(parameters), memory, trial)

    @staticmethod
    def choose(parameters: Any, memory: Any, state: Any) -> Any:
        """Choose as `hybrid`."""
        return HYBRID.choose(TS_PAR4.as_hybrid(parameters), memory, state)


class Task(NamedTuple):
    """A data set and its model.

    Attributes:
        data: Name of the data set in hBayesDM.
        model: The same model here.
        names: hBayesDM's names of its parameters, in the order of its ``sigma``, ours, and what
            ours are divided by.
        env: The task, for simulated participants.
    """

    data: str
    model: type[CognitiveModel]
    names: Mapping[str, tuple[str, float]]
    env: str


TASKS = {
    "bandit2arm_delta": Task(
        "bandit2arm",
        BANDIT2ARM_DELTA,
        {"A": ("learning_rate", 1.0), "tau": ("inverse_temperature", 2.0)},
        "Bandit",
    ),
    "prl_rp": Task(
        "prl",
        PRL_RP,
        {
            "Apun": ("learning_rate_loss", 1.0),
            "Arew": ("learning_rate_gain", 1.0),
            "beta": ("inverse_temperature", 2.0),
        },
        "ProbabilisticReversal",
    ),
    "ts_par4": Task(
        "ts",
        TS_PAR4,
        {
            "a": ("rate", 1.0),
            "beta": ("temperature", 1.0),
            "pi": ("perseveration", 1.0),
            "w": ("weight", 1.0),
        },
        "TwoStep",
    ),
}


@dataclass
class Sampled:
    """Draws of a posterior, and the processor time that they took.

    Attributes:
        draws: Of group means on hBayesDM's scale, and of standard deviations on the real scale.
        seconds: To sample.
        build_seconds: To compile the program, little if Stan has it in its cache; here that is part
            of sampling.
        n_divergent: Divergent transitions; None if not known.

    Shapes:
        draws: ``(n_chains, n_draws)`` each.
    """

    draws: dict[str, np.ndarray]
    seconds: float
    build_seconds: float = 0.0
    n_divergent: int | None = None

    @functools.cached_property
    def quality(self) -> dict[str, dict[str, float]]:
        """Mean, sd, R-hat and effective sample size of each quantity."""
        wanted = {"mean": "mean", "std": "sd", "r_hat": "r_hat", "n_eff": "effective"}
        return {
            name: {new: float(about[old]) for old, new in wanted.items()}
            for name, about in summary(self.draws).items()
        }

    def per_second(self) -> float:
        """Return the smallest effective sample size per second of processor time."""
        return min(q["effective"] for q in self.quality.values()) / self.seconds


def read_rows(data: str) -> list[dict[str, str]]:
    """Return the table of a data set of hBayesDM."""
    found = PEERS.glob(f"lib/*/site-packages/hbayesdm/common/extdata/{data}_exampleData.txt")
    with next(found).open(encoding="utf-8") as file:
        return list(csv.DictReader(file, delimiter="\t"))


def as_stan_data(rows: list[dict[str, str]], names: list[str]) -> dict[str, Any]:
    """Return a table as hBayesDM gives it to Stan: a row per participant."""
    people: dict[str, list[dict[str, str]]] = {}
    for row in rows:
        people.setdefault(row["subjID"], []).append(row)
    n = max(map(len, people.values()))
    columns = [c for c in ("choice", "outcome", "level1_choice", "level2_choice", "reward")
               if c in rows[0]]  # fmt: skip
    data: dict[str, Any] = {"N": len(people), "T": n, "Tsubj": [*map(len, people.values())]}
    for column in columns:
        empty = 1 if column.startswith("level") else -1 if column == "choice" else 0
        numbers = [[int(float(row[column])) for row in own] for own in people.values()]
        if column == "outcome":
            numbers = [[int(np.sign(value)) for value in own] for own in numbers]
        data[column] = [own + [empty] * (n - len(own)) for own in numbers]
    if "reward" in data:
        data["trans_prob"] = 0.7
    return data | {"names": names}


def sample_peer(name: str, rows: list[dict[str, str]], sizes: tuple[int, int], folder: Path) -> Any:
    """Let Stan sample, and return all its draws and the seconds to compile and to sample."""
    data, out = folder / "data.json", folder / "draws.npz"
    data.write_text(json.dumps(as_stan_data(rows, [*TASKS[name].names])), encoding="utf-8")
    words = [str(PEERS / "bin" / "python"), str(PROGRAM), name, str(data)]
    seconds = []
    for n_warmup, n_samples in ((0, 0), sizes):  # the second time it is compiled already
        started = _seconds_of_children()
        log = folder / "log.txt"
        with log.open("w") as file:
            done = subprocess.run(
                [*words, str(n_warmup), str(n_samples), str(out)],
                check=False, stdout=file, stderr=file,
            )  # fmt: skip
        if done.returncode:
            raise SystemExit(f"{PROGRAM} has failed:\n{log.read_text()}")
        seconds.append(_seconds_of_children() - started)
    with np.load(out) as draws:
        return dict(draws), *seconds


def _seconds_of_children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def of_peer(task: Task, draws: Mapping[str, np.ndarray], build: float, seconds: float) -> Sampled:
    """Return what Stan says about the group."""
    kept = {name: draws[f"mu_{name}"] for name in task.names}
    kept |= {f"sd of {name}": draws["sigma"][..., k] for k, name in enumerate(task.names)}
    return Sampled(kept, seconds, build)


def sample_ours(task: Task, panel: Panel, sizes: tuple[int, int]) -> Sampled:
    """Sample the same posterior here."""
    started = sum(os.times()[:2])
    posterior = sample_posterior(
        fit(task.model, panel), n_warmup=sizes[0], n_samples=sizes[1], n_chains=N_CHAINS
    )
    seconds = sum(os.times()[:2]) - started
    group, order = natural(task.model, posterior.group), [*task.model.parameters]
    draws = {name: group[ours] / divisor for name, (ours, divisor) in task.names.items()}
    draws |= {
        f"sd of {name}": posterior.spread[..., order.index(ours)]
        for name, (ours, _) in task.names.items()
    }
    chained = {name: values.reshape(N_CHAINS, -1) for name, values in draws.items()}
    return Sampled(chained, seconds, n_divergent=posterior.n_divergent)


def largest_difference(task: Task, panel: Panel, draws: Mapping[str, np.ndarray]) -> float:
    """Return the largest relative difference of log-likelihoods at some of Stan's draws."""
    places = np.linspace(0, draws["log_lik"].shape[1] - 1, 10).astype(int)
    likelihood = functools.partial(log_likelihoods, task.model, panel.n_states, panel.n_actions)
    largest = 0.0
    with jax.enable_x64(True):
        each = jax.jit(jax.vmap(likelihood))
        for place in places:
            values = {
                ours: np.float64(draws[name][0, place]) * divisor
                for name, (ours, divisor) in task.names.items()
            }
            found = each(values, panel.seen, panel.responses)
            ours = np.asarray((found * panel.counts).sum(axis=1))
            theirs = draws["log_lik"][0, place]
            largest = max(largest, float(np.abs(ours / theirs - 1).max()))
    return largest


def compare(ours: Sampled, theirs: Sampled) -> dict[str, dict[str, float]]:
    """Return the two posteriors of each quantity, and their distance in standard errors."""
    found = {}
    for name, own in ours.quality.items():
        peer = theirs.quality[name]
        errors = [q["sd"] / math.sqrt(q["effective"]) for q in (own, peer)]
        z = (own["mean"] - peer["mean"]) / math.hypot(*errors)
        found[name] = {"ours": own["mean"], "sd": own["sd"], "stan": peer["mean"],
                       "stan_sd": peer["sd"], "z": z}  # fmt: skip
    return found


def simulated(task: Task) -> Panel:
    """Return simulated participants, where there is no data."""
    real = prior_draws(task.model, 6, np.random.default_rng(0)) * 0.3
    rows = simulate(task.model, natural(task.model, real), task.env, n_trials=60)
    return make_panel(rows)


def measure(name: str, sizes: tuple[int, int], *, has_data: bool) -> dict[str, Any]:
    """Fit a data set here and with Stan, if that is there."""
    task = TASKS[name]
    rows = read_rows(task.data) if has_data else []
    panel = make_panel(rows, task.data) if rows else simulated(task)
    ours = sample_ours(task, panel, sizes)
    report: dict[str, Any] = {
        "participants": len(panel.participants),
        "choices": int(panel.n_choices.sum()),
        "ours": _about(ours),
    }
    if rows:
        with tempfile.TemporaryDirectory() as folder:
            draws, build, seconds = sample_peer(name, rows, sizes, Path(folder))
        theirs = of_peer(task, draws, build, seconds)
        report |= {
            "stan": _about(theirs),
            "log_likelihood_difference": largest_difference(task, panel, draws),
            "parameters": compare(ours, theirs),
            "times": ours.per_second() / theirs.per_second(),
        }
        report["agrees"] = report["log_likelihood_difference"] < MOST_DIFFERENCE and all(
            abs(found["z"]) < MOST_Z for found in report["parameters"].values()
        )
    return report


def _about(sampled: Sampled) -> dict[str, Any]:
    return {
        "seconds": sampled.seconds,
        "build_seconds": sampled.build_seconds,
        "largest_r_hat": max(q["r_hat"] for q in sampled.quality.values()),
        "smallest_effective": min(q["effective"] for q in sampled.quality.values()),
        "n_divergent": sampled.n_divergent,
    }


def table(report: Mapping[str, Any]) -> str:
    """Return what was measured as text."""
    lines = []
    for name, found in report.items():
        lines.append(f"\n{name}: {found['participants']} participants, {found['choices']} choices")
        for who in ("ours", "stan"):
            if about := found.get(who):
                lines.append(
                    f"  {who}: {about['build_seconds']:.0f} s to compile, {about['seconds']:.0f} s "
                    f"to sample, R-hat up to {about['largest_r_hat']:.3f}, at least "
                    f"{about['smallest_effective']:.0f} effective samples"
                )
        for parameter, p in found.get("parameters", {}).items():
            lines.append(
                f"  {parameter:12} ours {p['ours']:7.3f} ({p['sd']:.3f})   Stan {p['stan']:7.3f} "
                f"({p['stan_sd']:.3f})   {p['z']:+.1f} standard errors"
            )
        if "agrees" in found:
            verdict = "the same" if found["agrees"] else "NOT THE SAME"
            lines.append(
                f"  {verdict} within sampling error; log-likelihoods differ by at most "
                f"{found['log_likelihood_difference']:.0e}; {found['times']:.1f} times as many "
                "effective samples per second"
            )
    return "\n".join(lines)


def main() -> int:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--only", nargs="+", choices=TASKS, default=[*TASKS])
    parser.add_argument("--warmup", type=int, default=500)
    parser.add_argument("--samples", type=int, default=1000)
    parser.add_argument("--simulated", action="store_true", help="as if there was no data")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    has_data = PEERS.exists() and not arguments.simulated
    if not has_data:
        sys.stdout.write("No data: `make .venv-hbayesdm/.installed` gets it. Simulating.\n")
    sizes = (arguments.warmup, arguments.samples)
    report = {name: measure(name, sizes, has_data=has_data) for name in arguments.only}
    publish(table(report), report, arguments.json)
    return 0 if all(found.get("agrees", True) for found in report.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
