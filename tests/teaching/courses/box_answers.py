"""Right and wrong answers of course 2, and what the checks say about the wrong ones."""

import jax
import jax.numpy as jnp
import numpy as np

from rejeu.teaching.courses.checks import box
from tests.teaching.courses.solutions import solution

right = solution(2, box)


def relu(layers, x):
    for weight, bias in layers:
        x = jnp.maximum(x @ weight + bias, 0.0)
    return x


def critic(layers, state, action, order=1, last=lambda x: x):
    branches = [relu(layers["state"], state), relu(layers["action"], action)][::order]
    weight, bias = layers["output"]
    return last(relu(layers["common"], jnp.concatenate(branches, axis=1)) @ weight + bias)


RIGHT = [*vars(right).values()]


def looks_before(position, push, kick):
    after = position + push + kick
    lost = bool(np.any(abs(position) > 10))
    return after, -10.0 if lost else 1.0, lost


def all_outside(position, push, kick):
    after = position + push + kick
    lost = bool(np.all(abs(after) > 10))
    return after, -10.0 if lost else 1.0, lost


def no_absolute_value(position, push, kick):
    after = position + push + kick
    lost = bool(np.any(after > 10))
    return after, -10.0 if lost else 1.0, lost


def only_action_pushed(action, x, strength, low, high):
    return right.repel(action, x, strength, low, high)[0], x


def pushed_out(action, x, strength, low, high):
    return right.repel(action, x, -strength, low, high)


def clipped_first(action, x, strength, low, high):
    u = jnp.clip(action + x, low, high)
    push = strength * right.barrier_slope(u, low, high)
    return u - push, x - push


def crossed(q, state, action, target):
    return jnp.mean((target - q(state, action)) ** 2)


def slope_without(factor):
    return lambda u, low, high: right.barrier_slope(u, low, high) / factor(low, high)


WRONG = [
    ("ball_step", looks_before, "position before the step"),
    ("ball_step", all_outside, "any or all"),
    ("ball_step", no_absolute_value, "absolute value"),
    ("ball_step", lambda p, a, k: right.ball_step(p, a, 0 * k), "without the random kick"),
    ("ball_step", lambda p, a, k: right.ball_step(p, 0 * a, k), "without the push"),
    ("ball_step", lambda p, a, k: (p + a + k, 1.0, right.ball_step(p, a, k)[2]), "-10 for leaving"),
    ("ball_step", lambda p, a, k: p + a + k, "three values"),
    ("td_targets", lambda r, d, v, g: r + g * v, "still gets a future"),
    ("td_targets", lambda r, d, v, g: r + g * d * v, "only the step that terminated"),
    ("td_targets", lambda r, d, v, g: (1 - d) * (r + g * v), "-10 of the last step"),
    ("td_targets", lambda r, d, v, g: r + (1 - d) * v, "gamma is missing"),
    ("td_targets", lambda r, d, v, g: g * (r + (1 - d) * v), "reward is discounted"),
    ("td_error", lambda v, y: v - y, "sign is reversed"),
    ("td_error", lambda v, y: abs(v - y), "never negative"),
    ("td_error", lambda v, y: (v - y) ** 2, "squared error"),
    ("critic", lambda *given: critic(*given, order=-1), "state first"),
    ("critic", lambda *given: critic(*given, last=lambda x: jnp.maximum(x, 0)), "last layer linear"),
    ("critic", lambda *given: critic(*given)[:, 0], "expected (6, 1)"),
    ("critic", lambda layers, s, a: critic({**layers, "output": (layers["output"][0], 0.0)}, s, a), "bias"),
    ("bounded", lambda x, low, high: jnp.clip(x, low, high), "derivative is 0"),
    ("bounded", lambda x, low, high: high * jnp.tanh(x), "the middle only of a range"),
    ("bounded", lambda x, low, high: (low + high) / 2 + (high - low) * jnp.tanh(x), "a length of 2"),
    ("bounded", lambda x, low, high: low + (high - low) * jnp.tanh(x), "sigmoid"),
    ("bounded", lambda x, low, high: right.bounded(x, high, low), "swapped"),
    ("critic_loss", crossed, "every value against every target"),
    ("critic_loss", lambda q, s, a, y: jnp.sum((y - q(s, a)[:, 0]) ** 2), "sum over the batch"),
    ("critic_loss", lambda q, s, a, y: jnp.mean(y - q(s, a)[:, 0]), "not squared"),
    ("critic_loss", lambda *given: -right.critic_loss(*given), "make the errors larger"),
    ("critic_loss", lambda q, s, a, y: (y - q(s, a)[:, 0]) ** 2, "one number"),
    ("actor_loss", lambda *given: -right.actor_loss(*given), "look for the worst"),
    ("actor_loss", lambda mu, q, s: -jnp.sum(q(s, mu(s))), "take the mean"),
    ("actor_loss", lambda mu, q, s: -jnp.mean(mu(s)), "critic does not appear"),
    ("soft_update", lambda t, o, tau: right.soft_update(t, o, 1 - tau), "are swapped"),
    ("soft_update", lambda t, o, tau: o, "copies the network"),
    ("soft_update", lambda t, o, tau: jax.tree.map(lambda t, o: t + tau * o, t, o), "grows without end"),
    ("soft_update", lambda t, o, tau: right.soft_update(t, o, -tau), "moves away"),
    ("soft_update", lambda t, o, tau: o["weight"], "must be a tree"),
    ("ou_step", lambda x, n, theta, sigma, dt: right.ou_step(x, n, -theta, sigma, dt), "drift has the wrong sign"),
    ("ou_step", lambda x, n, theta, sigma, dt: x - theta * x * dt + sigma * dt * n, "multiplied by dt"),
    ("ou_step", lambda x, n, theta, sigma, dt: x - theta * x * dt + sigma * n, "does not depend on dt"),
    ("ou_step", lambda x, n, theta, sigma, dt: x - theta * x + sigma * dt**0.5 * n, "theta is a rate"),
    ("ou_step", lambda x, n, theta, sigma, dt: right.ou_step(x, 0, theta, sigma, dt), "no noise"),
    ("ou_step", lambda x, *rest: right.ou_step(x, *rest) - x, "Add it to x"),
    ("ou_step", lambda x, n, theta, sigma, dt: x - theta * dt + sigma * dt**0.5 * n, "does not depend on x"),
    ("barrier_slope", slope_without(lambda low, high: np.pi / (high - low)), "inner derivative is missing"),
    ("barrier_slope", slope_without(lambda low, high: 2 / (high - low)), "half width of 1"),
    ("barrier_slope", lambda *given: -right.barrier_slope(*given), "minus the derivative"),
    ("barrier_slope", lambda *given: abs(right.barrier_slope(*given)), "lost its sign"),
    ("barrier_slope", lambda u, low, high: (np.pi / 2 * (u - 1) / 2) ** 6, "the barrier itself"),
    ("barrier_slope", lambda u, low, high: right.barrier_slope(u + 1, low, high), "middle of the range"),
    ("repel", pushed_out, "pushed out instead of in"),
    ("repel", only_action_pushed, "the process is not"),
    ("repel", clipped_first, "clipped before the push"),
    ("repel", lambda *given: right.repel(*given)[::-1], "are swapped"),
    ("repel", lambda *given: right.repel(*given)[0], "two values"),
    ("repel", lambda a, x, s, low, high: (jnp.clip(a + x, low, high), x), "only clipped"),
    ("repel", lambda a, x, s, low, high: (a + x - s * right.barrier_slope(a + x, low, high), x), "Clip after it"),
    ("repel", lambda *given: (right.repel(*given)[0], pushed_out(*given)[1]), "process is pushed out"),
    ("repel", lambda a, *rest: (right.repel(a, *rest)[0], right.repel(a, *rest)[0] - a), "clipped together"),
    ("pendulum_reward", lambda *given: -right.pendulum_reward(*given), "this is a cost"),
    ("pendulum_reward", lambda obs, torque: right.pendulum_reward(obs[[1, 0, 2]], torque), "sine first"),
    (
        "pendulum_reward",
        lambda o, u: -(np.arctan(o[1] / o[0]) ** 2 + 0.1 * o[2] ** 2 + 0.001 * u**2),
        "not distinguish",
    ),
    ("pendulum_reward", lambda o, u: -(np.arcsin(o[1]) ** 2 + 0.1 * o[2] ** 2 + 0.001 * u**2), "not distinguish"),
    ("pendulum_reward", lambda o, u: -(np.arctan2(o[1], o[0]) ** 2 + o[2] ** 2 + u**2), "0.1 and 0.001"),
    ("discrete_actor_loss", lambda *given: -right.discrete_actor_loss(*given), "look for the worst"),
    ("discrete_actor_loss", lambda x, v: -jnp.mean(jax.nn.softmax(x, axis=1) * v), "sum over the actions"),
    ("discrete_actor_loss", lambda x, v: -jnp.mean(jnp.sum(x * v, axis=1)), "softmax"),
    ("discrete_actor_loss", lambda x, v: -jnp.mean(v[jnp.arange(2), x.argmax(axis=1)]), "argmax"),
    ("discrete_actor_loss", lambda x, v: -jnp.mean(v), "logits do not appear"),
]
