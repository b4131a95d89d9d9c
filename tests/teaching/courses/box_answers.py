"""Right and wrong answers of course 2, and what the checks say about the wrong ones."""

import jax
import jax.numpy as jnp
import numpy as np


def ball_step(position, push, kick):
    position = position + push + kick
    lost = bool(np.any(abs(position) > 10))
    return position, -10.0 if lost else 1.0, lost


def td_targets(reward, terminated, next_value, gamma):
    return reward + gamma * (1 - terminated) * next_value


def td_error(value, target):
    return target - value


def relu(layers, x):
    for weight, bias in layers:
        x = jnp.maximum(x @ weight + bias, 0.0)
    return x


def critic(layers, state, action, order=1, last=lambda x: x):
    branches = [relu(layers["state"], state), relu(layers["action"], action)][::order]
    weight, bias = layers["output"]
    return last(relu(layers["common"], jnp.concatenate(branches, axis=1)) @ weight + bias)


def bounded(output, low, high):
    return (low + high) / 2 + (high - low) / 2 * jnp.tanh(output)


def critic_loss(q, state, action, target):
    return jnp.mean((target - q(state, action)[:, 0]) ** 2)


def actor_loss(mu, q, state):
    return -jnp.mean(q(state, mu(state)))


def soft_update(target, online, tau):
    return jax.tree.map(lambda t, o: (1 - tau) * t + tau * o, target, online)


def ou_step(x, normal, theta, sigma, dt):
    return x - theta * x * dt + sigma * dt**0.5 * normal


def barrier_slope(u, low, high):
    half = (high - low) / 2
    return 6 * (np.pi / 2 * (u - (low + high) / 2) / half) ** 5 * np.pi / (2 * half)


def repel(action, x, strength, low, high):
    push = strength * barrier_slope(action + x, low, high)
    return jnp.clip(action + x - push, low, high), x - push


def pendulum_reward(observation, torque):
    cosine, sine, speed = observation
    return -(np.arctan2(sine, cosine) ** 2 + 0.1 * speed**2 + 0.001 * torque**2)


def discrete_actor_loss(logits, values):
    return -jnp.mean(jnp.sum(jax.nn.softmax(logits, axis=1) * values, axis=1))


RIGHT = [
    ball_step, td_targets, td_error, critic, bounded, critic_loss, actor_loss, soft_update, ou_step, barrier_slope, repel,
    pendulum_reward, discrete_actor_loss,
]  # fmt: skip


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
    return repel(action, x, strength, low, high)[0], x


def pushed_out(action, x, strength, low, high):
    return repel(action, x, -strength, low, high)


def clipped_first(action, x, strength, low, high):
    u = jnp.clip(action + x, low, high)
    push = strength * barrier_slope(u, low, high)
    return u - push, x - push


def crossed(q, state, action, target):
    return jnp.mean((target - q(state, action)) ** 2)


def slope_without(factor):
    return lambda u, low, high: barrier_slope(u, low, high) / factor(low, high)


WRONG = [
    ("ball_step", looks_before, "position before the step"),
    ("ball_step", all_outside, "any or all"),
    ("ball_step", no_absolute_value, "absolute value"),
    ("ball_step", lambda p, a, k: ball_step(p, a, 0 * k), "without the random kick"),
    ("ball_step", lambda p, a, k: ball_step(p, 0 * a, k), "without the push"),
    ("ball_step", lambda p, a, k: (p + a + k, 1.0, ball_step(p, a, k)[2]), "-10 for leaving"),
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
    ("bounded", lambda x, low, high: bounded(x, high, low), "swapped"),
    ("critic_loss", crossed, "every value against every target"),
    ("critic_loss", lambda q, s, a, y: jnp.sum((y - q(s, a)[:, 0]) ** 2), "sum over the batch"),
    ("critic_loss", lambda q, s, a, y: jnp.mean(y - q(s, a)[:, 0]), "not squared"),
    ("critic_loss", lambda *given: -critic_loss(*given), "make the errors larger"),
    ("critic_loss", lambda q, s, a, y: (y - q(s, a)[:, 0]) ** 2, "one number"),
    ("actor_loss", lambda *given: -actor_loss(*given), "look for the worst"),
    ("actor_loss", lambda mu, q, s: -jnp.sum(q(s, mu(s))), "take the mean"),
    ("actor_loss", lambda mu, q, s: -jnp.mean(mu(s)), "critic does not appear"),
    ("soft_update", lambda t, o, tau: soft_update(t, o, 1 - tau), "are swapped"),
    ("soft_update", lambda t, o, tau: o, "copies the network"),
    ("soft_update", lambda t, o, tau: jax.tree.map(lambda t, o: t + tau * o, t, o), "grows without end"),
    ("soft_update", lambda t, o, tau: soft_update(t, o, -tau), "moves away"),
    ("soft_update", lambda t, o, tau: o["weight"], "must be a tree"),
    ("ou_step", lambda x, n, theta, sigma, dt: ou_step(x, n, -theta, sigma, dt), "drift has the wrong sign"),
    ("ou_step", lambda x, n, theta, sigma, dt: x - theta * x * dt + sigma * dt * n, "multiplied by dt"),
    ("ou_step", lambda x, n, theta, sigma, dt: x - theta * x * dt + sigma * n, "does not depend on dt"),
    ("ou_step", lambda x, n, theta, sigma, dt: x - theta * x + sigma * dt**0.5 * n, "theta is a rate"),
    ("ou_step", lambda x, n, theta, sigma, dt: ou_step(x, 0, theta, sigma, dt), "no noise"),
    ("ou_step", lambda x, *rest: ou_step(x, *rest) - x, "Add it to x"),
    ("ou_step", lambda x, n, theta, sigma, dt: x - theta * dt + sigma * dt**0.5 * n, "does not depend on x"),
    ("barrier_slope", slope_without(lambda low, high: np.pi / (high - low)), "inner derivative is missing"),
    ("barrier_slope", slope_without(lambda low, high: 2 / (high - low)), "half width of 1"),
    ("barrier_slope", lambda *given: -barrier_slope(*given), "minus the derivative"),
    ("barrier_slope", lambda *given: abs(barrier_slope(*given)), "lost its sign"),
    ("barrier_slope", lambda u, low, high: (np.pi / 2 * (u - 1) / 2) ** 6, "the barrier itself"),
    ("barrier_slope", lambda u, low, high: barrier_slope(u + 1, low, high), "middle of the range"),
    ("repel", pushed_out, "pushed out instead of in"),
    ("repel", only_action_pushed, "the process is not"),
    ("repel", clipped_first, "clipped before the push"),
    ("repel", lambda *given: repel(*given)[::-1], "are swapped"),
    ("repel", lambda *given: repel(*given)[0], "two values"),
    ("repel", lambda a, x, s, low, high: (jnp.clip(a + x, low, high), x), "only clipped"),
    ("repel", lambda a, x, s, low, high: (a + x - s * barrier_slope(a + x, low, high), x), "Clip after it"),
    ("repel", lambda *given: (repel(*given)[0], pushed_out(*given)[1]), "process is pushed out"),
    ("repel", lambda a, *rest: (repel(a, *rest)[0], repel(a, *rest)[0] - a), "clipped together"),
    ("pendulum_reward", lambda *given: -pendulum_reward(*given), "this is a cost"),
    ("pendulum_reward", lambda obs, torque: pendulum_reward(obs[[1, 0, 2]], torque), "sine first"),
    (
        "pendulum_reward",
        lambda o, u: -(np.arctan(o[1] / o[0]) ** 2 + 0.1 * o[2] ** 2 + 0.001 * u**2),
        "not distinguish",
    ),
    ("pendulum_reward", lambda o, u: -(np.arcsin(o[1]) ** 2 + 0.1 * o[2] ** 2 + 0.001 * u**2), "not distinguish"),
    ("pendulum_reward", lambda o, u: -(np.arctan2(o[1], o[0]) ** 2 + o[2] ** 2 + u**2), "0.1 and 0.001"),
    ("discrete_actor_loss", lambda *given: -discrete_actor_loss(*given), "look for the worst"),
    ("discrete_actor_loss", lambda x, v: -jnp.mean(jax.nn.softmax(x, axis=1) * v), "sum over the actions"),
    ("discrete_actor_loss", lambda x, v: -jnp.mean(jnp.sum(x * v, axis=1)), "softmax"),
    ("discrete_actor_loss", lambda x, v: -jnp.mean(v[jnp.arange(2), x.argmax(axis=1)]), "argmax"),
    ("discrete_actor_loss", lambda x, v: -jnp.mean(v), "logits do not appear"),
]
