"""Right and wrong answers of course 4, and what the checks say about the wrong ones."""

import jax.numpy as jnp
import numpy as np

from rejeu.teaching.courses.checks import imitation
from tests.teaching.courses.solutions import solution

right = solution(4, imitation)


RIGHT = [*vars(right).values()]
WRONG = [
    ("toward", lambda p, v, t: right.toward(t, v, p), "the difference is reversed"),
    ("toward", lambda p, v, t: np.clip(4 * (t - p), -1, 1), "overshoots"),
    ("toward", lambda p, v, t: right.toward(p, -v, t), "should brake"),
    ("toward", lambda p, v, t: 4 * (t - p) - 2 * v, "np.clip"),
    ("toward", lambda p, v, t: float(right.toward(p, v, t).sum()), "shape"),
    ("cloning_loss", lambda a, s: jnp.sum((a - s) ** 2, axis=-1), "for each step"),
    ("cloning_loss", lambda a, s: jnp.mean((a - s) ** 2, axis=0), "for each component"),
    ("cloning_loss", lambda a, s: jnp.sum((a - s) ** 2), "grow with the batch"),
    ("cloning_loss", lambda a, s: jnp.mean((a - s) ** 2), "are averaged"),
    ("cloning_loss", lambda a, s: jnp.mean(jnp.sum(a - s, axis=-1)), "cancel"),
    ("cloning_loss", lambda a, s: jnp.mean(jnp.sum(abs(a - s), axis=-1)), "absolute errors"),
    ("cloning_loss", lambda a, s: -right.cloning_loss(a, s), "minimized"),
    ("cloning_loss", lambda a, s: np.mean(np.sum((np.array(a) - np.array(s)) ** 2, axis=-1)), "JAX"),
    ("aggregate", lambda k, v, e: k + v, "that the clone took"),
    ("aggregate", lambda k, v, e: right.aggregate([], v, e), "is gone"),
    ("aggregate", lambda k, v, e: right.aggregate(k, [], e), "never asked"),
    ("aggregate", lambda k, v, e: k + [e(obs) for obs, _ in v], "list of pairs"),
    ("aggregate", lambda k, v, e: right.aggregate(k, v[1:], e), "give 5, and the result has 4"),
    ("aggregate", lambda k, v, e: (e(v[0][0]), k)[1], "known already"),
    ("symmetric", lambda o, s, n, rng: rng.choice(np.concatenate([o, s]), n), "put together before"),
    ("symmetric", lambda o, s, n, rng: rng.choice(s, n), "all rows are shown"),
    ("symmetric", lambda o, s, n, rng: rng.choice(o, n), "is a shown one"),
    ("symmetric", lambda o, s, n, rng: right.symmetric(o, s, n, rng)[: n // 2], "shape"),
    (
        "symmetric",
        lambda o, s, n, rng: np.concatenate([rng.choice(o, n - n // 4), rng.choice(s, n // 4)]),
        "250 of 1,000",
    ),
    ("symmetric", lambda o, s, n, rng: right.symmetric(o[:100], s, n, rng), "never drawn"),
    ("symmetric", lambda o, s, n, rng: right.symmetric(o, s + 7, n, rng), "of neither array"),
    ("symmetric", lambda o, s, n, rng: right.symmetric(o, s, n, np.random.default_rng(0)), "two generators"),
]
