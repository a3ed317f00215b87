"""The example of the paper: SAC rewarded for the disagreement of its critics."""

from __future__ import annotations

import difflib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from custom_algorithms import sac_var
from custom_algorithms.sac_var import SAC_VAR
from scilab_rl.algorithms import cleansac
from scilab_rl.algorithms.cleansac import CLEANSAC


def column(*values: float) -> torch.Tensor:
    return torch.tensor(values).reshape(-1, 1)


@pytest.fixture
def make(make_env: Any) -> Any:
    def make_model(cls: type = SAC_VAR, **kwargs: Any) -> Any:
        small = {"buffer_size": 500, "learning_starts": 20, "batch_size": 16, "net_arch": [8]}
        env = make_env("TinyBox-v0")
        return cls(env=env, seed=1, device="cpu", **(small | kwargs))

    return make_model


def test_the_difference_from_cleansac_is_the_idea() -> None:
    files = [Path(module.__file__).read_text("utf-8") for module in (cleansac, sac_var)]
    lines = difflib.unified_diff(*(text.splitlines() for text in files), lineterm="", n=0)
    changed = [line for line in lines if line[0] in "+-" and line[:3] not in ("+++", "---")]
    assert len(changed) <= 40


def test_variances_are_scaled_to_the_unit_interval() -> None:
    scaled = sac_var.min_max_scaled(column(2.0, 6.0, 3.0))
    assert scaled.flatten().tolist() == [0.0, 1.0, 0.25]


@pytest.mark.parametrize("values", [(3.0, 3.0, 3.0), (0.0, 0.0), (1e-40, 1e-40), (5.0,)])
def test_equal_variances_are_no_reward(values: tuple[float, ...]) -> None:
    assert sac_var.min_max_scaled(column(*values)).flatten().tolist() == [0.0] * len(values)


def test_rewards_are_mixed_as_in_the_paper(make: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    model = make(weight_critic_var=0.25, gamma=0.5, ent_coef=0.0)
    # Variances 1, 0, 4 are scaled to 1/4, 0, 1; r = 0.75 r_e + 0.25 r_i.
    next_q = torch.tensor([[1.0, 3.0], [2.0, 2.0], [0.0, 4.0]])
    monkeypatch.setattr(model, "critic_target", torch.nn.Identity())
    monkeypatch.setattr(model.critic_target, "forward", lambda *_: next_q)
    batch = SimpleNamespace(
        next_observations=torch.zeros(3, 4),
        rewards=column(-1.0, -1.0, 0.0),
        dones=column(1.0, 0.0, 0.0),
    )
    targets = model.compute_targets(batch)
    # -0.75 + 0.0625;  -0.75 + 0 + 0.5 * 2;  0 + 0.25 + 0.5 * 0
    torch.testing.assert_close(targets, column(-0.6875, 0.25, 0.25))
    recorded = model.logger.take()
    assert recorded["train/target_critic_variance"] == pytest.approx(5 / 3)
    assert recorded["train/intrinsic_reward"] == pytest.approx(1.25 / 3)


def test_without_weight_it_is_sac(make: Any) -> None:
    plain = make(CLEANSAC).learn(60)
    ours = make(SAC_VAR, weight_critic_var=0.0).learn(60)
    for left, right in zip(plain.actor.parameters(), ours.actor.parameters(), strict=True):
        assert torch.equal(left, right)


def test_with_weight_it_is_not(make: Any) -> None:
    plain = make(CLEANSAC).learn(60)
    ours = make(SAC_VAR).learn(60)
    assert ours.weight_critic_var == 0.5
    assert not torch.equal(next(plain.critic.parameters()), next(ours.critic.parameters()))
