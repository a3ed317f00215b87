"""Input that cannot be: refused before anything starts, in one line that says what to do."""

from __future__ import annotations

import itertools
import re
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from scilab_rl.cli.main import run_command_line
from scilab_rl.config.schema import BOOLEAN, INTEGER, KEYS, LIST, MAPPING, NUMBER, STRING, Key
from scilab_rl.config.workspace import SHIPPED_CONF
from scilab_rl.learning.arguments import RANGES

from ..e2e.commands import command, quiet_environment
from .harness import ENV

_WRONG = {
    NUMBER: ("abc", "nan", "inf", "[1]", "{a: 1}", "true"),
    INTEGER: ("abc", "1.5", "nan", "-inf", "[1]", "{a: 1}", "true", "''"),
    STRING: ("[1]", "{a: 1}", "1.5", "''"),
    BOOLEAN: ("2", "abc", "[1]", "-1", "0.5", "''"),
    MAPPING: ("5", "abc", "[1]"),
    LIST: ("5", "abc", "{a: 1}"),
}
# Any text is a note, a name or a place, also one that looks like a list.
_FREE_TEXT = ("info", "project_name", "entity", "group", "base_logdir", "viewer_host")
_MUST_SUGGEST = 0.9


def values_that_cannot_be(key: Key) -> Iterator[str]:
    for value in _WRONG[key.kind]:
        is_text = key.name in _FREE_TEXT and value != "''"
        if not (is_text or (key.name == "info" and value == "''")):
            yield f"{key.name}={value}"
    if not key.optional:
        yield f"{key.name}=null"
    if key.low > float("-inf"):
        yield f"{key.name}={int(key.low) - 1}"
    if key.high < float("inf"):
        yield f"{key.name}={int(key.high) + 1}"
    if key.choices and key.kind == STRING:
        yield f"{key.name}={key.choices[-1][:-1]}x"


def misspelled(name: str) -> Iterator[str]:
    """Yield the name without a letter, with two letters swapped, and with one too many."""
    middle = len(name) // 2
    yield name[:middle] + name[middle + 1 :]
    if name[middle] != name[middle - 1]:
        yield name[: middle - 1] + name[middle] + name[middle - 1] + name[middle + 1 :]
    yield f"{name}e"


def parameters(algorithm: str) -> list[str]:
    text = (SHIPPED_CONF / "algorithm" / f"{algorithm}.yaml").read_text(encoding="utf-8")
    return [name for name in yaml.safe_load(text) if name not in ("name", "_target_")]


def arguments_that_cannot_be(algorithm: str) -> Iterator[str]:
    for name in parameters(algorithm):
        if name in RANGES:
            low, high = RANGES[name]
            yield f"algorithm.{name}={'-1' if low < 1 else '0'}"
            yield f"algorithm.{name}=nan"
            yield f"algorithm.{name}=[1]"
            if high < float("inf"):
                yield f"algorithm.{name}=1.01"


VALUES = [case for key in KEYS for case in values_that_cannot_be(key)]
TYPOS = [(name, key.name) for key in KEYS for name in misspelled(key.name)]
ALGORITHMS = ("sac", "td3", "dqn", "cleansac", "cleandqn", "cleanppo")
ARGUMENTS = [
    (algorithm, case) for algorithm in ALGORITHMS for case in arguments_that_cannot_be(algorithm)
]
ARGUMENT_TYPOS = [
    (algorithm, name, next(misspelled(name)))
    for algorithm in ALGORITHMS[:4]
    for name in parameters(algorithm)
    if len(name) > 4
]
GRAMMAR = [
    "n_epochs=[", "n_epochs={", "=", "=5", "a b=3", "n_epochs==3", "n_epochs=(1", "seed='", "++",
    "~", "~n_epochs", "+n_epochs=3=", "@x", "n_epochs", "-x", "--n_epochs=3", "seed=${", "env=",
    "algorithm=[sac,", "algorithm@=x", "seed=${nope}", "seed=${oc.env:NO_SUCH_VARIABLE}",
    "info=${info}", "hydra.run.dir=5=", "x.y.z=1", "wrappers=[{a: 1}]", "wrappers=[5]",
    "wrappers=[{_target_: no.such.Wrapper}]", "tracking=nope", "+performance=nope",
    "algorithm=", "algorithm=../sac", "algorithm=null", "env=../FetchReach", "seed=1_000_x",
]  # fmt: skip


def test_there_are_enough_cases() -> None:
    n = len(VALUES) + len(TYPOS) + len(ARGUMENTS) + len(ARGUMENT_TYPOS) + len(GRAMMAR)
    assert n >= 400


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


class Refusals:
    """Gives bad input and collects what was not refused as it should be."""

    def __init__(self, capsys: pytest.CaptureFixture[str], project: Path) -> None:
        self.capsys, self.project = capsys, project
        self.problems: list[str] = []
        self.messages: dict[str, str] = {}

    def give(self, *arguments: str) -> str:
        typed = " ".join(arguments)
        names = {argument.partition("=")[0] for argument in arguments}
        rest = [word for word in (ENV, "algorithm=random", "mlflow=0", "n_epochs=1",
                "eval_after_n_steps=1") if word.partition("=")[0] not in names]  # fmt: skip
        started = time.monotonic()
        code = run_command_line([*arguments, *rest])
        seconds = time.monotonic() - started
        captured = self.capsys.readouterr()
        lines = captured.err.strip().splitlines()
        errors = [line for line in lines if line.startswith("error: ")]
        written = [path for path in self.project.rglob("*") if path.is_file()]
        if code != 2 or len(errors) != 1 or "Traceback" in captured.err or written:
            self.problems.append(f"{typed}: code {code}, {len(written)} files: {captured.err!r}")
        elif "(unexpected;" in errors[0] or len(errors[0]) > 1500:
            self.problems.append(f"{typed}: {errors[0]!r}")
        elif seconds > 20:  # less than three on a machine that has nothing else to do
            self.problems.append(f"{typed}: {seconds:.1f} s")
        self.messages[typed] = errors[0] if errors else ""
        return self.messages[typed]


@pytest.fixture
def refusals(project: Path, capsys: pytest.CaptureFixture[str]) -> Refusals:
    return Refusals(capsys, project)


def every(cases: list, n: int) -> list:
    """Return about ``n`` of the cases, spread evenly."""
    return cases[:: max(1, len(cases) // n)]


def check_values(refusals: Refusals, cases: list[str]) -> None:
    for case in cases:
        message = refusals.give(case)
        if case.partition("=")[0] not in message:
            refusals.problems.append(f"{case}: the message does not name the key: {message}")
    assert refusals.problems == []


def check_typos(refusals: Refusals, cases: list[tuple[str, str]]) -> None:
    right = sum(f"Did you mean '{meant}'?" in refusals.give(f"{typo}=1") for typo, meant in cases)
    assert refusals.problems == []
    assert right >= _MUST_SUGGEST * len(cases), refusals.messages


def check_arguments(refusals: Refusals, cases: list[tuple[str, str]]) -> None:
    for algorithm, case in cases:
        message = refusals.give(f"algorithm={algorithm}", case)
        if case.partition("=")[0] not in message:
            refusals.problems.append(f"{algorithm}, {case}: {message}")
    assert refusals.problems == []


def check_argument_typos(refusals: Refusals, cases: list[tuple[str, str, str]]) -> None:
    right = sum(
        f"Did you mean '{name}'?" in refusals.give(f"algorithm={algorithm}", f"algorithm.{typo}=1")
        for algorithm, name, typo in cases
    )
    assert refusals.problems == []
    assert right >= _MUST_SUGGEST * len(cases), refusals.messages


def test_f28_values_that_cannot_be(refusals: Refusals) -> None:
    check_values(refusals, every(VALUES, 16))


def test_f28_misspelled_keys(refusals: Refusals) -> None:
    check_typos(refusals, every(TYPOS, 12))


def test_f28_arguments_of_algorithms(refusals: Refusals) -> None:
    check_arguments(refusals, every(ARGUMENTS, 8))


def test_f28_misspelled_arguments(refusals: Refusals) -> None:
    check_argument_typos(refusals, every(ARGUMENT_TYPOS, 8))


@pytest.mark.slow
def test_f28_all_values_that_cannot_be(refusals: Refusals) -> None:
    check_values(refusals, VALUES)


@pytest.mark.slow
def test_f28_all_misspelled_keys(refusals: Refusals) -> None:
    check_typos(refusals, TYPOS)


@pytest.mark.slow
def test_f28_all_arguments_of_algorithms(refusals: Refusals) -> None:
    check_arguments(refusals, ARGUMENTS)


@pytest.mark.slow
def test_f28_all_misspelled_arguments(refusals: Refusals) -> None:
    check_argument_typos(refusals, ARGUMENT_TYPOS)


def test_f28_what_cannot_be_read(refusals: Refusals) -> None:
    for case in GRAMMAR:
        refusals.give(case)
    assert refusals.problems == []


# What was typed, and what it has to suggest.
NAMES = [
    ("env=FetchReech-v4", "FetchReach-v4"), ("env=FetchRech", "FetchReach-v4"),
    ("env=FetchPsh-v4", "FetchPush-v4"), ("env=fetch_push-v4", "FetchPush-v4"),
    ("env=FetchSlde-v4", "FetchSlide-v4"), ("env=FetchPickAndPlase-v4", "FetchPickAndPlace-v4"),
    ("env=CartPol-v1", "CartPole-v1"), ("env=CartPoole", "CartPole-v1"),
    ("env=Pendullum-v1", "Pendulum-v1"), ("env=MountanCar-v0", "MountainCar-v0"),
    ("env=Acrobt-v1", "Acrobot-v1"), ("env=Reach1DOV-v0", "Reach1DOF-v0"),
    ("algorithm=sacc", "sac"), ("algorithm=td4", "td3"), ("algorithm=cleansax", "cleansac"),
    ("algorithm=claendqn", "cleandqn"), ("algorithm=crosq", "crossq"), ("algorithm=dpg", "ddpg"),
    ("early_stop_data_column=eval/sucess_rate", "eval/success_rate"),
    ("hyperopt_criterion=eval/mean_rewrad", "eval/mean_reward"),
    ("hyperopt_criterion=train/rollout_reward_step", "train/rollout_rewards_step"),
    ("hydra/launcher=locla", "local"), ("render=dispaly", "display"),
]  # fmt: skip


def test_f27_misspelled_names(refusals: Refusals) -> None:
    right = sum(f"Did you mean '{meant}'?" in refusals.give(typo) for typo, meant in NAMES)
    assert refusals.problems == []
    assert right >= _MUST_SUGGEST * len(NAMES), refusals.messages


@pytest.mark.parametrize(
    ("space", "message"),
    [
        ("{++algorithm.target_entropy:{type:float,low:-3,high:-1,when:{algorithm.ent_coef:Auto}}}",
         "Did you mean 'auto'?"),
        ("{++algorithm.tau:{type:int,low:5,high:1}}", "low <= high"),
        ("{seed:{type:int,low:1,high:9}}", "leave seed out"),
    ],
)  # fmt: skip
def test_search_spaces_that_cannot_be(refusals: Refusals, space: str, message: str) -> None:
    told = refusals.give("--multirun", "algorithm=cleansac", f"hydra.sweeper.search_space={space}")
    assert refusals.problems == []
    assert message in told


def test_one_critic_is_refused_where_its_variance_is_asked_for(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one = ("algorithm=cleansac", "++algorithm.n_critics=1", "env=Reach1DOF-v0", "mlflow=0")
    for asked, told in (
        (("hyperopt_criterion=train/target_critic_variance",), "only when n_critics is above 1"),
        (("render=record", "render_metrics_test=[critic_variance]"), "has no second critic"),
        (("render=record", "record_when='critic_variance > 1'"), "record_when: cleansac cannot"),
        (("++algorithm.intrinsic=critic_variance",), "two critics or more"),
    ):
        assert run_command_line([*one, *asked]) == 2
        assert told in capsys.readouterr().err
    assert not list(project.glob("data/*/*"))


def test_f27_name_of_a_missing_suite_says_how_to_install_it(refusals: Refusals) -> None:
    message = refusals.give("env=PandaReach-v3")
    assert "pip install" in message or "Did you mean" in message


def test_f28_as_processes_in_less_than_three_seconds(project: Path) -> None:
    """The same through a shell; the time is that of the fastest, as other tests run beside it."""
    fastest = float("inf")
    for case in ("n_epochs=abc", "sead=3", "algorithm=sacc"):
        started = time.monotonic()
        done = subprocess.run(
            command(case), cwd=project, env=quiet_environment(), capture_output=True, text=True,
            check=False, timeout=60,
        )  # fmt: skip
        fastest = min(fastest, time.monotonic() - started)
        assert done.returncode == 2
        assert re.fullmatch(r"error: .+\n", done.stderr)
        assert done.stdout == ""
    assert list(project.iterdir()) == []
    assert fastest < 6


BROKEN_FILES = {
    "tab": "name: mine\n\t_target_: x\n",
    "open list": "name: mine\n_target_: [\nx: 1\n",
    "open mapping": "name: {mine\n",
    "open text": 'name: "mine\n',
    "open single quote": "name: 'mine\n",
    "bad indent": "name: mine\n   gamma: 1\n  tau: 2\n",
    "colon in text": "name: mine: yours\n",
    "duplicate key": "name: mine\nname: yours\n_target_: stable_baselines3.SAC\n",
    "list instead of mapping": "- name\n- mine\n",
    "text instead of mapping": "just text\n",
    "number instead of mapping": "5\n",
    "no target": "name: mine\ngamma: 0.9\n",
    "target is null": "name: mine\n_target_: null\n",
    "target is a number": "name: mine\n_target_: 5\n",
    "target is a list": "name: mine\n_target_: [stable_baselines3.SAC]\n",
    "target is no class": "name: mine\n_target_: stable_baselines3\n",
    "target is nowhere": "name: mine\n_target_: no.such.CLASS\n",
    "target is empty": "name: mine\n_target_: ''\n",
    "cycle": "name: mine\n_target_: stable_baselines3.SAC\ngamma: ${algorithm.tau}\n"
             "tau: ${algorithm.gamma}\n",
    "unknown interpolation": "name: mine\n_target_: stable_baselines3.SAC\ngamma: ${nope}\n",
    "unknown resolver": "name: mine\n_target_: stable_baselines3.SAC\ngamma: ${nope:1}\n",
    "open interpolation": "name: mine\n_target_: stable_baselines3.SAC\ngamma: ${\n",
    "object of python": "name: !!python/object:os.system x\n",
    "unknown tag": "name: !mine x\n",
    "unknown anchor": "name: *mine\n",
    "not UTF-8": b"name: \xff\xfe\n",
    "control character": b"name: a\x00b\n",
    "two documents": "name: mine\n---\nname: yours\n",
    "defaults nowhere": "defaults:\n  - nowhere\nname: mine\n",
    "defaults of text": "defaults: x\nname: mine\n",
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN_FILES)
def test_f08_broken_files_of_the_desk(name: str, refusals: Refusals) -> None:
    folder = refusals.project / "conf" / "algorithm"
    folder.mkdir(parents=True)
    content = BROKEN_FILES[name]
    path = folder / "mine.yaml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    code = run_command_line([ENV, "algorithm=mine", "mlflow=0"])
    captured = refusals.capsys.readouterr()
    assert code == 2, captured.err
    assert re.fullmatch(r"error: .+\n", captured.err), captured.err
    assert "(unexpected;" not in captured.err
    assert [file for file in refusals.project.rglob("*") if file.is_file()] == [path]


def test_f08_file_cut_at_every_tenth(refusals: Refusals) -> None:
    folder = refusals.project / "conf" / "algorithm"
    folder.mkdir(parents=True)
    whole = (SHIPPED_CONF / "algorithm" / "sac.yaml").read_text(encoding="utf-8")
    for tenth, suffix in itertools.product(range(10), ("", ": [")):
        (folder / "mine.yaml").write_text(whole[: len(whole) * tenth // 10] + suffix)
        code = run_command_line([ENV, "algorithm=mine", "mlflow=0", "n_epochs=0"])
        captured = refusals.capsys.readouterr()
        assert code == 2, (tenth, captured.err)
        assert re.fullmatch(r"error: .+\n", captured.err), captured.err
