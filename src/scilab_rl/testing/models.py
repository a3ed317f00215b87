"""The contract test of every cognitive model, besides that of every algorithm.

A model of your own takes it with three lines in a test file:

.. code-block:: python

    from scilab_rl.testing.models import ModelContract

    class TestMyModel(ModelContract):
        algorithm = "my_model"  # conf/algorithm/my_model.yaml

Its choices in an environment and the likelihood that is fitted must be the same numbers.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import numpy as np

from scilab_rl.learning.cognitive import CognitiveModel, Seen, Values, log_likelihoods
from scilab_rl.testing.algorithms import AlgorithmContract

_N_TRIALS = 30
_N_COPIES = 2000
_N_STANDARD_ERRORS = 5.0  # so that no seed fails by chance
_FAR = 30.0  # on the real scale, in both directions


class ModelContract:
    """Subclass it, name a model, and pytest does the rest.

    Attributes:
        algorithm: Name of a YAML in an ``algorithm/`` folder, or a model's class.
        env: Id of a choice task; None picks one that fits.
    """

    algorithm: str | type
    env: str | None = None

    def test_probabilities_sum_to_one(self) -> None:
        """Whatever was seen and whatever the parameters are."""
        seen, n_actions = self._seen(), self._model.n_actions
        for values in self._parameter_sets():
            each = [
                np.exp(self._log_likelihoods(values, seen, np.full(_N_TRIALS, action)))
                for action in range(n_actions)
            ]
            assert np.allclose(np.sum(each, axis=0), 1.0, atol=1e-5)
            assert np.min(each) >= 0.0

    def test_likelihood_equals_simulated_frequencies(self) -> None:
        """Two thousand copies that see the same trials choose as often as the likelihood says."""
        model, seen, memory = self._model, self._seen(), None
        space: Any = model.observation_space
        expected = np.exp(self._log_likelihoods(model.values, seen, np.zeros(_N_TRIALS, int)))
        np.random.seed(0)
        for trial, p in enumerate(expected):
            last = None if seen.is_first[trial] else int(seen.response[trial])
            now = space.encode(int(seen.state[trial]), last, float(seen.feedback[trial]))
            actions, memory = model.predict(np.repeat(now[None], _N_COPIES, 0), state=memory)
            error = np.sqrt(p * (1 - p) / _N_COPIES)
            assert abs(np.mean(actions == 0) - p) <= _N_STANDARD_ERRORS * error + 1e-6

    def test_gradients_are_finite(self) -> None:
        """Also far from usual parameters: an optimizer may try them."""
        model, seen = self._model, self._seen()
        responses = np.arange(_N_TRIALS) % model.n_actions
        parameters = model.parameters

        def loss(real: Any) -> Any:
            values = {name: p.from_real(real[name]) for name, p in parameters.items()}
            return self._log_likelihoods(values, seen, responses).sum()

        gradient = jax.jit(jax.grad(loss))
        for shift in (-3.0, 0.0, 3.0):
            real = {name: np.float32(p.mean + shift * p.sd) for name, p in parameters.items()}
            found = jax.tree.map(np.asarray, gradient(real))
            assert all(np.isfinite(found[name]) for name in real), f"at {shift:+g} sd: {found}"

    def test_parameters_are_in_their_bounds(self) -> None:
        """Any real number is a parameter, and the parameters of the YAML are inside."""
        model = self._model
        assert set(model.values) == set(model.parameters)
        for name, parameter in model.parameters.items():
            for real in (-_FAR, -1.0, 0.0, 1.0, _FAR):
                assert parameter.low <= parameter.from_real(real, np) <= parameter.high
            assert np.isclose(parameter.to_real(parameter.from_real(0.7, np)), 0.7)
            assert parameter.low <= model.values[name] <= parameter.high

    def test_batch_equals_loop(self) -> None:
        """A participant's likelihood does not depend on who else is fitted."""
        seen, sets = self._seen(), self._parameter_sets()
        responses = np.arange(_N_TRIALS) % self._model.n_actions
        stacked = {name: np.array([values[name] for values in sets]) for name in sets[0]}
        batch = jax.vmap(lambda values: self._log_likelihoods(values, seen, responses))(stacked)
        loop = [self._log_likelihoods(values, seen, responses) for values in sets]
        assert np.allclose(batch, loop, atol=1e-4)

    @functools.cached_property
    def _model(self) -> CognitiveModel:
        contract = AlgorithmContract()
        contract.algorithm = self.algorithm
        n_stages = getattr(contract._class(), "n_stages", 1)
        contract.env = self.env or ("TwoStep" if n_stages == 2 else "Bandit")
        model = contract.build()
        assert isinstance(model, CognitiveModel)
        return model

    def _parameter_sets(self) -> list[dict[str, np.float32]]:
        """Return parameters in the middle of their priors, and at two standard deviations."""
        parameters = self._model.parameters.items()
        return [
            {name: np.float32(p.from_real(p.mean + shift * p.sd, np)) for name, p in parameters}
            for shift in (-2.0, 0.0, 2.0)
        ]

    def _seen(self) -> Seen:
        """Return trials of a made-up participant, in two blocks."""
        model, rng, is_first = self._model, np.random.default_rng(0), np.zeros(_N_TRIALS, bool)
        is_first[[0, 20]] = True
        responses = rng.integers(model.n_actions, size=_N_TRIALS)
        feedback = rng.integers(2, size=_N_TRIALS).astype(np.float32)
        states = rng.integers(model.n_states, size=_N_TRIALS)
        if model.n_stages == 2:
            states[0::2], states[1::2] = 0, 1 + states[1::2] % 2
            feedback[1::2] = 0.0  # what is seen before a second choice was a first one
        return Seen(states, responses, feedback, is_first)

    def _log_likelihoods(self, values: Values, seen: Seen, responses: np.ndarray) -> Any:
        model = self._model
        sizes = (model.n_states, model.n_actions)
        return _compiled(type(model), *sizes, values, seen, responses)


_compiled = jax.jit(log_likelihoods, static_argnums=(0, 1, 2))
