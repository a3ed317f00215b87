"""Comparisons of recorded runs: what a word means, what is counted, and what is decided."""

from __future__ import annotations

import csv
import functools
import json
from pathlib import Path

import numpy as np
import pytest

from scilab_rl.analysis.comparison import ComparisonSettings, compare, curve_of, mean_curve
from scilab_rl.analysis.groups import Group, find_group, read_record, read_records
from scilab_rl.analysis.report import (
    conclusion,
    contrast_rows,
    group_rows,
    write_reports,
)
from scilab_rl.errors import ConfigError
from scilab_rl.search.scores import Curve
from tests.unit.acceptance.runs import make_run


def find_groups(base: Path, *words: str) -> list[Group]:
    records = functools.cache(lambda: read_records(base))
    return [find_group(word, records, base) for word in words]


def make_two(base: Path, n: int = 6, gap: float = 0.3, **more: object) -> None:
    """Let sac end at 0.5 to 0.6 and td3 `gap` above it, with the same seeds."""
    for seed in range(1, n + 1):
        end = 0.5 + 0.1 * seed / n
        make_run(base, "sac", seed, [0.0, end / 2, end, end, end], **more)
        make_run(base, "td3", seed, [0.2, *[end + gap + 0.001 * seed] * 4], **more)


def test_words_mean_algorithms_groups_tags_patterns_and_runs(tmp_path: Path) -> None:
    run = make_run(tmp_path, "sac", 1, [0.1], group="monday", tags=["wild"])
    make_run(tmp_path, "td3", 2, [0.1])
    for word, meaning in [
        ("sac", "algorithm sac"),
        ("monday", "group monday"),
        ("wild", "tag wild"),
        ("*-sac-*", "runs *-sac-*"),
        (f"{tmp_path}/*/*sac*", f"runs {tmp_path}/*/*sac*"),
        (run.path.name, "run"),
    ]:
        (group,) = find_groups(tmp_path, word)
        assert (group.meaning, [record.seed for record in group.runs]) == (meaning, [1])
    (named,) = find_groups(tmp_path, "ours=sac")
    assert named.label == "ours"
    with pytest.raises(ConfigError, match="Did you mean 'monday'"):
        find_groups(tmp_path, "mondaj")


def test_the_better_side_is_found_with_pairs_of_seeds(tmp_path: Path) -> None:
    make_two(tmp_path)
    comparison = compare(find_groups(tmp_path, "sac", "td3"), ComparisonSettings())
    (contrast,) = comparison.contrasts
    assert contrast.paired and contrast.n == 6
    assert contrast.verdict == "better" and contrast.more_seeds == 0
    assert contrast.mean.value == pytest.approx(0.3035)
    assert contrast.p == pytest.approx(2 / 64)
    assert contrast.improvement.value == 1.0
    assert "td3 is better than sac" in conclusion(comparison, contrast)


def test_too_few_seeds_decide_nothing_and_it_is_said_how_many_would(tmp_path: Path) -> None:
    make_two(tmp_path, n=3)
    comparison = compare(find_groups(tmp_path, "sac", "td3"), ComparisonSettings())
    (contrast,) = comparison.contrasts
    assert contrast.verdict == "undecided"
    assert not contrast.paired
    assert contrast.more_seeds == 1  # four against four can reach p = 2/70, three pairs 1/4
    assert "about 1 more seeds of each would decide" in conclusion(comparison, contrast)


def test_five_seeds_decide_without_pairs(tmp_path: Path) -> None:
    make_two(tmp_path, n=5)
    (contrast,) = compare(find_groups(tmp_path, "sac", "td3"), ComparisonSettings()).contrasts
    assert (contrast.paired, contrast.verdict) == (False, "better")
    assert contrast.p == pytest.approx(2 / 252)


def test_scores_by_hand(tmp_path: Path) -> None:
    make_run(tmp_path, "sac", 1, [0.0, 0.3, 0.6, 0.9])
    make_run(tmp_path, "td3", 1, [0.0, 0.0, 0.0, 0.0])
    by_score = {
        score: compare(find_groups(tmp_path, "sac", "td3"), ComparisonSettings(score=score))
        .groups[0]
        .scores[0][0]
        for score in ("final", "auc", "steps_to_threshold")
    }
    assert by_score == {
        "final": pytest.approx(0.6),
        "auc": pytest.approx(0.45),
        "steps_to_threshold": 400,
    }


def test_fewer_steps_are_better(tmp_path: Path) -> None:
    for seed in range(1, 8):
        make_run(tmp_path, "sac", seed, [0.0, 0.0, 0.0, 1.0])
        make_run(tmp_path, "td3", seed, [0.0, 1.0, 1.0, 1.0])
    settings = ComparisonSettings(score="steps_to_threshold")
    (contrast,) = compare(find_groups(tmp_path, "sac", "td3"), settings).contrasts
    assert (contrast.verdict, contrast.mean.value) == ("better", -200)
    assert contrast.improvement.value == 1.0


def test_unequal_lengths_are_compared_up_to_the_shortest(tmp_path: Path) -> None:
    make_run(tmp_path, "sac", 1, [0.0, 0.5])
    make_run(tmp_path, "td3", 1, [0.1, 0.1, 0.9, 0.9])
    comparison = compare(find_groups(tmp_path, "sac", "td3"), ComparisonSettings())
    assert comparison.horizon == {"FetchReach-v4": 200}
    assert comparison.groups[1].scores[0][0] == pytest.approx(0.1)
    assert any("1 runs are longer than others" in note for note in comparison.notes)


def test_a_run_that_solved_stays_where_it_was(tmp_path: Path) -> None:
    make_run(tmp_path, "sac", 1, [0.0, 1.0], status="solved", n_epochs=4)
    make_run(tmp_path, "td3", 1, [0.0, 0.0, 0.0, 0.0])
    settings = ComparisonSettings(score="auc")
    comparison = compare(find_groups(tmp_path, "sac", "td3"), settings)
    assert comparison.horizon == {"FetchReach-v4": 400}
    assert comparison.groups[0].scores[0][0] == pytest.approx(0.75)
    assert any("1 runs ended as solved" in note for note in comparison.notes)


def test_a_solved_run_that_was_measured_to_the_end_is_no_assumption(tmp_path: Path) -> None:
    make_run(tmp_path, "sac", 1, [0.0, 1.0], status="solved", n_epochs=4)
    make_run(tmp_path, "td3", 1, [0.0, 0.0])
    comparison = compare(find_groups(tmp_path, "sac", "td3"), ComparisonSettings())
    assert comparison.horizon == {"FetchReach-v4": 200}
    assert not any("solved" in note for note in comparison.notes)


def test_runs_that_a_study_has_pruned_are_left_out(tmp_path: Path) -> None:
    """They are not what they would have become, and cut nobody else's curve."""
    for algorithm in ("sac", "td3"):
        make_run(tmp_path, algorithm, 1, [0.0, 0.5, 1.0])
    make_run(tmp_path, "sac", 2, [0.0], status="pruned", n_epochs=3)
    comparison = compare(find_groups(tmp_path, "sac", "td3"), ComparisonSettings())
    assert comparison.groups[0].n_runs == 1
    assert comparison.horizon == {"FetchReach-v4": 300}
    assert "sac: 1 runs were pruned by a study and are left out" in comparison.notes


def test_evaluations_without_the_metric_keep_their_steps(tmp_path: Path) -> None:
    """A task that reports success only when it succeeds has no rate before: there it is 0."""
    late = make_run(tmp_path, "sac", 1, [0.0, 0.0, 1.0, 1.0])
    rows = [json.loads(line) for line in (late / "metrics.jsonl").read_text().splitlines()]
    del rows[0]["eval/success_rate"], rows[1]["eval/success_rate"], rows[0]["eval/mean_reward"]
    (late / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    record = read_record(late)
    assert record is not None
    curve = curve_of(record, "eval/success_rate", 400, 0.9)
    assert (curve.steps, curve.values) == ((100, 200, 300, 400), (0.0, 0.0, 1.0, 1.0))
    curve = curve_of(record, "eval/mean_reward", 400, 0.9)
    assert (curve.steps, curve.values) == ((200, 300, 400), (0.0, 1.0, 1.0))


def test_crashed_seeds_are_told_with_what_they_would_change(tmp_path: Path) -> None:
    for seed in (1, 2, 3):
        make_run(tmp_path, "sac", seed, [0.9] * 3)
        make_run(tmp_path, "td3", seed, [0.9] * 3, status="failed" if seed == 3 else "finished")
    comparison = compare(find_groups(tmp_path, "sac", "td3"), ComparisonSettings())
    assert (comparison.groups[1].n_runs, comparison.groups[1].n_failed) == (2, 1)
    assert "td3: 1 of 3 runs crashed and are in no estimate" in comparison.notes
    assert any("counted as 0 its mean would be 0.6 and not 0.9" in n for n in comparison.notes)


def test_other_fingerprints_and_configurations_are_told(tmp_path: Path) -> None:
    make_run(tmp_path, "sac", 1, [0.5], gamma=0.9)
    make_run(tmp_path, "sac", 2, [0.5], gamma=0.99)
    make_run(tmp_path, "td3", 1, [0.5], fingerprint="xyz")
    notes = compare(find_groups(tmp_path, "sac", "td3"), ComparisonSettings()).notes
    assert any("algorithm.gamma differ" in note for note in notes)
    assert any("did not behave the same" in note for note in notes)


def test_runs_of_several_environments_are_never_mixed(tmp_path: Path) -> None:
    for seed in (1, 2, 3, 4):
        for env, level in (("FetchReach-v4", 0.8), ("FetchPush-v4", 0.1)):
            make_run(tmp_path, "sac", seed, [level] * 3, env=env)
            make_run(tmp_path, "td3", seed, [level + 0.1] * 3, env=env)
    make_run(tmp_path, "td3", 1, [0.0], env="FetchSlide-v4")
    comparison = compare(find_groups(tmp_path, "sac", "td3"), ComparisonSettings())
    assert set(comparison.tasks) == {"FetchReach-v4", "FetchPush-v4"}
    (contrast,) = comparison.contrasts
    assert contrast.mean.value == pytest.approx(0.1)
    assert any("FetchSlide-v4" in note for note in comparison.notes)


def test_without_success_the_reward_counts(tmp_path: Path) -> None:
    make_run(tmp_path, "sac", 1, [10.0], metric="eval/mean_ep_length")
    make_run(tmp_path, "td3", 1, [20.0], metric="eval/mean_ep_length")
    assert (
        compare(find_groups(tmp_path, "sac", "td3"), ComparisonSettings()).metric
        == "eval/mean_reward"
    )
    with pytest.raises(ConfigError, match="Not all runs have the metric 'eval/success_rate'"):
        compare(find_groups(tmp_path, "sac", "td3"), ComparisonSettings("success_rate"))


def test_success_compares_whatever_reward_was_learned_from(tmp_path: Path) -> None:
    make_run(tmp_path, "sac", 1, [0.5] * 3, reward_type="sparse")
    make_run(tmp_path, "td3", 1, [0.9] * 3, reward_type="dense")
    groups = find_groups(tmp_path, "sac", "td3")
    comparison = compare(groups, ComparisonSettings())
    assert comparison.tasks == ("FetchReach-v4",)
    assert comparison.contrasts[0].mean.value == pytest.approx(0.4)
    assert any("env_kwargs.reward_type" in note for note in comparison.notes)
    with pytest.raises(ConfigError, match=r"different rewards .* eval/success_rate does"):
        compare(groups, ComparisonSettings("eval/mean_reward"))


def test_nothing_in_common_is_an_error(tmp_path: Path) -> None:
    make_run(tmp_path, "sac", 1, [0.5])
    make_run(tmp_path, "td3", 1, [0.5], env="FetchPush-v4")
    with pytest.raises(ConfigError, match="no environment in common"):
        compare(find_groups(tmp_path, "sac", "td3"), ComparisonSettings())
    make_run(tmp_path, "ppo", 1, [], status="failed")
    with pytest.raises(ConfigError, match=r"ppo .* has no finished run"):
        compare(find_groups(tmp_path, "sac", "ppo"), ComparisonSettings())


def test_reports(tmp_path: Path) -> None:
    make_two(tmp_path)
    comparison = compare(find_groups(tmp_path, "sac", "td3"), ComparisonSettings())
    files = {path.name: path for path in write_reports(comparison, tmp_path / "out")}
    assert set(files) == {
        "comparison.html", "comparison.png", "comparison.svg", "comparison.md", "comparison.json",
        "runs.csv",
    }  # fmt: skip
    page = files["comparison.html"].read_text()
    assert "://" not in page
    assert page.index("td3 is better than sac") < page.index('class="forest"')
    (run,) = {path for path in tmp_path.glob("*/*-td3-s1-*")}
    assert f'<a href="../{run.relative_to(tmp_path).as_posix()}/">{run.name}</a>' in page
    assert "We compared sac (6 runs) and td3 (6 runs) on FetchReach-v4" in page
    assert "permutation test paired by seed." in page
    assert "td3 is better than sac" in files["comparison.md"].read_text()
    rows = list(csv.DictReader(files["runs.csv"].read_text().splitlines()))
    assert len(rows) == 12 and rows[0]["counted"] == "True"
    assert [row["group"] for row in group_rows(comparison)] == ["sac", "td3"]
    assert contrast_rows(comparison)[0]["pairs"] == "6"


def test_the_mean_is_drawn_only_where_every_run_was_measured() -> None:
    curves = [Curve((100, 200), (0.0, 1.0), 400), Curve((50, 200, 400), (0.5, 0.5, 0.0), 400)]
    assert mean_curve(curves, as_share=False) == ([100.0, 200.0, 400.0], [0.25, 0.75, 0.5])
    assert mean_curve(curves, as_share=True)[0] == [0.25, 0.5, 1.0]


def test_what_differs_in_the_configurations_is_listed_per_group(tmp_path: Path) -> None:
    make_two(tmp_path, n=2)
    comparison = compare(find_groups(tmp_path, "sac", "td3"), ComparisonSettings())
    differences = {key: values for key, *values in comparison.differences}
    assert differences["algorithm.name"] == ["sac", "td3"]
    assert "seed" not in differences


def test_a_table_as_parquet_holds_the_same(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    make_two(tmp_path, n=2)
    comparison = compare(find_groups(tmp_path, "sac", "td3"), ComparisonSettings())
    write_reports(comparison, tmp_path / "out", parquet=True)
    table = parquet.read_table(tmp_path / "out" / "runs.parquet")
    assert table.num_rows == 4
    assert np.allclose(table["final"].to_pylist(), [row["final"] for row in comparison.runs])
