"""Checks of course 2: actor and critic in a box."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rejeu.courses.checks.base import call, close, diagnose, exercise, mistakes, numbers

SHAPES = {"state": (2, 4), "action": (1, 4), "common": (8, 5)}
"""Inputs and outputs of the layers of a small critic. Both branches have as many outputs, so that their order shows."""


@exercise
def ball_step(student: Any) -> None:
    """Checks ``ball_step(position, push, kick)``."""
    position = np.array([[1.0, -2.0], [9.5, 0.0], [0.0, -9.0], [11.0, 0.0]])
    push = np.array([[0.5, 1.0], [1.0, 0.0], [0.0, -2.0], [-2.0, 0.0]])
    kick = np.array([[-0.2, 0.1], [0.25, 0.0], [0.0, -0.5], [0.0, 0.0]])
    after, results = position + push + kick, [call(student, *case) for case in zip(position, push, kick, strict=True)]
    mistakes(three_values=not all(isinstance(result, tuple | list) and len(result) == 3 for result in results))
    diagnose(
        np.stack([numbers(result[0], (2,)) for result in results]),
        after,
        no_kick=position + push,
        no_push=position + kick,
        kick_reversed=after - 2 * kick,
    )
    lost = (abs(after) > 10).any(axis=1)
    diagnose(
        np.stack([numbers(result[2], ()) for result in results]),
        lost,
        too_late=(abs(position) > 10).any(axis=1),
        all_coordinates=(abs(after) > 10).all(axis=1),
        negative_side=(after > 10).any(axis=1),
        reversed=~lost,
    )
    mistakes(reward=not close([numbers(result[1], ()) for result in results], np.where(lost, -10.0, 1.0)))


@exercise
def td_targets(student: Any) -> None:
    """Checks ``td_targets(reward, terminated, next_value, gamma)``."""
    reward, next_value, gamma = np.array([1.0, 1.0, -10.0]), np.array([4.0, -2.0, 7.0]), 0.9
    terminated = np.array([False, False, True])
    left = 1.0 - terminated
    diagnose(
        numbers(call(student, reward, terminated, next_value, gamma), (3,)),
        reward + gamma * left * next_value,
        future_after_end=reward + gamma * next_value,
        only_after_end=reward + gamma * terminated * next_value,
        lost_reward=left * (reward + gamma * next_value),
        no_gamma=reward + left * next_value,
        reward_discounted=gamma * (reward + left * next_value),
    )


@exercise
def td_error(student: Any) -> None:
    """Checks ``td_error(value, target)``."""
    value, target = np.array([2.0, 0.5, -1.0]), np.array([3.0, -0.5, -1.5])
    diagnose(
        numbers(call(student, value, target), (3,)),
        target - value,
        reversed=value - target,
        absolute=abs(target - value),
        squared=(target - value) ** 2,
    )


def _relu(layers: list[tuple[np.ndarray, np.ndarray]], x: np.ndarray) -> np.ndarray:
    for weight, bias in layers:
        x = np.maximum(x @ weight + bias, 0.0)
    return x


@exercise
def critic(student: Any) -> None:
    """Checks ``critic(layers, state, action)``."""
    rng = np.random.default_rng(0)
    layers: dict[str, Any] = {
        name: [(rng.normal(size=shape), rng.normal(size=shape[1]))] for name, shape in SHAPES.items()
    }
    layers["output"] = rng.normal(size=(5, 1)), np.array([-1.0])
    state, action = rng.normal(size=(6, 2)), rng.normal(size=(6, 1))
    (weight, bias), s, a = layers["output"], _relu(layers["state"], state), _relu(layers["action"], action)
    joined = _relu(layers["common"], np.concatenate([s, a], axis=1))
    swapped = _relu(layers["common"], np.concatenate([a, s], axis=1))
    diagnose(
        numbers(call(student, layers, state, action), (6, 1)),
        joined @ weight + bias,
        relu_at_end=np.maximum(joined @ weight + bias, 0.0),
        action_first=swapped @ weight + bias,
        no_bias=joined @ weight,
    )


@exercise
def bounded(student: Any) -> None:
    """Checks ``bounded(output, low, high)``."""
    output, low, high = np.array([[-20.0, 0.0], [0.5, 20.0]]), np.array([-1.0, 0.0]), np.array([3.0, 2.0])
    middle, half = (low + high) / 2, (high - low) / 2
    result = numbers(call(student, output, low, high), (2, 2))
    diagnose(
        result,
        middle + half * np.tanh(output),
        clipped=np.clip(output, low, high),
        zero_in_middle=high * np.tanh(output),
        too_wide=middle + 2 * half * np.tanh(output),
        sigmoid=low + 2 * half * np.tanh(output),
        swapped=middle - half * np.tanh(output),
    )


def _value(state: np.ndarray, action: np.ndarray) -> np.ndarray:
    """A critic ``(n, 1)`` whose values rise with the action."""
    return state[:, :1] + 2.0 * action


def _policy(state: np.ndarray) -> np.ndarray:
    return 0.5 * state[:, 1:]


@exercise
def critic_loss(student: Any) -> None:
    """Checks ``critic_loss(q, state, action, target)``."""
    state, action = np.array([[1.0, 0.0], [-1.0, 2.0], [0.5, 1.0]]), np.array([[0.5], [-0.5], [0.25]])
    target = np.array([1.0, -1.5, 3.0])
    error = _value(state, action)[:, 0] - target
    crossed = _value(state, action) - target
    diagnose(
        numbers(call(student, _value, state, action, target), ()),
        (error**2).mean(),
        broadcast=(crossed**2).mean(),
        sum=(error**2).sum(),
        not_squared=error.mean(),
        not_squared_reversed=-error.mean(),
        reversed=-(error**2).mean(),
    )


@exercise
def actor_loss(student: Any) -> None:
    """Checks ``actor_loss(mu, q, state)``."""
    state = np.array([[1.0, 0.5], [-1.0, 2.0], [0.5, 1.0]])
    values = _value(state, _policy(state))[:, 0]
    diagnose(
        numbers(call(student, _policy, _value, state), ()),
        -values.mean(),
        reversed=values.mean(),
        sum=-values.sum(),
        squared=-(values**2).mean(),
        no_critic=-_policy(state).mean(),
    )


@exercise
def soft_update(student: Any) -> None:
    """Checks ``soft_update(target, online, tau)``."""
    target, online, tau = np.array([1.0, -2.0]), np.array([3.0, 4.0]), 0.1
    result = call(student, {"weight": target, "bias": [target * 2]}, {"weight": online, "bias": [online * 2]}, tau)
    mistakes(not_a_tree=not isinstance(result, dict) or result.keys() != {"weight", "bias"})
    diagnose(
        numbers(result["weight"], (2,)),
        (1 - tau) * target + tau * online,
        swapped=tau * target + (1 - tau) * online,
        copied=online,
        grows=target + tau * online,
        away=target - tau * (online - target),
    )


@exercise
def ou_step(student: Any) -> None:
    """Checks ``ou_step(x, normal, theta, sigma, dt)``."""
    x, normal, theta, sigma, dt = np.array([2.0, -1.0, 0.0]), np.array([0.0, 1.0, -2.0]), 0.5, 0.3, 0.04
    drift, kick = -theta * x * dt, sigma * math.sqrt(dt) * normal
    diagnose(
        numbers(call(student, x, normal, theta, sigma, dt), (3,)),
        x + drift + kick,
        drift_reversed=x - drift + kick,
        dt_without_root=x + drift + sigma * dt * normal,
        kick_without_dt=x + drift + sigma * normal,
        drift_without_dt=x - theta * x + kick,
        no_noise=x + drift,
        change_only=drift + kick,
        drift_without_x=x - theta * dt + kick,
    )


@exercise
def barrier_slope(student: Any) -> None:
    """Checks ``barrier_slope(u, low, high)``."""
    u, low, high = np.array([-2.0, 0.5, 3.5]), -1.0, 3.0
    half, scaled = 2.0, math.pi / 2 * (np.array([-2.0, 0.5, 3.5]) - 1.0) / 2.0
    right = 6 * scaled**5 * math.pi / (2 * half)
    diagnose(
        numbers(call(student, u, low, high), (3,)),
        right,
        no_inner_derivative=6 * scaled**5,
        half_width_of_one=6 * scaled**5 * math.pi / 2,
        negative=-right,
        absolute=abs(right),
        barrier_itself=scaled**6,
        middle=6 * (math.pi / 2 * u / half) ** 5 * math.pi / (2 * half),
    )


@exercise
def repel(student: Any) -> None:
    """Checks ``repel(action, x, strength, low, high)``."""
    action, x = np.array([2.6, 2.9, 2.0, -0.9]), np.array([1.0, 0.12, 0.9, -0.6])
    strength, low, high = 2e-3, -1.0, 3.0
    u = action + x

    def push(v: np.ndarray) -> np.ndarray:
        return strength * 6 * (math.pi / 4 * (v - 1.0)) ** 5 * math.pi / 4

    result = call(student, action, x, strength, low, high)
    mistakes(two_values=not isinstance(result, tuple | list) or len(result) != 2)
    taken, after = numbers(result[0], (4,)), numbers(result[1], (4,))
    right = np.clip(u - push(u), low, high)
    mistakes(swapped=close(taken, x - push(u)) and close(after, right))
    diagnose(
        taken,
        right,
        pushed_out=np.clip(u + push(u), low, high),
        not_clipped=u - push(u),
        clipped_first=np.clip(u, low, high) - push(np.clip(u, low, high)),
        only_clipped=np.clip(u, low, high),
    )
    diagnose(
        after,
        x - push(u),
        process_not_pushed=x,
        process_pushed_out=x + push(u),
        process_clipped=right - action,
    )


@exercise
def pendulum_reward(student: Any) -> None:
    """Checks ``pendulum_reward(observation, torque)``."""
    angle, speed, torque = 2.5, -3.0, 1.5
    observation = np.array([math.cos(angle), math.sin(angle), speed])
    rest = 0.1 * speed**2 + 0.001 * torque**2
    diagnose(
        numbers(call(student, observation, torque), ()),
        -(angle**2 + rest),
        reversed=angle**2 + rest,
        sine_first=-((math.pi / 2 - angle) ** 2 + rest),
        arctan=-(math.atan(math.tan(angle)) ** 2 + rest),
        no_factors=-(angle**2 + speed**2 + torque**2),
    )


@exercise
def discrete_actor_loss(student: Any) -> None:
    """Checks ``discrete_actor_loss(logits, values)``."""
    logits, values = np.array([[0.0, 1.0, -1.0], [2.0, 0.0, 0.5]]), np.array([[1.0, -2.0, 3.0], [0.5, 4.0, -1.0]])
    probabilities = np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)
    right = -(probabilities * values).sum(axis=1).mean()
    diagnose(
        numbers(call(student, logits, values), ()),
        right,
        reversed=-right,
        mean_of_actions=-(probabilities * values).mean(),
        logits_as_weights=-(logits * values).sum(axis=1).mean(),
        argmax=-values[np.arange(2), logits.argmax(axis=1)].mean(),
        no_logits=-values.mean(axis=1).mean(),
    )
