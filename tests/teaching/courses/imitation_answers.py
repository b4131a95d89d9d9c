"""Right and wrong answers of course 4, and what the checks say about the wrong ones."""

import jax.numpy as jnp
import numpy as np


def toward(position, velocity, target):
    return np.clip(4 * (target - position) - 2 * velocity, -1, 1)


def cloning_loss(action, shown):
    return jnp.mean(jnp.sum((action - shown) ** 2, axis=-1))


def aggregate(known, visited, expert):
    return known + [(obs, expert(obs)) for obs, _ in visited]


def symmetric(own, shown, n, rng):
    return np.concatenate([rng.choice(own, n // 2), rng.choice(shown, n // 2)])


RIGHT = [toward, cloning_loss, aggregate, symmetric]
WRONG = [
    ("toward", lambda p, v, t: toward(t, v, p), "the difference is reversed"),
    ("toward", lambda p, v, t: np.clip(4 * (t - p), -1, 1), "overshoots"),
    ("toward", lambda p, v, t: toward(p, -v, t), "should brake"),
    ("toward", lambda p, v, t: 4 * (t - p) - 2 * v, "np.clip"),
    ("cloning_loss", lambda a, s: jnp.sum((a - s) ** 2, axis=-1), "for each step"),
    ("cloning_loss", lambda a, s: jnp.mean((a - s) ** 2, axis=0), "for each component"),
    ("cloning_loss", lambda a, s: jnp.sum((a - s) ** 2), "grow with the batch"),
    ("cloning_loss", lambda a, s: jnp.mean((a - s) ** 2), "are averaged"),
    ("aggregate", lambda k, v, e: k + v, "that the clone took"),
    ("aggregate", lambda k, v, e: aggregate([], v, e), "is gone"),
    ("aggregate", lambda k, v, e: aggregate(k, [], e), "never asked"),
    ("aggregate", lambda k, v, e: k + [e(obs) for obs, _ in v], "list of pairs"),
    ("symmetric", lambda o, s, n, rng: rng.choice(np.concatenate([o, s]), n), "put together before"),
    ("symmetric", lambda o, s, n, rng: rng.choice(s, n), "all rows are shown"),
    ("symmetric", lambda o, s, n, rng: rng.choice(o, n), "is a shown one"),
    ("symmetric", lambda o, s, n, rng: symmetric(o, s, n, rng)[: n // 2], "shape"),
]
