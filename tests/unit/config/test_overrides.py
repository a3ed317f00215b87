import pytest

from scilab_rl.config.compose import compose, friendly_override
from scilab_rl.config.overrides import read_changes
from scilab_rl.errors import ConfigError

TEXTS = [
    "critic_variance > p99", "object fell", "a, b and c", "it's", 'say "so"', "lr=0.1 (second try)",
    "Größe 3 μm", "[wip]", "{a: 1}", "2024", "1e3", "true", "back\\", "\\'", "a: b", "#1", "100 %!",
    "x < 3 & y", "choice(1,2)", "two\nlines", "(1)", "日本語", "a;b", "f(x", "]",
]  # fmt: skip


def composed(*overrides):
    return compose(["tuned=false", *overrides])


@pytest.mark.parametrize("text", TEXTS)
def test_text_arrives_as_it_was_typed(text):
    """The shell has taken the quotes of `info='a, b'`."""
    assert composed(f"info={text}", f"++record_when={text}").info == text
    assert composed(f"record_when={text}").record_when == text


@pytest.mark.parametrize("key", ["group", "project_name", "entity", "restore_policy", "device"])
@pytest.mark.parametrize("text", ["small nets (3)", "2024", "a=b > c", "Größe"])
def test_every_key_for_text_takes_it(key, text):
    assert getattr(composed(f"{key}={text}"), key) == text


def test_lists_of_texts():
    given = "tags=[pilot study,lr > 0.1,'a, b',run (2),Größe=3]"
    assert composed(given).tags == ["pilot study", "lr > 0.1", "a, b", "run (2)", "Größe=3"]


@pytest.mark.parametrize(
    "override",
    ["info='in quotes'", 'info="it\'s"', "record_when=null", "env=A,B", "info=plain", "info=",
     "group=choice(a,b)", "algorithm=sac", "~env", "n_epochs=[1", "=", "tags=[a,b]",
     "hydra.sweeper.study_name=plain"],
)  # fmt: skip
def test_what_hydra_reads_stays(override):
    assert friendly_override(override) == override


def test_quoting_twice_changes_nothing():
    for text in TEXTS:
        once = friendly_override(f"info={text}")
        assert friendly_override(once) == once


def test_names_of_studies_reach_their_own_check():
    quoted = friendly_override("hydra.sweeper.study_name=my study (v2)")
    assert list(read_changes([quoted])) == [("hydra.sweeper.study_name", "my study (v2)")]


@pytest.mark.parametrize("override", ["n_epochs=1,2", "~info", "seed=range(1,3)"])
def test_changes_are_single_values(override):
    with pytest.raises(ConfigError, match="must be KEY=VALUE with one value"):
        list(read_changes([override]))
