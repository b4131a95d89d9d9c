"""Reference implementation of networks, gradients and Adam in float64 NumPy, independent of JAX."""

from collections.abc import Callable
from typing import Any

import numpy as np

Layers = list[list[np.ndarray]]
"""Weight ``(n_inputs, n_outputs)`` and bias of each layer."""


def layers(network: Any, index: Any = ...) -> Layers:
    """Copies the weights of a network, or of its optimizer's moments; ``index`` selects a member of an ensemble."""
    parts = [*network.torso.layers, network.head]
    return [[np.array(np.float64(layer.weight)[index]), np.array(np.float64(layer.bias)[index])] for layer in parts]


def forward(network: Layers, x: Any) -> np.ndarray:
    """Returns the output of layers with ReLU between them, ``(batch, n_outputs)``."""
    x = np.float64(x)
    for weight, bias in network[:-1]:
        x = np.maximum(x @ weight + bias, 0.0)
    return x @ network[-1][0] + network[-1][1]


def softmax(logits: np.ndarray) -> np.ndarray:
    """Returns probabilities, ``(batch, n)``."""
    powers = np.exp(logits - logits.max(axis=1, keepdims=True))
    return powers / powers.sum(axis=1, keepdims=True)


def ensemble(networks: Any) -> list[Layers]:
    """Copies the weights of each member of an ensemble."""
    return [layers(networks, i) for i in range(networks.head.bias.shape[0])]


def action_value(critic: Layers, obs: Any, action: Any) -> np.ndarray:
    """Returns the values of observations with actions, ``(batch,)``."""
    return forward(critic, np.concatenate([np.float64(obs), np.float64(action)], axis=1))[:, 0]


def squashed_sample(outputs: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns ``tanh(mean + std * noise)`` and its log-density; ``outputs`` are the means and the ``log std``.

    The density is the Gaussian's minus ``log |da/du|`` with ``da/du = 1 - a^2``.
    """
    mean, log_std = np.split(outputs, 2, axis=1)
    log_std = np.clip(log_std, -20.0, 2.0)
    action = np.tanh(mean + np.exp(log_std) * noise)
    gaussian = -0.5 * noise**2 - log_std - 0.5 * np.log(2 * np.pi)
    return action, (gaussian - np.log(1.0 - action**2)).sum(axis=1)


def gradient(network: Layers, loss: Callable[[], float], width: float = 1e-6) -> Layers:
    """Returns the gradient of ``loss()``, a function of ``network``, by central differences."""
    slopes = [[np.zeros_like(array) for array in layer] for layer in network]
    for layer, slope in zip(network, slopes, strict=True):
        for array, along in zip(layer, slope, strict=True):
            for i in np.ndindex(array.shape):
                original = array[i]
                array[i] = original + width
                above = loss()
                array[i] = original - width
                along[i] = (above - loss()) / (2.0 * width)
                array[i] = original
    return slopes


class Adam:
    """Adam (Kingma and Ba 2015, algorithm 1), which updates ``network`` in place."""

    def __init__(self, network: Layers, rate: float, b1: float = 0.9, b2: float = 0.999, eps: float = 1e-8) -> None:
        self.network, self.rate, self.b1, self.b2, self.eps = network, rate, b1, b2, eps
        self.first, self.second = ([[np.zeros_like(array) for array in layer] for layer in network] for _ in range(2))
        self.t = 0

    def step(self, slopes: Layers) -> None:
        """Takes one step against the gradients ``slopes``."""
        self.t += 1
        for layer, slope, m, v in zip(self.network, slopes, self.first, self.second, strict=True):
            for i, g in enumerate(slope):
                m[i] = self.b1 * m[i] + (1.0 - self.b1) * g
                v[i] = self.b2 * v[i] + (1.0 - self.b2) * g**2
                corrected = m[i] / (1.0 - self.b1**self.t), v[i] / (1.0 - self.b2**self.t)
                layer[i][...] = layer[i] - self.rate * corrected[0] / (np.sqrt(corrected[1]) + self.eps)

    def descend(self, loss: Callable[[], float]) -> None:
        """Takes one step against the gradient of ``loss()``, a function of the network."""
        self.step(gradient(self.network, loss))


def follow(target: Layers, online: Layers, tau: float) -> None:
    """Moves ``target`` toward ``online`` by the fraction ``tau``, in place."""
    for target_layer, online_layer in zip(target, online, strict=True):
        for t, o in zip(target_layer, online_layer, strict=True):
            t[...] = (1.0 - tau) * t + tau * o


def assert_equal_layers(actual: Layers, expected: Layers, label: str, atol: float = 2e-5, rtol: float = 0.0) -> None:
    """Asserts that all weights and biases agree."""
    for i, (layer, expected_layer) in enumerate(zip(actual, expected, strict=True)):
        for field, a, b in zip(("weight", "bias"), layer, expected_layer, strict=True):
            np.testing.assert_allclose(a, b, atol=atol, rtol=rtol, err_msg=f"{label}: {field} {i}")


def largest_difference(first: Layers, second: Layers) -> float:
    """Returns the maximum absolute difference of corresponding values."""
    pairs = zip(first, second, strict=True)
    return max(float(np.abs(a - b).max()) for p, q in pairs for a, b in zip(p, q, strict=True))
