"""Gives SAC custom hidden layers: an ``equinox.Module`` that maps a batch of features to ``n_outputs`` features."""

import equinox as eqx
import jax

import rejeu
from rejeu.networks import Linear


class Residual(eqx.Module):
    """Two layers with a skip connection around the second."""

    first: Linear
    second: Linear
    n_outputs: int = eqx.field(static=True)

    def __init__(self, key: jax.Array, n_inputs: int) -> None:
        first_key, second_key = jax.random.split(key)
        self.n_outputs = 64
        self.first = Linear(first_key, n_inputs, self.n_outputs)
        self.second = Linear(second_key, self.n_outputs, self.n_outputs)

    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps ``(batch, n_inputs)`` to ``(batch, n_outputs)``."""
        hidden = jax.nn.relu(self.first(x))
        return hidden + jax.nn.relu(self.second(hidden))


agent = rejeu.SAC("MlpPolicy", "Pendulum-v1", policy_kwargs={"torso": Residual}, learning_rate=1e-3, seed=0)
print(agent.summary())
agent.learn(10_000, progress_bar=True)
print(agent.evaluate(episodes=20))
agent.save("residual")
agent = rejeu.load("residual", policy_kwargs={"torso": Residual})  # a model file contains no code
