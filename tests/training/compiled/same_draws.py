"""The random numbers of the loops on the device, for the loops of the host, so that both can be compared."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rejeu.replay.device_priorities import order
from rejeu.replay.hindsight import HerReplayBuffer
from rejeu.replay.prioritized import Draw
from rejeu.training.compiled.off_policy import draws
from rejeu.training.compiled.program import random_action
from rejeu.training.run import Run


class SameDraws:
    """Stands for ``Run.rng``: returns the numbers that the device uses at the environment step where the run is."""

    def __init__(self, run: Run) -> None:
        self.run = run
        self.step = -1
        self.batches = 0
        """Batches drawn at this step."""
        self.part, self.calls = 0, 0
        """0 for the rows of a batch and 1 for its goals; how often numbers of this part were asked for."""
        self.strategy: int | None = None
        """The number of the strategy that chooses goals, where there are several."""
        self.bit_generator = np.random.default_rng(0).bit_generator

    def uniform(self, low: float, high: float, shape: tuple[int, ...]) -> np.ndarray:
        """Returns the random actions of a Box."""
        return np.asarray(self._random_action(shape[0]), np.float64)

    def integers(self, n: Any, size: Any, dtype: Any = np.int64) -> np.ndarray:
        """Returns the random actions of other spaces."""
        return np.asarray(self._random_action(size if isinstance(size, int) else size[0]), dtype)

    def random(self, shape: int | tuple[int, ...]) -> np.ndarray:
        """Returns numbers in [0, 1) that stand for rows: at first those of a batch, then of rows that are drawn again."""
        if self.step != self.run.step:
            self.step, self.batches = self.run.step, 0
        key = jax.random.fold_in(self._root(), self.batches)
        key = jax.random.fold_in(key, self.part)
        key = key if self.strategy is None else jax.random.fold_in(key, self.strategy)
        key = jax.random.fold_in(key, self.calls)
        self.calls += 1
        if isinstance(shape, tuple) and len(shape) > 1:
            return np.asarray(jax.random.bits(key, shape, jnp.uint32), np.float64) / 2.0**32
        size, n = self.sizes[self.part], shape[0] if isinstance(shape, tuple) else shape
        return np.asarray(jax.random.bits(key, (size,), jnp.uint32), np.float64)[:n] / 2.0**32

    def shuffle(self, index: np.ndarray) -> None:
        """Shuffles the steps of a batch that were drawn by priority."""
        key = jax.random.fold_in(jax.random.fold_in(self._root(), self.batches), 0)
        index[:] = index[np.asarray(order(key, len(index)))]

    def begin_batch(self, n: int, n_goals: int) -> None:
        """Says that the rows of a batch follow."""
        if self.step != self.run.step:
            self.step, self.batches = self.run.step, 0
        self.batches += 1
        self.part, self.calls, self.sizes, self.strategy = 0, 0, (n, n_goals), None

    def begin_goals(self) -> None:
        """Says that the goals of the batch follow."""
        self.part, self.calls = 1, 0

    def begin_strategy(self, n: int) -> None:
        """Says that the goals that the next one of several strategies chooses for ``n`` transitions follow."""
        self.strategy = 0 if self.strategy is None else self.strategy + 1
        self.calls, self.sizes = 0, (self.sizes[0], n)

    def _root(self) -> jax.Array:
        return draws(jnp.asarray(self.run.key), jnp.uint32(self.run.step))

    def _random_action(self, n: int) -> jax.Array:
        return random_action(self.run.env.action_space, n, jax.random.fold_in(self._root(), 0))


def use_same_draws(run: Run) -> None:
    """Makes the host's loop draw what the device draws."""
    rng: Any = SameDraws(run)
    run.rng = rng
    buffer = run.replay
    draw = buffer.draw

    def announced_draw(rng: Any, shape: tuple[int, ...], progress: float = 1.0) -> Any:
        if len(shape) > 1:  # the device draws one batch after the other
            batches, drawn = zip(*(announced_draw(rng, shape[1:], progress) for _ in range(shape[0])), strict=True)
            if drawn[0] is not None:
                position, time = (
                    np.concatenate(parts) for parts in zip(*(indices[:2] for indices in drawn), strict=True)
                )
                drawn = (Draw(position, time, drawn[0].version),)
            return jax.tree.map(lambda *leaves: np.stack(leaves), *batches), drawn[0]
        k = buffer.config.n_sampled_goal if isinstance(buffer, HerReplayBuffer) else 0
        rng.begin_batch(shape[0], int(shape[0] * k / (k + 1)))
        return draw(rng, shape, progress)

    buffer.draw = announced_draw
    if not isinstance(buffer, HerReplayBuffer):
        return
    goal_index, chosen_by = buffer.goal_index, buffer.chosen_by

    def announced_goals(*arguments: Any) -> Any:
        rng.begin_goals()
        return goal_index(*arguments)

    def announced_choice(same_rng: Any, env: np.ndarray, *arguments: Any) -> Any:
        if len(env) < rng.sizes[1]:  # one of several strategies
            rng.begin_strategy(len(env))
        return chosen_by(same_rng, env, *arguments)

    buffer.goal_index, buffer.chosen_by = announced_goals, announced_choice


def assert_same_learning(agent: Any, other_agent: Any, tolerance: float, counters: tuple[str, ...] = ()) -> None:
    """Asserts that two agents have the same parameters, replay or rollout, episodes and counters."""
    arrays = ((learned.get_parameters(), learned.run.replay.arrays()) for learned in (agent, other_agent))
    for ours, theirs in zip(*arrays, strict=True):
        for name, values in ours.items():
            np.testing.assert_allclose(values, theirs[name], rtol=tolerance, atol=tolerance, err_msg=name)
    assert len(agent.history) == len(other_agent.history)
    np.testing.assert_allclose(agent.history.table()[:, :4], other_agent.history.table()[:, :4], rtol=tolerance)
    for name in ("step", "episode", "n_updates", *counters):
        assert getattr(agent.run, name) == getattr(other_agent.run, name), name
