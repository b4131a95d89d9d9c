"""Compares every setting that is ported under the original's name with the same setting of the original.

    python trials/ported_settings.py --peer PYTHON

PYTHON is an interpreter with stable-baselines3 and sb3-contrib. The same small programs run in both libraries, one process each;
updates of agents begin with the original's weights, with the mean in place of samples and with all rows of replay as a batch. The
signatures of the original's public classes and functions say which settings there are. Writes
``trials/results/ported_settings.json``. ``--only WORD ...`` runs the cases whose names contain a word and prints them.
"""

from __future__ import annotations

# ruff: noqa: E501, NPY002, B007, PERF401
import argparse
import contextlib
import copy
import importlib
import inspect
import io
import json
import math
import os
import pkgutil
import subprocess
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import gymnasium as gym
import numpy as np
from provenance import commit, provenance, write

RESULTS = Path(__file__).parent / "results" / "ported_settings.json"
TOLERANCE = 2e-4
"""Of numbers, relative to those above 1."""
PACKAGES = {"stable_baselines3": "rejeu.sb3", "sb3_contrib": "rejeu.sb3_contrib"}
TOLERANCES: dict[str, float] = {}
CASES: dict[str, tuple[str, Callable[[Any], Any]]] = {}
"""By name: the settings that a case compares, and the program."""


def case(settings: str, tolerance: float = TOLERANCE) -> Callable[[Callable[[Any], Any]], Callable[[Any], Any]]:
    """Returns a decorator that adds a program; ``settings`` are ``Class.argument``, ``Class.a,b`` for several."""

    def add(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
        CASES[function.__name__] = settings, function
        TOLERANCES[function.__name__] = tolerance
        return function

    return add


class Library:
    """One of the two libraries. ``lib("common.callbacks", "EvalCallback")`` is the name in its module."""

    def __init__(self, name: str, folder: Path) -> None:
        self.name, self.folder, self.is_original = name, folder, name == "original"
        self.case = ""

    def __call__(self, module: str, *names: str) -> Any:
        package = "sb3_contrib" if module.startswith("contrib.") else "stable_baselines3"
        path = f"{package if self.is_original else PACKAGES[package]}.{module.removeprefix('contrib.')}"
        attributes = [getattr(importlib.import_module(path.rstrip(".")), name) for name in names]
        return attributes[0] if len(attributes) == 1 else attributes

    def algorithm(self, name: str) -> Any:
        core_algorithms = ("A2C", "DDPG", "DQN", "PPO", "SAC", "TD3")
        return self("" if name in core_algorithms else "contrib.", name)

    def tensor(self, array: Any) -> Any:
        if not self.is_original:
            return np.asarray(array)
        import torch

        return torch.as_tensor(array)

    def make(self, name: str, policy: Any, env: Any, key: str = "", **settings: Any) -> Any:
        """Returns an agent that has the weights of the original's first one of the same shape."""
        model = self.algorithm(name)(policy, env, device="cpu", seed=0, **settings)
        path = self.folder / f"{self.case}{key}.zip"
        if self.is_original:
            model.save(path)
        else:
            loaded = self.algorithm(name).load(path, device="cpu")
            parameters = model.get_parameters()
            saved = loaded.get_parameters()
            for group, arrays in parameters.items():
                for field, array in arrays.items():
                    if field in saved.get(group, {}) and saved[group][field].shape == array.shape:
                        arrays[field] = saved[group][field]
            model.set_parameters(parameters)
        return model


class Line(gym.Env):
    """Observations and rewards that do not depend on the actions: ``length`` steps, then a terminal state or a time limit."""

    def __init__(
        self,
        action_space: gym.Space,
        length: int = 5,
        truncates: bool = False,
        varies: bool = False,
        scale: float = 1.0,
    ) -> None:
        self.observation_space = gym.spaces.Box(-2.0, 2.0, (3,), np.float32)
        self.action_space, self.length, self.truncates, self.scale = action_space, length, truncates, scale
        self.varies = varies
        self.t, self.episode, self.actions = 0, 0, []

    def look(self) -> np.ndarray:
        return np.sin(np.array([1.0, 2.0, 3.0]) * (self.t + 1) + 0.3 * self.episode).astype(np.float32)

    def reset(self, **options: Any) -> Any:
        super().reset(**options)
        self.t, self.episode = 0, self.episode + 1
        return self.look(), {}

    def action_masks(self) -> np.ndarray:
        return np.arange(3) != self.t % 4

    def step(self, action: Any) -> Any:
        self.actions.append(np.array(action).tolist())
        self.t += 1
        over = self.t >= self.length + (self.episode % 3 if self.varies else 0)
        reward = self.scale * math.cos(1.7 * self.t + self.episode)
        return self.look(), reward, over and not self.truncates, over and self.truncates, {}


BOX = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
LOOKS = np.stack([np.sin(np.arange(1, 4) * x) for x in np.linspace(0.3, 4.0, 6)]).astype(np.float32)
"""Observations at which agents are compared."""


SHARE = 0.5
"""What every standard normal number is in :func:`constant_noise`."""


@contextlib.contextmanager
def constant_noise(lib: Library) -> Iterator[None]:
    """Context in which every standard normal number is ``SHARE``, and of Discrete actions the likeliest is taken."""
    with contextlib.ExitStack() as stack:
        if lib.is_original:
            import torch
            from torch.distributions import Categorical, Normal

            def filled(self: Any, mean: float = 0.0, std: float = 1.0) -> Any:
                return self.fill_(mean + SHARE * std)

            def likeliest(self: Any, shape: Any = ()) -> Any:
                return self.probs.argmax(-1)

            def shifted(self: Any, shape: Any = ()) -> Any:
                return self.mean + SHARE * self.stddev

            def zeros(x: Any, **_: Any) -> Any:
                return torch.zeros_like(x)

            from stable_baselines3.common.distributions import StateDependentNoiseDistribution as OfStates

            original_sample = OfStates.sample

            def by_state(self: Any) -> Any:
                """One noise for each state of a batch, instead of one matrix for all of them: equal for each alone."""
                if self.distribution.mean.shape[0] == 1:
                    return original_sample(self)
                drawn = self.distribution.mean + SHARE * self.distribution.stddev
                return drawn if self.bijector is None else self.bijector.forward(drawn)

            drawn_numbers = np.random.randint

            def first(*limits: Any, **options: Any) -> Any:  # of RecurrentPPO's batches the first step is the rollout's
                return drawn_numbers(*limits, **options) if options else 0

            stack.enter_context(mock.patch.object(np.random, "randint", first))
            for owner, name, value in (
                (OfStates, "sample", by_state),
                (Categorical, "sample", likeliest),
                (Normal, "sample", shifted),
                (Normal, "rsample", shifted),
                (torch.Tensor, "normal_", filled),
                (torch, "randn_like", zeros),
            ):
                stack.enter_context(mock.patch.object(owner, name, value))
        else:
            import jax
            import jax.numpy as jnp

            def constant(value: float) -> Callable[..., Any]:
                return lambda key, shape=(), dtype=jnp.float32: jnp.full(shape, value, dtype)

            stack.enter_context(mock.patch.object(jax.random, "normal", constant(SHARE)))
            stack.enter_context(mock.patch.object(jax.random, "gumbel", constant(0.0)))
        yield


def whole_batches(lib: Library, model: Any) -> None:
    """Lets an off-policy agent draw all rows that it has as each batch."""
    if lib.is_original:
        buffer = model.replay_buffer

        def sample(batch_size: int, env: Any = None) -> Any:
            return buffer._get_samples(np.resize(np.arange(buffer.size()), batch_size), env)

        buffer.sample = sample
    else:
        ring = model.run.replay.ring

        def draw(rng: Any, n: int) -> Any:
            begins = ring.oldest()
            env = np.repeat(np.arange(ring.n_envs), ring.head - begins)
            time = np.concatenate([np.arange(*ends) for ends in zip(begins, ring.head, strict=True)])
            steps = np.flatnonzero(ring.at(env, time).kind != LAST)
            repeated = np.resize(steps, n)
            return ring.at(env[repeated], time[repeated])

        ring.draw = draw


LAST = 2
"""The kind of rows of replay that hold final observations."""


def learned(lib: Library, name: str, space: gym.Space, total: int, settings: dict[str, Any]) -> Any:
    """Returns the outputs of an agent after ``total`` steps in ``Line``, from the original's weights."""
    settings = copy.deepcopy(settings)  # the original adds to policy_kwargs
    shape = settings.get("policy_kwargs", {})
    if lib.is_original and "activation_fn" in shape:
        import torch

        shape["activation_fn"] = getattr(torch.nn, shape["activation_fn"])
    of_line = {key: settings.pop(key) for key in ("length", "truncates", "varies") if key in settings}
    lines = [Line(space, **of_line) for _ in range(settings.pop("n_envs", 1))]
    env = lib("common.vec_env", "DummyVecEnv")([partial(lambda line: line, line) for line in lines])
    is_off = name in ("DQN", "QRDQN", "SAC", "TD3", "DDPG", "TQC", "CrossQ")
    if is_off and not lib.is_original:
        settings["overlap"] = False
    model = lib.make(name, "MlpLstmPolicy" if name == "RecurrentPPO" else "MlpPolicy", env, **settings)
    if is_off:
        whole_batches(lib, model)
    with constant_noise(lib):
        model.learn(total)
    return says(lib, name, model, space)


def says(lib: Library, name: str, model: Any, space: gym.Space) -> list[float]:
    """Returns actions, values and log-probabilities of an agent at ``LOOKS``."""
    numbers = [np.asarray(model.predict(LOOKS, deterministic=True)[0], float)]
    looks, is_box = lib.tensor(LOOKS), isinstance(space, gym.spaces.Box)
    action = np.full((len(LOOKS), 2), 0.25, np.float32) if is_box else np.arange(len(LOOKS)) % 3
    if name in ("PPO", "A2C", "TRPO", "MaskablePPO"):
        numbers += [plain(tensor) for tensor in model.policy.evaluate_actions(looks, lib.tensor(action))[:2]]
    elif name in ("DQN", "QRDQN"):
        if lib.is_original:
            net = model.policy.q_net if name == "DQN" else model.policy.quantile_net
            values = plain(net(looks))
            numbers.append(values if name == "DQN" else values.mean(axis=1))
        else:
            numbers.append(model.q_values(LOOKS))
    elif is_box and name not in ("ARS", "RecurrentPPO"):
        if lib.is_original:
            model.policy.set_training_mode(False)
            q_values = model.critic(looks, lib.tensor(action))
            values = plain(q_values).mean(axis=2).T if name == "TQC" else np.stack([plain(q)[:, 0] for q in q_values])
        else:
            values = model.q_values(LOOKS, action, critics="all")
        numbers.append(values)
    return np.concatenate([np.ravel(array) for array in numbers]).tolist()


def plain(value: Any) -> np.ndarray:
    """Returns a tensor of either library as an array."""
    return np.asarray(value.detach() if hasattr(value, "detach") else value, float)


THREE = gym.spaces.Discrete(3)
ROLLOUT = {"n_steps": 16, "learning_rate": 0.01}
EPOCHS = {**ROLLOUT, "batch_size": 16, "n_epochs": 4, "normalize_advantage": False}
REPLAY = {"learning_starts": 0, "train_freq": 20, "gradient_steps": 4, "batch_size": 40, "buffer_size": 500}
REPLAY |= {"learning_rate": 0.01}
SMALL = {"policy_kwargs": {"net_arch": [16]}}


def half(progress: float) -> float:
    """A schedule."""
    return 0.01 * progress


COMMON = {"learning_rate": [0.003, half], "gamma": [0.8]}
ROLLOUTS = {**COMMON, "n_steps": [8], "gae_lambda": [0.5], "truncates": [True], "n_envs": [2]}
PPO_LIKE = {
    **ROLLOUTS,
    "n_epochs": [2],
    "clip_range": [0.02, half],
    "clip_range_vf": [0.01],
    "normalize_advantage": [True],
    "ent_coef": [0.2],
    "vf_coef": [0.05],
    "max_grad_norm": [0.05],
    "target_kl": [1e-4],
}
REPLAYS = {
    **COMMON,
    "batch_size": [120],
    "n_steps": [3],
    "gradient_steps": [2, -1],
    "train_freq": [10, (4, "episode")],
    "truncates": [True],
}
CRITICS = {"tau": [0.3], "policy_kwargs": [{"net_arch": {"pi": [8], "qf": [16, 8]}}, {"net_arch": [8], "n_critics": 3}]}
KWARGS = [{"net_arch": [8, 8]}, {"net_arch": [8], "optimizer_kwargs": {"eps": 0.1}}]
UPDATES: list[tuple[str, gym.Space, int, dict[str, Any], dict[str, list[Any]]]] = [
    ("PPO", THREE, 32, {**SMALL, **EPOCHS}, {**PPO_LIKE, "policy_kwargs": KWARGS}),
    (
        "PPO",
        BOX,
        32,
        {**SMALL, **EPOCHS},
        {
            "ent_coef": [0.2],
            "use_sde": [True],
            "clip_range": [0.02],
            "policy_kwargs": [
                {"net_arch": [8], "log_std_init": -1.0},
                {"net_arch": {"pi": [8], "vf": [16, 8]}},
                {"net_arch": [8], "activation_fn": "ReLU", "ortho_init": False, "share_features_extractor": True},
                {"net_arch": [8], "use_expln": True, "log_std_init": 0.3, "use_sde": True},
                {"net_arch": [8], "squash_output": True, "use_sde": True},
            ],
        },
    ),
    (
        "A2C",
        THREE,
        32,
        {**SMALL, **ROLLOUT},
        {
            **ROLLOUTS,
            "ent_coef": [0.2],
            "vf_coef": [0.05],
            "max_grad_norm": [0.05],
            "rms_prop_eps": [0.1],
            "use_rms_prop": [False],
            "normalize_advantage": [True],
        },
    ),
    (
        "TRPO",
        THREE,
        32,
        {**SMALL, **ROLLOUT, "batch_size": 16},
        {
            **ROLLOUTS,
            "cg_max_steps": [2],
            "cg_damping": [5.0],
            "line_search_shrinking_factor": [0.5],
            "line_search_max_iter": [1],
            "n_critic_updates": [2],
            "normalize_advantage": [False],
            "target_kl": [0.001],
            "sub_sampling_factor": [2],
        },
    ),
    ("TRPO", BOX, 16, {**SMALL, **ROLLOUT, "batch_size": 16}, {"target_kl": [0.001]}),
    (
        "RecurrentPPO",
        BOX,
        32,
        {"policy_kwargs": {"net_arch": [16], "lstm_hidden_size": 8}, **EPOCHS},
        {
            **{
                key: PPO_LIKE[key]
                for key in ("learning_rate", "gamma", "n_steps", "gae_lambda", "n_epochs", "ent_coef")
            },
            **{key: PPO_LIKE[key] for key in ("clip_range", "normalize_advantage", "vf_coef", "max_grad_norm")},
            "policy_kwargs": [
                {"net_arch": [8], "lstm_hidden_size": 4},
                {"net_arch": [8], "lstm_hidden_size": 4, "shared_lstm": True, "enable_critic_lstm": False},
                {"net_arch": [8], "lstm_hidden_size": 4, "enable_critic_lstm": False},
            ],
        },
    ),
    ("MaskablePPO", THREE, 32, {**SMALL, **EPOCHS}, PPO_LIKE),
    (
        "DQN",
        THREE,
        40,
        {**SMALL, **REPLAY, "exploration_initial_eps": 0.0, "exploration_final_eps": 0.0},
        {
            **REPLAYS,
            "max_grad_norm": [0.01],
            "target_update_interval": [15],
            "tau": [0.3],
            "policy_kwargs": KWARGS,
        },
    ),
    (
        "QRDQN",
        THREE,
        40,
        {
            **REPLAY,
            "policy_kwargs": {"net_arch": [16], "n_quantiles": 7},
            "exploration_initial_eps": 0.0,
            "exploration_final_eps": 0.0,
        },
        {
            **REPLAYS,
            "max_grad_norm": [0.01],
            "target_update_interval": [15],
            "tau": [0.3],
            "policy_kwargs": [{"net_arch": [16], "n_quantiles": 5}],
        },
    ),
    (
        "TD3",
        BOX,
        40,
        {**SMALL, **REPLAY},
        {
            **REPLAYS,
            **CRITICS,
            "policy_delay": [1, 3],
            "target_policy_noise": [0.6],
            "target_noise_clip": [0.02],
        },
    ),
    ("DDPG", BOX, 40, {**SMALL, **REPLAY}, {**REPLAYS, "tau": [0.3], "policy_kwargs": CRITICS["policy_kwargs"][:1]}),
    (
        "SAC",
        BOX,
        40,
        {**SMALL, **REPLAY},
        {
            **REPLAYS,
            **CRITICS,
            "ent_coef": [0.5, "auto_0.2"],
            "target_entropy": [-5.0],
            "target_update_interval": [2],
            "use_sde": [True],
            "policy_kwargs": [
                *CRITICS["policy_kwargs"],
                {"net_arch": [8], "log_std_init": -1.0, "use_sde": True},
                {"net_arch": [8], "optimizer_kwargs": {"eps": 0.1}},
                {"net_arch": [8], "activation_fn": "Tanh"},
                {"net_arch": [8], "use_expln": True, "log_std_init": 0.3, "use_sde": True},
            ],
        },
    ),
    (
        "TQC",
        BOX,
        40,
        {**SMALL, **REPLAY},
        {
            **REPLAYS,
            "tau": [0.3],
            "ent_coef": [0.5],
            "target_entropy": [-5.0],
            "use_sde": [True],
            "top_quantiles_to_drop_per_net": [0, 5],
            "policy_kwargs": [{"net_arch": [8], "n_critics": 3}, {"net_arch": [8], "n_quantiles": 7}],
        },
    ),
    (
        "CrossQ",
        BOX,
        40,
        {"policy_kwargs": {"net_arch": [16]}, **REPLAY},
        {
            **COMMON,
            **{"n_steps": [3], "ent_coef": [0.5], "target_entropy": [-5.0], "policy_delay": [1], "train_freq": [10]},
            "use_sde": [True],
        },
    ),
]
"""Algorithm, space of the actions, steps, settings, and for each further setting the values that replace those."""


def update_cases() -> None:
    """Adds a case for each value of each setting of ``UPDATES``."""
    for name, space, total, base, variants in UPDATES:
        space_name = "Box" if isinstance(space, gym.spaces.Box) else "Discrete"
        values_by_setting = {"": [None], **variants}
        for setting, values in values_by_setting.items():
            for i, value in enumerate(values):
                settings = base if setting == "" else {**base, setting: value}
                if setting == "n_steps" and "batch_size" in base and name not in OFF:
                    settings = {**settings, "batch_size": value}
                if setting == "train_freq":
                    settings = {**settings, "batch_size": 120}  # a multiple of all numbers of rows: each counts as much
                if setting == "n_envs" and "batch_size" in base:
                    settings = {**settings, "batch_size": 32}
                if setting == "policy_kwargs" and value.get("use_sde"):
                    settings = {
                        **settings,
                        "use_sde": True,
                        "policy_kwargs": {k: v for k, v in value.items() if k != "use_sde"},
                    }
                case_name = f"{name}_{space_name}{'_' * bool(setting)}{setting}{i or ''}"
                inside = f",policy_kwargs.{','.join(value)}" if setting == "policy_kwargs" else ""
                CASES[case_name] = (
                    f"{name}.{setting or '(base)'}{inside}",
                    partial(run_update, name, space, total, settings),
                )


OFF = ("DQN", "QRDQN", "SAC", "TD3", "DDPG", "TQC", "CrossQ")


def run_update(name: str, space: gym.Space, total: int, settings: dict[str, Any], lib: Library) -> Any:
    return learned(lib, name, space, total, settings)


def vec(lib: Library, *envs: gym.Env, monitored: bool = False) -> Any:
    """Returns a ``DummyVecEnv`` of environments."""
    wrap = lib("common.monitor", "Monitor") if monitored else (lambda env: env)
    return lib("common.vec_env", "DummyVecEnv")([partial(lambda env: env, wrap(env)) for env in envs])


def small(lib: Library, env: Any, name: str = "A2C", **settings: Any) -> Any:
    """Returns an agent that learns quickly."""
    agent_settings = copy.deepcopy({"policy_kwargs": {"net_arch": [8]}, "seed": 0, **settings})
    return lib.algorithm(name)("MlpPolicy", env, device="cpu", **agent_settings)


def noted(lib: Library, note: Callable[[Any], Any]) -> tuple[Any, list[Any]]:
    """Returns a callback and the list of what ``note`` returned of it at every step."""
    notes: list[Any] = []

    class Noting(lib("common.callbacks", "BaseCallback")):  # type: ignore[misc]
        def _on_step(self) -> bool:
            notes.append(note(self))
            return True

    return Noting(), notes


def stepped(env: Any, n: int, action: Any) -> list[Any]:
    """Returns observations, rewards and ends of a vector environment."""
    results = [np.asarray(env.reset()).tolist()]
    for _ in range(n):
        obs, reward, done, _ = env.step(action)
        results += [obs.tolist(), np.asarray(reward, float).tolist(), np.asarray(done).tolist()]
    return results


@case("NormalActionNoise.mean,sigma,dtype", 0.03)
def normal_noise(lib: Library) -> Any:
    np.random.seed(0)
    noise = lib("common.noise", "NormalActionNoise")(np.array([0.3, -0.2]), np.array([0.1, 0.4]))
    drawn = np.array([noise() for _ in range(4000)])
    return [drawn.mean(axis=0), drawn.std(axis=0), str(noise().dtype)]


@case("OrnsteinUhlenbeckActionNoise.mean,theta,dt,initial_noise")
def ornstein_uhlenbeck_path(lib: Library) -> Any:
    noise_class = lib("common.noise", "OrnsteinUhlenbeckActionNoise")
    noise = noise_class(np.array([0.5]), np.array([0.0]), theta=0.3, dt=0.1, initial_noise=np.array([0.2]))
    path = [noise().tolist() for _ in range(5)]
    noise.reset()
    default_noise = noise_class(np.array([0.5]), np.array([0.0]))
    return [path, noise(), [default_noise().tolist() for _ in range(3)]]


@case("OrnsteinUhlenbeckActionNoise.sigma", 0.05)
def ornstein_uhlenbeck_spread(lib: Library) -> Any:
    np.random.seed(0)
    noise = lib("common.noise", "OrnsteinUhlenbeckActionNoise")(np.zeros(1), np.array([0.8]), theta=1.0, dt=0.25)
    path = np.array([noise()[0] for _ in range(20000)])
    return [path.std(), np.corrcoef(path[1:], path[:-1])[0, 1]]


@case("VectorizedActionNoise.base_noise,n_envs")
def vectorized_noise(lib: Library) -> Any:
    normal, many = lib("common.noise", "NormalActionNoise", "VectorizedActionNoise")
    noise = many(normal(np.array([0.3, 0.1]), np.zeros(2)), 3)
    return [noise(), noise.n_envs]


@case("VecNormalize.training,norm_obs,norm_reward,clip_obs,clip_reward,gamma,epsilon")
def vec_normalize(lib: Library) -> Any:
    wrapper, results = lib("common.vec_env", "VecNormalize"), []
    for options in (
        {},
        {"gamma": 0.5},
        {"clip_obs": 0.7, "clip_reward": 0.4},
        {"epsilon": 0.5},
        {"norm_obs": False},
        {"norm_reward": False},
        {"training": False},
    ):
        env = wrapper(vec(lib, Line(THREE, scale=10.0), Line(THREE, 3, scale=5.0)), **options)
        results.append(stepped(env, 8, np.zeros(2, int)))
        results.append([env.get_original_reward(), env.get_original_obs()])
    return results


class Goals(Line):
    """``Line`` with a Dict of observations."""

    def __init__(self, *arguments: Any, **kwargs: Any) -> None:
        super().__init__(*arguments, **kwargs)
        self.observation_space = gym.spaces.Dict(a=self.observation_space, b=gym.spaces.Box(-9, 9, (1,), np.float32))

    def look(self) -> Any:
        return {"a": super().look(), "b": np.array([self.t], np.float32)}


@case("VecNormalize.norm_obs_keys VecExtractDictObs.key")
def keys_of_dict(lib: Library) -> Any:
    normalize, extract = lib("common.vec_env", "VecNormalize", "VecExtractDictObs")
    results = []
    for keys, key in ((["b"], "b"), (["b"], "a"), (None, "a")):
        env = extract(normalize(vec(lib, Goals(THREE)), norm_obs_keys=keys), key)
        results.append(stepped(env, 6, np.zeros(1, int)))
    return results


class Images(Line):
    """``Line`` with images."""

    def __init__(self, shape: tuple[int, ...], *arguments: Any, **kwargs: Any) -> None:
        super().__init__(THREE, *arguments, **kwargs)
        self.observation_space = gym.spaces.Box(0, 255, shape, np.uint8)

    def look(self) -> Any:
        return np.full(self.observation_space.shape, 10 * self.episode + self.t, np.uint8)


@case("VecFrameStack.venv,n_stack,channels_order StackedObservations.n_stack,channels_order")
def frame_stack(lib: Library) -> Any:
    wrapper, results = lib("common.vec_env", "VecFrameStack"), []
    for shape, order in (((36, 36, 1), None), ((1, 36, 36), None), ((36, 36, 1), "last"), ((1, 36, 36), "first")):
        env = wrapper(vec(lib, Images(shape, 3)), 3, channels_order=order)
        results.append(list(env.observation_space.shape))
        env.reset()
        for _ in range(5):
            obs, _, done, infos = env.step([0])
            axis = int(np.argmin(obs.shape[1:])) + 1
            results.append(np.moveaxis(obs, axis, -1)[0, 0, 0].tolist())
            if done[0]:
                results.append(np.moveaxis(infos[0]["terminal_observation"], axis - 1, -1)[0, 0].tolist())
    return [results, stepped(wrapper(vec(lib, Line(THREE)), 2), 6, [0])]


@case("VecTransposeImage.skip")
def transpose(lib: Library) -> Any:
    wrapper = lib("common.vec_env", "VecTransposeImage")
    return [list(wrapper(vec(lib, Images((36, 40, 1))), skip=skip).reset().shape) for skip in (False, True)]


@case("VecCheckNan.raise_exception,warn_once,check_inf")
def check_nan(lib: Library) -> Any:
    wrapper, results = lib("common.vec_env", "VecCheckNan"), []

    class Broken(Line):
        def step(self, action: Any) -> Any:
            obs, reward, *ends = super().step(action)
            return obs * (math.inf if self.t == 1 else math.nan), reward, *ends

    for options in ({"raise_exception": True}, {}, {"warn_once": False}, {"check_inf": False, "raise_exception": True}):
        env = wrapper(vec(lib, Broken(THREE, 9)), **options)
        env.reset()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            errors = []
            for _ in range(3):
                try:
                    env.step([0])
                    errors.append("")
                except ValueError as error:
                    errors.append(isinstance(error, ValueError))
        results.append([errors, len(caught)])
    return results


def table(path: Path) -> list[list[str]]:
    """Returns the rows of a monitor's file without times."""
    lines = path.read_text().splitlines()[1:]
    head = lines[0].split(",")
    rows = [[x for name, x in zip(head, row.split(","), strict=True) if name != "t"] for row in lines]
    return [rows[0], *([float(x) if x.strip("-0123456789.e") == "" else x for x in row] for row in rows[1:])]


class Informed(Line):
    """``Line`` with an info."""

    def reset(self, **options: Any) -> Any:
        self.color = (options.pop("options", None) or {}).get("color", "none")
        return super().reset(**options)

    def step(self, action: Any) -> Any:
        *transition, info = super().step(action)
        return *transition, {**info, "t2": self.t**2, "is_success": self.t > 3}


@case(
    "Monitor.filename,allow_early_resets,reset_keywords,info_keywords,override_existing ResultsWriter.filename,extra_keys,override_existing"
)
def monitor(lib: Library) -> Any:
    wrapper, results = lib("common.monitor", "Monitor"), []
    for name, options in (
        ("a", {}),
        ("b", {"info_keywords": ("t2",)}),
        ("b", {"info_keywords": ("t2",), "override_existing": False}),
        ("b", {"info_keywords": ("t2",)}),
        ("c.monitor.csv", {"allow_early_resets": False}),
        ("folder", {}),
    ):
        if name == "folder":
            Path(name).mkdir()
        env = wrapper(Informed(THREE, 4), name, **options)
        env.reset()
        for i in range(9):
            *_, over, _, info = env.step(0)
            if over:
                results.append({key: x for key, x in info["episode"].items() if key != "t"})
                env.reset()
        early = ""
        try:
            env.reset()
        except RuntimeError as error:
            early = type(error).__name__
        env.close()
        results += [early, env.get_total_steps(), env.get_episode_lengths(), env.get_episode_rewards()]
        results.append([[path.name, table(path)] for path in sorted(Path().glob("**/*monitor.csv"))])
    return results


@case("VecMonitor.filename,info_keywords")
def vec_monitor(lib: Library) -> Any:
    env = lib("common.vec_env", "VecMonitor")(
        vec(lib, Informed(THREE, 3), Informed(THREE, 4)), "v", info_keywords=("t2",)
    )
    env.reset()
    results = []
    for _ in range(8):
        *_, infos = env.step([0, 0])
        results.append([{k: float(x) for k, x in info.get("episode", {}).items() if k != "t"} for info in infos])
    env.close()
    return [results, [[path.name, table(path)] for path in sorted(Path().glob("*monitor.csv"))]]


class Screen(gym.Env):
    """Something like an Atari game: frames, lives, and rewards of any size."""

    def __init__(self) -> None:
        self.observation_space = gym.spaces.Box(0, 255, (210, 160, 3), np.uint8)
        self.action_space = gym.spaces.Discrete(4)
        self.ale, self.t, self.taken = self, 0, []

    def get_action_meanings(self) -> list[str]:
        return ["NOOP", "FIRE", "RIGHT", "LEFT"]

    def lives(self) -> int:
        return 3 - self.t // 20 % 4

    def look(self) -> np.ndarray:
        image = np.zeros((210, 160, 3), np.uint8)
        image[self.t % 200 : self.t % 200 + 9] = [200, 100, 50]
        return image

    def reset(self, **options: Any) -> Any:
        super().reset(**options)
        self.t = 0
        return self.look(), {}

    def step(self, action: Any) -> Any:
        self.t += 1
        self.taken.append(int(action))
        return self.look(), [0.0, 2.5, -3.0][self.t % 3], self.t >= 79, False, {}


def played(env: Any, n: int, seed: int = 3) -> list[Any]:
    """Returns the record of a game: the mean of the frames, rewards, ends and the steps that were taken."""
    obs, _ = env.reset(seed=seed)
    results: list[Any] = [list(obs.shape), float(obs.mean())]
    for i in range(n):
        obs, reward, terminated, truncated, _ = env.step(i % 4)
        results.append([round(float(obs.mean()), 3), float(reward), bool(terminated), bool(truncated), env.unwrapped.t])
        if terminated or truncated:
            obs, _ = env.reset()
            results.append([round(float(obs.mean()), 3), env.unwrapped.t])
    return [results, env.unwrapped.taken]


@case(
    "MaxAndSkipEnv.skip ClipRewardEnv.env EpisodicLifeEnv.env FireResetEnv.env WarpFrame.width,height NoopResetEnv.noop_max",
    0.02,
)
def atari_wrappers(lib: Library) -> Any:
    names = ("MaxAndSkipEnv", "ClipRewardEnv", "EpisodicLifeEnv", "FireResetEnv", "WarpFrame", "NoopResetEnv")
    skip, clip, lives, fire, warp, noop = lib("common.atari_wrappers", *names)
    results = [played(make(Screen()), 45) for make in (clip, lives, fire)]
    results += [played(skip(Screen(), skip=3), 30), played(warp(Screen(), width=40, height=50), 3)]
    env = noop(Screen(), noop_max=5)
    starts = []
    for seed in range(30):
        env.reset(seed=seed)
        starts.append(env.unwrapped.t)
    return [results, [min(starts), max(starts)]]


@case("AtariWrapper.frame_skip,screen_size,terminal_on_life_loss,clip_reward,noop_max", 0.02)
def atari_wrapper(lib: Library) -> Any:
    wrapper, results = lib("common.atari_wrappers", "AtariWrapper"), []
    for options in (
        {"noop_max": 0},
        {"noop_max": 0, "frame_skip": 2, "screen_size": 50},
        {"noop_max": 0, "terminal_on_life_loss": False, "clip_reward": False},
    ):
        results.append(played(wrapper(Screen(), **options), 30))
    return results


@case("StickyActionEnv.action_repeat_probability AtariWrapper.action_repeat_probability", 0.06)
def sticky(lib: Library) -> Any:
    results = []
    for make in (
        lambda: lib("common.atari_wrappers", "StickyActionEnv")(Screen(), 0.3),
        lambda: lib("common.atari_wrappers", "AtariWrapper")(
            Screen(), noop_max=0, frame_skip=1, action_repeat_probability=0.6
        ),
    ):
        env = make()
        env.reset(seed=0)
        n, repeated = 1500, 0
        for i in range(n):
            env.step(i % 4)
            repeated += env.unwrapped.taken[-1] != i % 4
            if env.unwrapped.t >= 78:
                env.reset()
        results.append(repeated / n)
    return results


@case(
    "make_vec_env.env_id,n_envs,seed,start_index,monitor_dir,wrapper_class,env_kwargs,vec_env_cls,vec_env_kwargs,monitor_kwargs,wrapper_kwargs"
)
def make_vec(lib: Library) -> Any:
    make, dummy = lib("common.env_util", "make_vec_env"), lib("common.vec_env", "DummyVecEnv")
    env = make(
        "CartPole-v1",
        n_envs=2,
        seed=5,
        start_index=3,
        monitor_dir="m",
        wrapper_class=gym.wrappers.TimeLimit,
        wrapper_kwargs={"max_episode_steps": 4},
        env_kwargs={"sutton_barto_reward": True},
        vec_env_cls=dummy,
        vec_env_kwargs={},
        monitor_kwargs={"override_existing": True},
    )
    results = stepped(env, 9, np.zeros(2, int))
    spaces_drawn = [int(member.action_space.sample()) for member in env.envs]
    env.close()
    names = sorted(path.name for path in Path("m").iterdir())
    from_function = make(lambda: Line(THREE), n_envs=1)
    return [results, spaces_drawn, names, stepped(from_function, 6, [0])]


class Fixed:
    """A policy that always takes one action."""

    def predict(self, obs: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False) -> Any:
        self.calls = [*getattr(self, "calls", []), [len(obs), deterministic, np.asarray(episode_start).tolist()]]
        return np.zeros(len(obs), int), state


@case(
    "evaluate_policy.model,env,n_eval_episodes,deterministic,render,callback,reward_threshold,return_episode_rewards,warn"
)
def evaluating(lib: Library) -> Any:
    evaluate, results = lib("common.evaluation", "evaluate_policy"), []
    for n, lengths in ((5, (3, 7)), (4, (2, 3, 9)), (1, (4, 4)), (3, (4,))):
        policy, callback_calls = Fixed(), []
        envs = vec(lib, *(Line(THREE, length) for length in lengths), monitored=True)
        results.append(
            evaluate(
                policy,
                envs,
                n_eval_episodes=n,
                deterministic=n != 5,
                callback=lambda l, g: callback_calls.append([sorted(l)[:0], l["i"]]),  # noqa: B023, E741
                return_episode_rewards=True,
                warn=False,
            )
        )
        results += [policy.calls, callback_calls, evaluate(policy, envs, n_eval_episodes=n, reward_threshold=-100.0)]
        try:
            evaluate(policy, envs, n_eval_episodes=n, reward_threshold=100.0)
        except AssertionError:
            results.append("below")
        except ValueError:
            results.append("below, as ValueError")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        evaluate(Fixed(), Line(THREE), 1)
        evaluate(Fixed(), Line(THREE), 1, warn=False)
    return [results, len(caught)]


def eval_callback(lib: Library, n_envs: int, **options: Any) -> Any:
    callback_class, base = lib("common.callbacks", "EvalCallback", "BaseCallback")
    events: list[Any] = []

    class Event(base):  # type: ignore[misc]
        def __init__(self, name: str) -> None:
            super().__init__()
            self.title = name

        def _on_step(self) -> bool:
            events.append([self.title, self.num_timesteps, self.parent.n_calls, round(self.parent.last_mean_reward, 3)])
            return True

    callback = callback_class(
        vec(lib, Line(THREE, 4), monitored=True),
        callback_on_new_best=Event("best"),
        callback_after_eval=Event("after"),
        warn=False,
        verbose=0,
        **options,
    )
    small(lib, vec(lib, *(Line(THREE) for _ in range(n_envs)))).learn(40, callback=callback)
    files = {}
    for path in sorted(Path().glob("**/*")):
        files[path.as_posix()] = "file" if path.is_file() else "folder"
    logs = {}
    if Path("logs/evaluations.npz").exists():
        with np.load("logs/evaluations.npz") as saved:
            logs = {key: saved[key].tolist() for key in sorted(saved)}
    return [events, files, logs, callback.evaluations_timesteps if hasattr(callback, "evaluations_timesteps") else []]


@case(
    "EvalCallback.eval_env,callback_on_new_best,callback_after_eval,n_eval_episodes,eval_freq,log_path,best_model_save_path,deterministic,warn,verbose"
)
def eval_callback_1(lib: Library) -> Any:
    return eval_callback(lib, 1, eval_freq=7, n_eval_episodes=2, log_path="logs", best_model_save_path="best")


@case("EvalCallback.eval_freq,deterministic")
def eval_callback_2(lib: Library) -> Any:
    return eval_callback(lib, 2, eval_freq=6, n_eval_episodes=3)


@case("CheckpointCallback.save_freq,save_path,name_prefix,save_replay_buffer,save_vecnormalize,verbose")
def checkpoints(lib: Library) -> Any:
    callback_class, normalize = lib("common.callbacks", "CheckpointCallback"), lib("common.vec_env", "VecNormalize")
    for prefix, n_envs, off in (("one", 1, False), ("two", 2, False), ("off", 1, True)):
        env = normalize(vec(lib, *(Line(THREE) for _ in range(n_envs))))
        model = small(lib, env, "DQN", learning_starts=10, buffer_size=100) if off else small(lib, env)
        model.learn(30, callback=callback_class(7, "saved", prefix, save_replay_buffer=True, save_vecnormalize=True))
    return sorted(path.name for path in Path("saved").iterdir())


@case(
    "StopTrainingOnRewardThreshold.reward_threshold StopTrainingOnNoModelImprovement.max_no_improvement_evals,min_evals StopTrainingOnMaxEpisodes.max_episodes CallbackList.callbacks"
)
def stopping(lib: Library) -> Any:
    names = (
        "EvalCallback",
        "StopTrainingOnRewardThreshold",
        "StopTrainingOnNoModelImprovement",
        "StopTrainingOnMaxEpisodes",
    )
    evaluate, threshold, improvement, episodes = lib("common.callbacks", *names)
    many, results = lib("common.callbacks", "CallbackList"), []
    fixed = {"eval_freq": 5, "n_eval_episodes": 1, "warn": False, "verbose": 0}
    for n_envs, make in (
        (1, lambda env: evaluate(env, callback_on_new_best=threshold(-50.0), **fixed)),
        (1, lambda env: evaluate(env, callback_on_new_best=threshold(50.0), **fixed)),
        (1, lambda env: evaluate(env, callback_after_eval=improvement(2, 3), **fixed)),
        (1, lambda env: evaluate(env, callback_after_eval=improvement(1, 0), **fixed)),
        (1, lambda env: episodes(3)),
        (2, lambda env: episodes(3)),
        (1, lambda env: many([episodes(9), episodes(2)])),
    ):
        model = small(lib, vec(lib, *(Line(THREE) for _ in range(n_envs))))
        model.learn(60, callback=make(vec(lib, Constant(THREE), monitored=True)))
        results.append(model.num_timesteps)
    return results


class Constant(Line):
    """``Line`` in which all episodes have the same return."""

    def reset(self, **options: Any) -> Any:
        self.episode = 0
        return super().reset(**options)


@case("EveryNTimesteps.n_steps,callback LogEveryNTimesteps.n_steps ConvertCallback.callback EventCallback.callback")
def every(lib: Library) -> Any:
    callback_class, results = lib("common.callbacks", "EveryNTimesteps"), []
    for n_envs, n in ((1, 7), (3, 7), (2, 10)):
        callback, notes = noted(lib, lambda event: event.num_timesteps)
        small(lib, vec(lib, *(Line(THREE) for _ in range(n_envs)))).learn(60, callback=callback_class(n, callback))
        results.append(notes)
    calls: list[int] = []
    small(lib, vec(lib, Line(THREE))).learn(20, callback=lambda l, g: calls.append(l["self"].num_timesteps) or True)  # noqa: E741
    return [results, calls]


@case(
    "Logger.folder,output_formats configure.folder,format_strings HumanOutputFormat.filename_or_file,max_length CSVOutputFormat.filename JSONOutputFormat.filename make_output_format._format,log_dir,log_suffix"
)
def logging(lib: Library) -> Any:
    names = ("configure", "HumanOutputFormat", "make_output_format", "Logger")
    configure, human, make, logger_class = lib("common.logger", *names)
    logger = configure("logs", ["csv", "json", "log"])
    for step in range(3):
        logger.record("a/x", step * 0.123456789)
        logger.record_mean("a/mean", step)
        logger.record_mean("a/mean", step + 1)
        logger.record("b/text", "word" * 20, exclude="csv")
        logger.record("a/long_name_of_a_value_that_is_cut", 1e6 * step, exclude=("json",))
        if step:
            logger.record("c/late", True)
        logger.dump(step)
    logger.close()
    text = io.StringIO()
    table_logger = logger_class(None, [human(text, max_length=12)])
    table_logger.record("group/a_very_long_key_indeed", 3)
    table_logger.record("group/b", "a long text for this table")
    table_logger.dump(0)
    make("csv", "logs", "_2").close()
    files = {path.name: path.read_text() for path in sorted(Path("logs").iterdir())}
    return [files, text.getvalue()]


@case(
    "LinearSchedule.start,end,end_fraction ConstantSchedule.val FloatSchedule.value_schedule get_linear_fn.start,end,end_fraction get_schedule_fn.value_schedule constant_fn.val"
)
def schedules(lib: Library) -> Any:
    names = ("LinearSchedule", "ConstantSchedule", "FloatSchedule", "get_linear_fn", "get_schedule_fn", "constant_fn")
    linear, constant, number, line, as_schedule, fixed = lib("common.utils", *names)
    makes = [
        linear(1.0, 0.1, 0.4),
        constant(0.3),
        number(0.2),
        number(lambda p: p * p),
        line(0.0, 2.0, 0.5),
        as_schedule(0.7),
        fixed(0.9),
    ]
    return [[float(schedule(p)) for p in (1.0, 0.9, 0.6, 0.3, 0.0)] for schedule in makes]


@case(
    "safe_mean.arr explained_variance.y_pred,y_true get_latest_run_id.log_path,log_name should_collect_more_steps.train_freq,num_collected_steps,num_collected_episodes RunningMeanStd.epsilon,shape rolling_window.array,window window_func.var_1,var_2,window,func"
)
def small_functions(lib: Library) -> Any:
    mean, variance, latest = lib("common.utils", "safe_mean", "explained_variance", "get_latest_run_id")
    moments = lib("common.running_mean_std", "RunningMeanStd")(0.5, (2,))
    moments.update(np.array([[1.0, 2.0], [3.0, 5.0]]))
    for name in ("a_1", "a_3", "b_9", "a_x"):
        (Path("runs") / name).mkdir(parents=True)
    rolling, windows = lib("common.results_plotter", "rolling_window", "window_func")
    numbers = np.arange(6.0)
    return [
        mean([]), mean([1, 2]), float(variance(numbers, numbers + 0.5)), float(variance(numbers, numbers**2)),
        float(variance(numbers, np.ones(6))), latest("runs", "a"), latest("runs", "c"), moments.mean, moments.var,
        float(moments.count), rolling(numbers, 3), windows(numbers, numbers**2, 2, np.mean),
    ]  # fmt: skip


@case(
    "is_image_space.check_channels,normalized_image is_image_space_channels_first.observation_space get_obs_shape.observation_space get_flattened_obs_dim.observation_space get_action_dim.action_space maybe_transpose.observation,observation_space"
)
def preprocessing(lib: Library) -> Any:
    names = (
        "is_image_space",
        "is_image_space_channels_first",
        "get_obs_shape",
        "get_flattened_obs_dim",
        "get_action_dim",
    )
    image, first, shape, flat, dim = lib("common.preprocessing", *names)
    box = gym.spaces.Box
    images = [box(0, 255, s, np.uint8) for s in ((36, 36, 3), (3, 36, 36), (36, 36, 5), (36, 36))]
    floats = box(0.0, 1.0, (36, 36, 3), np.float32)
    others = [gym.spaces.Discrete(4), gym.spaces.MultiDiscrete([2, 3]), gym.spaces.MultiBinary(3), BOX]
    return [
        [[bool(image(s)), bool(image(s, check_channels=True))] for s in images],
        [bool(image(floats)), bool(image(floats, normalized_image=True))],
        [bool(first(s)) for s in images[:2]],
        [[list(shape(s)), int(flat(s)), int(dim(s))] for s in others],
    ]


@case(
    "DQN.exploration_fraction,exploration_initial_eps,exploration_final_eps QRDQN.exploration_fraction,exploration_initial_eps,exploration_final_eps"
)
def exploration(lib: Library) -> Any:
    results = []
    for name, n_envs in (("DQN", 1), ("DQN", 2), ("QRDQN", 1)):
        callback, notes = noted(lib, lambda event: [event.num_timesteps, float(event.model.exploration_rate)])
        options = {"exploration_fraction": 0.5, "exploration_initial_eps": 0.9, "exploration_final_eps": 0.2}
        env = vec(lib, *(Line(THREE) for _ in range(n_envs)))
        small(lib, env, name, learning_starts=1000, **options).learn(40, callback=callback)
        results.append(notes)
    return results


@case("DQN.learning_starts,train_freq,gradient_steps")
def updates_counted(lib: Library) -> Any:
    results = []
    for options in (
        {"learning_starts": 10, "train_freq": 4, "gradient_steps": 1},
        {"learning_starts": 10, "train_freq": 4, "gradient_steps": 3},
        {"learning_starts": 10, "train_freq": 4, "gradient_steps": -1},
        {"learning_starts": 12, "train_freq": 4, "gradient_steps": 1},
        {"learning_starts": 10, "train_freq": (2, "episode"), "gradient_steps": -1},
        {"learning_starts": 10, "train_freq": (1, "episode"), "gradient_steps": 2},
        {"learning_starts": 0, "train_freq": (3, "step"), "gradient_steps": 1},
    ):
        model = small(lib, vec(lib, Line(THREE)), "DQN", buffer_size=100, batch_size=8, **options)
        results.append(model.learn(40)._n_updates)
    return results


@case("DQN.learning_starts,train_freq,gradient_steps(2 environments)")
def updates_counted_2(lib: Library) -> Any:
    results = []
    for options in (
        {"learning_starts": 10, "train_freq": 4, "gradient_steps": 1},
        {"learning_starts": 10, "train_freq": 4, "gradient_steps": -1},
    ):
        model = small(lib, vec(lib, Line(THREE), Line(THREE)), "DQN", buffer_size=100, batch_size=8, **options)
        results.append(model.learn(40)._n_updates)
    return results


WIDE = gym.spaces.Box(np.array([-2.0, 0.0], np.float32), np.array([2.0, 4.0], np.float32))


@case("TD3.action_noise DDPG.action_noise SAC.action_noise")
def action_noise(lib: Library) -> Any:
    normal, results = lib("common.noise", "NormalActionNoise"), []
    for name, mean in (("TD3", [0.3, -0.2]), ("DDPG", [0.9, -5.0])):
        env = Line(WIDE)
        noise = normal(np.array(mean), np.zeros(2))
        model = lib.make(name, "MlpPolicy", env, name, action_noise=noise, learning_starts=0, train_freq=100)
        model.learn(10)
        results.append(env.actions[:10])  # the original goes on to the end of a rollout
    return results


@case("PPO.use_sde,sde_sample_freq A2C.use_sde,sde_sample_freq SAC.use_sde,sde_sample_freq")
def noise_of_states(lib: Library) -> Any:
    results = []

    class Same(Line):
        def look(self) -> np.ndarray:
            return np.ones(3, np.float32)

    for name, frequency in (("PPO", 4), ("A2C", 3), ("SAC", 5), ("SAC", -1)):
        env = Same(BOX, 100)
        off = {"learning_starts": 0, "train_freq": 20, "batch_size": 4} if name == "SAC" else {"n_steps": 20}
        small(lib, vec(lib, env), name, use_sde=True, sde_sample_freq=frequency, **off).learn(20)
        actions = np.array(env.actions)
        results.append(np.flatnonzero(np.abs(np.diff(actions, axis=0)).max(axis=1) > 1e-6).tolist())
    return results


@case("PPO.stats_window_size,verbose,tensorboard_log,seed A2C.stats_window_size,verbose,seed")
def outputs(lib: Library) -> Any:
    results = []
    for window in (2, 7):
        model = small(lib, vec(lib, Line(THREE), monitored=True), stats_window_size=window).learn(40)
        results.append([len(model.ep_info_buffer), [episode["l"] for episode in model.ep_info_buffer]])
    for verbose in (0, 1):
        with contextlib.redirect_stdout(io.StringIO()) as text:
            small(lib, vec(lib, Line(THREE), monitored=True), verbose=verbose).learn(600, log_interval=1)
        results.append(bool(text.getvalue()))
    same = [
        small(lib, vec(lib, Line(THREE)), seed=seed).learn(20).predict(LOOKS, deterministic=False)[0] for seed in (3, 3)
    ]
    return [results, bool(np.array_equal(*same))]


@case("TimeFeatureWrapper.max_steps,test_mode")
def time_feature(lib: Library) -> Any:
    wrapper = lib("contrib.common.wrappers", "TimeFeatureWrapper")
    results = []
    for options in ({"max_steps": 8}, {"max_steps": 8, "test_mode": True}):
        for env in (Line(THREE), gym.wrappers.TimeLimit(Line(THREE), 6)):
            wrapped = wrapper(env, **options)
            results.append([wrapped.observation_space.low, wrapped.observation_space.high, wrapped.reset()[0]])
            results.append([wrapped.step(0)[0] for _ in range(4)])
    return results


class Masking(Line):
    """``Line`` with a method of masks that takes the environment, as in sb3-contrib."""

    def masks_of(self, env: Any) -> np.ndarray:
        return env.action_masks()


@case("ActionMasker.action_mask_fn get_action_masks.env is_masking_supported.env evaluate_policy.use_masking")
def masks(lib: Library) -> Any:
    masker = lib("contrib.common.wrappers", "ActionMasker")
    get, supported = lib("contrib.common.maskable.utils", "get_action_masks", "is_masking_supported")
    results = []
    for function in ("masks_of", lambda env: [True, False, True]):
        env = masker(Masking(THREE), function)
        env.reset()
        results.append([np.asarray(get(env), int), np.asarray(get(vec(lib, env)), int), bool(supported(vec(lib, env)))])
    return results


class Played(Line):
    """``Line`` that does not count an episode without a step: the original resets once more between candidates."""

    def reset(self, **options: Any) -> Any:
        self.episode -= self.t == 0 and self.episode > 0
        return super().reset(**options)


@case("ARS.n_delta,n_top,alive_bonus_offset")
def random_search(lib: Library) -> Any:
    results = []
    for options in ({}, {"n_delta": 3}, {"n_top": 2}, {"alive_bonus_offset": -1.0}, {"alive_bonus_offset": 2.0}):
        settings = {"n_delta": 4, "policy_kwargs": {}, **options}
        model = small(lib, vec(lib, Played(THREE, 3, varies=True), monitored=True), "ARS", **settings)
        logger = lib("common.logger", "Logger")(None, [])
        model.set_logger(logger)
        values: dict[str, float] = {}
        plain_record = logger.record

        def record(key: str, value: Any, *arguments: Any, **more: Any) -> None:
            values[key] = value  # noqa: B023
            plain_record(key, value, *arguments, **more)  # noqa: B023

        logger.record = record
        while model._n_updates < 1:
            model.learn(1, reset_num_timesteps=False)
        n = settings["n_delta"]
        top = settings.get("n_top", n)
        if lib.is_original:
            deviation = values["rollout/return_std"] * math.sqrt((2 * top - 1) / (2 * top))
        else:
            deviation = float(model.statistics()["train/return_std"])
        results.append([deviation, model._n_updates])
    return results


@case("HerReplayBuffer.n_sampled_goal,goal_selection_strategy SAC.replay_buffer_class,replay_buffer_kwargs", 0.1)
def hindsight(lib: Library) -> Any:
    results = []
    her = lib("", "HerReplayBuffer")

    class Reach(Line):
        def __init__(self) -> None:
            super().__init__(BOX, 10, truncates=True)
            box = gym.spaces.Box(-99, 99, (1,), np.float32)
            self.observation_space = gym.spaces.Dict(observation=box, achieved_goal=box, desired_goal=box)

        def look(self) -> Any:
            here = np.array([self.t], np.float32)
            return {"observation": here, "achieved_goal": here, "desired_goal": np.array([50], np.float32)}

        def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
            return -(np.abs(np.asarray(achieved) - desired).max(axis=-1) > 0.5).astype(np.float32)

        def step(self, action: Any) -> Any:
            obs, _, *ends = super().step(action)
            return obs, float(self.compute_reward(obs["achieved_goal"], obs["desired_goal"], {})), *ends

    for strategy, n in (("future", 4), ("final", 1), ("episode", 2), ("future", 0)):
        if n == 0:
            continue
        model = lib.algorithm("SAC")(
            "MultiInputPolicy", Reach(), learning_starts=1000, seed=0, device="cpu", buffer_size=1000,
            replay_buffer_class=her, replay_buffer_kwargs={"n_sampled_goal": n, "goal_selection_strategy": strategy},
        )  # fmt: skip
        model.learn(100)
        if lib.is_original:
            batch = model.replay_buffer.sample(40000)
            here, goal = plain(batch.observations["observation"]), plain(batch.observations["desired_goal"])
            reward = plain(batch.rewards)
        else:
            drawn = model.run.replay.sample(np.random.default_rng(0), (40000,))
            here, goal, reward = drawn.obs["observation"], drawn.obs["desired_goal"], drawn.reward
        ahead = (np.asarray(goal) - np.asarray(here)).ravel()
        new = np.asarray(goal).ravel() < 40
        results.append(
            [float(new.mean()), float(ahead[new].mean()), float(ahead[new].min() / 10), float(np.mean(reward))]
        )
    return results


@case("OrnsteinUhlenbeckActionNoise.dtype")
def noise_types(lib: Library) -> Any:
    normal, path = lib("common.noise", "NormalActionNoise", "OrnsteinUhlenbeckActionNoise")
    zeros = np.zeros(2)
    return [
        str(noise_class(zeros, zeros, dtype=dtype)().dtype)
        for noise_class in (normal, path)
        for dtype in (np.float32, np.float64)
    ]


@case("unwrap_wrapper.wrapper_class is_wrapped.wrapper_class unwrap_vec_wrapper.vec_wrapper_class is_vecenv_wrapped.vec_wrapper_class sync_envs_normalization.eval_env VecEnvWrapper.venv DummyVecEnv.env_fns VecEnv.num_envs VecCheckNan.venv VecExtractDictObs.venv VecMonitor.venv VecNormalize.venv VecTransposeImage.venv StackedObservations.num_envs")  # fmt: skip
def wrapped(lib: Library) -> Any:
    is_in, unwrap = lib("common.env_util", "is_wrapped", "unwrap_wrapper")
    is_vec, unwrap_vec, sync = lib(
        "common.vec_env", "is_vecenv_wrapped", "unwrap_vec_wrapper", "sync_envs_normalization"
    )
    names = ("VecCheckNan", "VecMonitor", "VecNormalize", "VecFrameStack", "VecExtractDictObs", "VecTransposeImage")
    nan, monitor, normalize, stack, extract, transpose = lib("common.vec_env", *names)
    env = gym.wrappers.TimeLimit(Line(THREE), 5)
    results = [is_in(env, gym.wrappers.TimeLimit), is_in(env, gym.wrappers.ClipAction)]
    results += [unwrap(env, gym.wrappers.TimeLimit) is env, unwrap(env, gym.wrappers.ClipAction)]
    plain_env = vec(lib, Line(THREE), Line(THREE))
    both = normalize(nan(plain_env))
    evaluation_env = normalize(nan(vec(lib, Line(THREE))), training=False)
    stepped(both, 4, np.zeros(2, int))
    sync(both, evaluation_env)
    results += [is_vec(both, nan), is_vec(both, stack), unwrap_vec(both, nan) is both.venv, unwrap_vec(both, stack)]
    results += [
        evaluation_env.obs_rms.mean,
        evaluation_env.ret_rms.var,
        both.venv.venv is plain_env,
        plain_env.num_envs,
        both.num_envs,
    ]
    for wrapper in (monitor(plain_env), stack(plain_env, 2), extract(vec(lib, Goals(THREE)), "a")):
        results.append([wrapper.num_envs, wrapper.venv.num_envs, list(wrapper.observation_space.shape)])
    return [*results, transpose(vec(lib, Images((36, 36, 3)))).venv.num_envs]


@case("make_atari_env.env_id,n_envs,seed,start_index,monitor_dir,wrapper_kwargs,env_kwargs,vec_env_cls,vec_env_kwargs,monitor_kwargs", 0.02)  # fmt: skip
def make_atari(lib: Library) -> Any:
    make, dummy = lib("common.env_util", "make_atari_env"), lib("common.vec_env", "DummyVecEnv")
    env = make(
        lambda **_: Screen(), n_envs=2, seed=4, start_index=1, monitor_dir="m", vec_env_cls=dummy, vec_env_kwargs={},
        wrapper_kwargs={"noop_max": 0, "frame_skip": 2, "screen_size": 40}, env_kwargs={},
        monitor_kwargs={"override_existing": True},
    )  # fmt: skip
    results = [list(env.observation_space.shape), list(env.reset().shape)]
    results += [[x.tolist() for x in env.step([1, 2])[1:3]] for _ in range(4)]
    env.close()
    return [results, sorted(path.name for path in Path("m").iterdir())]


@case(
    "Video.frames,fps Figure.figure,close Image.image,dataformats HParam.hparam_dict,metric_dict FormatUnsupportedError.unsupported_formats,value_description filter_excluded_keys.key_values,key_excluded,_format"
)
def logged_values(lib: Library) -> Any:
    names = ("Video", "Figure", "Image", "HParam", "FormatUnsupportedError", "filter_excluded_keys", "CSVOutputFormat")
    video, figure, image, hparam, error, excluded, table_of = lib("common.logger", *names)
    values = [video(np.zeros(2), 4.0), figure("f", close=True), image(np.ones(2), "HW"), hparam({"a": 1}, {"b": 2.0})]
    results = [{key: str(x) for key, x in vars(value).items()} for value in values]
    results.append(excluded({"a": 1, "b": 2, "c": 3}, {"a": ("csv",), "b": None, "c": ("log", "stdout")}, "log"))
    writer, errors = table_of("x.csv"), []
    for value in values:
        try:
            writer.write({"k": value}, {"k": ()}, 0)
        except error as raised:
            errors.append(isinstance(raised, NotImplementedError))
    texts = [word in str(error(["json", "csv"], "video")) for word in ("json", "csv", "video")]
    return [results, errors, texts]


@case("get_monitor_files.path load_results.path ts2xy.data_frame,x_axis ResultsWriter.header")
def monitor_files(lib: Library) -> Any:
    writer, files, load = lib("common.monitor", "ResultsWriter", "get_monitor_files", "load_results")
    curve = lib("common.results_plotter", "ts2xy")
    for i, start in enumerate((10.0, 5.5)):
        monitor_file = writer(f"m/{i}", {"t_start": start, "env_id": "E"})
        for k in range(3):
            monitor_file.write_row({"r": k + 0.5, "l": 4 + k, "t": 2.0 * k + i})
        monitor_file.close()
    table = load("m")
    results = [[np.asarray(x, float) for x in curve(table, axis)] for axis in ("timesteps", "episodes", "walltime_hrs")]
    return [[Path(name).name for name in sorted(files("m"))], results, [list(map(float, table[key])) for key in "rlt"]]


@case(
    "is_vectorized_observation.observation is_vectorized_box_observation.observation is_vectorized_discrete_observation.observation is_vectorized_multidiscrete_observation.observation is_vectorized_multibinary_observation.observation is_vectorized_dict_observation.observation set_random_seed.seed,using_cuda check_for_nested_spaces.obs_space preprocess_obs.obs,normalize_images configure_logger.verbose,tensorboard_log,tb_log_name,reset_num_timesteps get_system_info.print_info polyak_update.params,target_params,tau"
)
def helpers(lib: Library) -> Any:
    space_names = ("box", "discrete", "multidiscrete", "multibinary", "dict")
    is_vector = lib(
        "common.utils", "is_vectorized_observation", *(f"is_vectorized_{k}_observation" for k in space_names)
    )
    spaces = gym.spaces
    nested = spaces.Dict(a=BOX, b=THREE)
    examples = [BOX, THREE, spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(3), nested]
    results: list[Any] = []
    for i, space in enumerate(examples):
        sample = space.sample()
        many = (
            {k: np.stack([x, x]) for k, x in sample.items()} if isinstance(sample, dict) else np.stack([sample, sample])
        )
        results += [[bool(check(x, space)) for check in (is_vector[0], is_vector[1 + i])] for x in (sample, many)]
    seeds, nests = lib("common.utils", "set_random_seed"), lib("common.preprocessing", "check_for_nested_spaces")
    for space in (nested, spaces.Dict(a=nested), spaces.Tuple([nested])):
        try:
            nests(space)
            results.append("")
        except NotImplementedError as error:
            results.append(type(error).__name__)
    seeds(7, using_cuda=False)
    results.append(np.random.rand(2))
    process = lib("common.preprocessing", "preprocess_obs")
    image = spaces.Box(0, 255, (36, 36, 1), np.uint8)
    for space in (image, spaces.Discrete(3), spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(2)):
        for normalizes in (True, False):
            observation = lib.tensor(
                np.array([space.high if space is image else (2 if space.shape == () else [1] * 2)])
            )
            results.append(np.ravel(plain(process(observation, space, normalize_images=normalizes)))[:6])
    configure = lib("common.utils", "configure_logger")
    for name in ("run_1", "run_3"):
        (Path("logs") / name).mkdir(parents=True, exist_ok=True)
    for verbose in (0, 1):
        formats = [type(output_format).__name__ for output_format in configure(verbose, None).output_formats]
        results.append(formats)
    with contextlib.redirect_stdout(io.StringIO()) as text:
        info = lib("common.utils", "get_system_info")(print_info=False)
    results.append([text.getvalue(), type(info).__name__, len(info)])
    update = lib("common.utils", "polyak_update")
    ours, target = (lib.tensor(np.array([x, 2.0], np.float32)) for x in (1.0, 3.0))
    target = target if lib.is_original else np.array(target)
    update([ours], [target], 0.25)
    return [*results, plain(target)]


@case(
    "RolloutBufferSamples.observations,actions,old_values,old_log_prob,advantages,returns ReplayBufferSamples.observations,actions,next_observations,dones,rewards,discounts DictRolloutBufferSamples.observations,actions,old_values,old_log_prob,advantages,returns DictReplayBufferSamples.observations,actions,next_observations,dones,rewards,discounts RolloutReturn.episode_timesteps,n_episodes,continue_training TrainFreq.frequency,unit"
)
def tuples(lib: Library) -> Any:
    names = ("RolloutBufferSamples", "ReplayBufferSamples", "DictRolloutBufferSamples", "DictReplayBufferSamples")
    tuple_types = lib("common.type_aliases", *names, "RolloutReturn", "TrainFreq")
    return [list(tuple_type._fields) for tuple_type in tuple_types]


@case("VecVideoRecorder.venv,video_folder,record_video_trigger,video_length,name_prefix")
def video_recorder(lib: Library) -> Any:
    wrapper = lib("common.vec_env", "VecVideoRecorder")
    env = lib("common.env_util", "make_vec_env")("CartPole-v1", n_envs=1)
    asked: list[int] = []
    env = wrapper(
        env, "videos", lambda step: bool(asked.append(step)) or step % 7 == 2, video_length=3, name_prefix="p"
    )
    env.reset()
    recording = []
    for _ in range(13):
        env.step([0])
        recording.append(bool(env.recording))
    env.close()
    return [asked, recording, sorted(path.name for path in Path("videos").glob("*.mp4"))]


@case("SubprocVecEnv.env_fns,start_method")
def in_processes(lib: Library) -> Any:
    subproc_vec_env = lib("common.vec_env", "SubprocVecEnv")
    env = subproc_vec_env(
        [partial(gym.make, "CartPole-v1"), partial(gym.make, "CartPole-v1")], start_method="forkserver"
    )
    env.seed(3)
    results = stepped(env, 4, np.zeros(2, int))
    env.close()
    return results


@case(
    "BaseCallback.verbose EventCallback.verbose ConvertCallback.verbose StopTrainingOnRewardThreshold.verbose StopTrainingOnMaxEpisodes.verbose StopTrainingOnNoModelImprovement.verbose EvalCallback.render,verbose MaskableEvalCallback.use_masking"
)
def verbose_callbacks(lib: Library) -> Any:
    names = ("EvalCallback", "StopTrainingOnRewardThreshold", "StopTrainingOnNoModelImprovement")
    evaluate, threshold, improvement, episodes = lib("common.callbacks", *names, "StopTrainingOnMaxEpisodes")
    convert, results, rendered = lib("common.callbacks", "ConvertCallback"), [], []

    class Shown(Constant):
        metadata = {"render_modes": ["human"]}
        render_mode = "human"

        def render(self) -> None:
            rendered.append(self.t)

    for verbose in (0, 1):
        fixed = {"eval_freq": 5, "n_eval_episodes": 1, "warn": False, "verbose": verbose}
        for callback in (
            evaluate(vec(lib, Constant(THREE)), callback_on_new_best=threshold(-50.0, verbose=verbose), **fixed),
            evaluate(vec(lib, Constant(THREE)), callback_after_eval=improvement(1, 0, verbose=verbose), **fixed),
            episodes(2, verbose=verbose),
        ):
            with contextlib.redirect_stdout(io.StringIO()) as text:
                small(lib, vec(lib, Line(THREE))).learn(20, callback=callback)
            results.append(bool(text.getvalue()))
        results.append(convert(lambda l, g: True, verbose=verbose).verbose)  # noqa: E741
    shown = evaluate(vec(lib, Shown(THREE)), eval_freq=10, n_eval_episodes=1, render=True, warn=False, verbose=0)
    small(lib, vec(lib, Line(THREE))).learn(10, callback=shown)
    return [results, rendered]


@case("DQN.stats_window_size,verbose,seed")
def outputs_off_policy(lib: Library) -> Any:
    results = []
    fast = {"learning_starts": 8, "buffer_size": 100, "batch_size": 4}
    for name, options in (("DQN", fast), ("A2C", {})):
        for window in (2, 7):
            env = vec(lib, Line(THREE), monitored=True)
            model = small(lib, env, name, stats_window_size=window, **options).learn(40)
            results.append([len(model.ep_info_buffer), [episode["l"] for episode in model.ep_info_buffer]])
        for verbose in (0, 1):
            with contextlib.redirect_stdout(io.StringIO()) as text:
                env = vec(lib, Line(THREE), monitored=True)
                small(lib, env, name, verbose=verbose, **options).learn(100, log_interval=1)
            results.append(bool(text.getvalue()))
        same = [small(lib, vec(lib, Line(THREE)), name, seed=3, **options).learn(20) for _ in range(2)]
        results.append(bool(np.array_equal(*(agent.predict(LOOKS, deterministic=True)[0] for agent in same))))
    return results


@case("A2C.tensorboard_log DQN.tensorboard_log TensorBoardOutputFormat.folder")
def tensorboard(lib: Library) -> Any:
    writer = lib("common.logger", "TensorBoardOutputFormat")("by_hand")
    writer.write({"a": 1.0}, {"a": ()}, 3)
    writer.close()
    for name, options in (("A2C", {}), ("DQN", {"learning_starts": 8, "buffer_size": 100, "batch_size": 4})):
        model = small(lib, vec(lib, Line(THREE)), name, tensorboard_log="logs", **options)
        model.learn(10)
        model.learn(10, tb_log_name="own", reset_num_timesteps=False)
        model.learn(10, tb_log_name="own")
        model.learn(10, tb_log_name="own", reset_num_timesteps=False)
    return sorted({path.parent.as_posix() for path in Path().glob("**/events.out*")})


@case("check_env.warn,skip_render_check")
def checker(lib: Library) -> Any:
    check, results = lib("common.env_checker", "check_env"), []

    class Shown(Line):
        metadata = {"render_modes": ["rgb_array"]}
        render_mode = "rgb_array"

        def render(self) -> np.ndarray:
            rendered.append(1)
            return np.zeros((8, 8, 3), np.uint8)

    for space in (WIDE, BOX):
        for options in ({}, {"warn": False}, {"skip_render_check": False}):
            rendered: list[int] = []
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                check(Shown(space), **options)
            results.append([bool(caught), bool(rendered)])
    return results


class Shares(Images):
    """``Images`` with numbers in [0, 1]."""

    def __init__(self) -> None:
        super().__init__((1, 36, 36))
        self.observation_space = gym.spaces.Box(0.0, 1.0, (1, 36, 36), np.float32)

    def look(self) -> Any:
        return super().look().astype(np.float32)


@case("PPO.policy_kwargs.normalize_images DQN.policy_kwargs.normalize_images", 1e-4)
def images(lib: Library) -> Any:
    results = []
    for name in ("PPO", "DQN"):
        for normalizes in (True, False):
            env = vec(lib, Images((1, 36, 36)) if normalizes else Shares())
            kwargs = {"features_dim": 16, **({} if normalizes else {"normalized_image": True})}
            shape = {"net_arch": [4], "normalize_images": normalizes, "features_extractor_kwargs": kwargs}
            options = {"buffer_size": 50} if name == "DQN" else {"n_steps": 16, "batch_size": 16}
            model = lib.make(name, "CnnPolicy", env, f"{name}{normalizes}", policy_kwargs=shape, **options)
            looks = np.random.default_rng(0).integers(0, 256, (3, 1, 36, 36))
            looks = looks.astype(np.uint8) if normalizes else (looks / 255).astype(np.float32)
            if name == "PPO":
                values = model.policy.evaluate_actions(lib.tensor(looks), lib.tensor(np.arange(3)))
                results += [plain(tensor) for tensor in values[:2]]
            else:
                results.append(
                    plain(model.policy.q_net(lib.tensor(looks))) if lib.is_original else model.q_values(looks)
                )
    return [np.ravel(array) for array in results]


class Same(Line):
    """``Line`` with the same observation and reward in every step."""

    def look(self) -> np.ndarray:
        return np.ones(3, np.float32)

    def step(self, action: Any) -> Any:
        obs, _, *ends = super().step(action)
        return obs, 1.0, *ends


@case("PPO.batch_size TRPO.batch_size")
def batches_on_policy(lib: Library) -> Any:
    """All steps are the same, with gamma=0 also in their advantages, so that only the number of minibatches counts."""
    results = []
    for name, size in (("PPO", 4), ("PPO", 16), ("TRPO", 4), ("TRPO", 16)):
        settings = {**SMALL, **EPOCHS} if name != "TRPO" else {**SMALL, **ROLLOUT, "normalize_advantage": False}
        env = vec(lib, Same(THREE))
        model = lib.make(name, "MlpPolicy", env, f"{name}{size}", **settings | {"batch_size": size, "gamma": 0.0})
        with constant_noise(lib):
            model.learn(16)
        results.append(says(lib, name, model, THREE))
    return results


@case("ARS.zero_policy,delta_std,n_eval_episodes,policy_kwargs")
def first_candidates(lib: Library) -> Any:
    results = []
    for options in ({}, {"zero_policy": False}):
        model = small(lib, vec(lib, Line(THREE, 3)), "ARS", n_delta=2, delta_std=0.0, policy_kwargs={}, **options)
        weights = model.policy.parameters_to_vector()
        results.append([int(np.asarray(weights).size), bool(np.abs(np.asarray(weights)).max() > 0)])
        model.learn(24)  # candidates that do not differ from the policy do not move it
        results.append(bool(np.array_equal(weights, model.policy.parameters_to_vector())))
    for episodes in (1, 2):
        env = Line(THREE, 3)
        small(lib, vec(lib, env), "ARS", n_delta=2, n_eval_episodes=episodes, policy_kwargs={}).learn(12 * episodes)
        results.append(len(env.actions))
    return results


def run_side(name: str, folder: Path, only: list[str]) -> None:
    """Runs the cases in one library and prints what each returned, or its error, as a line of JSON."""
    update_cases()
    lib = Library(name, folder)
    warnings.simplefilter("ignore")
    results: dict[str, Any] = {}
    out = sys.stdout
    for key, (_, program) in CASES.items():
        if only and not any(word in key for word in only):
            continue
        lib.case = key
        with contextlib.redirect_stdout(io.StringIO()), tempfile.TemporaryDirectory() as here:
            back = Path.cwd()
            os.chdir(here)
            try:
                results[key] = json.loads(json.dumps(program(lib), default=lambda x: np.asarray(x).tolist()))
            except Exception as error:
                results[key] = {"error": f"{type(error).__name__}: {error}"[:300]}
            finally:
                os.chdir(back)
        print(key, file=sys.stderr, flush=True)
    print(json.dumps(results), file=out)


def differs(a: Any, b: Any) -> float:
    """Returns the largest difference of numbers, relative to those above 1; infinite where anything else differs."""
    if isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        return max(map(differs, a, b), default=0.0)
    if isinstance(a, dict) and isinstance(b, dict) and a.keys() == b.keys():
        return max((differs(a[key], b[key]) for key in a), default=0.0)
    if isinstance(a, (int, float)) and isinstance(b, (int, float)):
        both = math.isnan(a) and math.isnan(b)
        return 0.0 if a == b or both else abs(a - b) / max(1.0, abs(a)) if math.isfinite(a - b) else math.inf
    return 0.0 if a == b else math.inf


def both(peer: str, only: list[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Returns the results of the cases in the original and in rejeu."""
    with tempfile.TemporaryDirectory() as folder:
        sides = []
        for name, python in (("original", peer), ("rejeu", sys.executable)):
            command = [python, __file__, "--side", name, "--folder", folder, "--only", *only]
            done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
            sides.append(json.loads(done.stdout.strip().splitlines()[-1]))
    return sides[0], sides[1]


DIFFERENT: dict[str, str] = {
    "CrossQ_Box_use_sde": "CrossQ has no use_sde",
    "normalize_advantage": "divided by the standard deviation over n, there over n - 1 (Training)",
    "PPO_Discrete_clip_range1": "a clip range of 0 at the end of the schedule: the ratio 1 passes 0.625 of the gradient, there all of it",
    "clip_range1": "as PPO_Discrete_clip_range1",
    "sub_sampling_factor": "every k-th step in the order of the rollout, there after shuffling",
    "TRPO_Box": "target_kl and cg_damping bound the sum over action dimensions, there their mean",
    "TRPO": "conjugate gradients in another precision",
    "RecurrentPPO_Box_policy_kwargs2": "a critic without LSTM is refused",
    "CrossQ": "the variance of a batch is divided by n, there by n - 1",
    "PPO_Box_policy_kwargs3": "files with use_expln are not read, so the weights cannot be the same",
    "SAC_Box_policy_kwargs5": "as PPO_Box_policy_kwargs3",
    "first_candidates": "zero_policy of ARS counts for a policy without hidden layers, there for each; vectors of parameters have log_std too",
    "checker": "skip_render_check=False did not render, which is mended",
    "noise_types": "noise is float32 in any case, as the actions that it is added to",
    "atari_wrapper": "the last frame of an episode is the maximum of its frames; there a frame of the action before may be in it",
    "exploration": "callbacks see the rate of the next action, there that of the last one",
    "updates_counted": "train_freq is counted from the end of learning_starts, and with n environments in environment steps",
    "logging": "columns of a CSV file are sorted; no line 'Logging to'",
    "checkpoints": "total_timesteps is exact, there a lower bound",
    "evaluating": "returns are not rounded to 6 digits; no warning without Monitor, which is optional here; environments that have played their share are told where episodes start, there always that one does",
}
"""Reasons of the differences, by a part of the case's name; the first that fits. docs/coming-from-sb3.md has them."""
MODULE = "a part of a PyTorch network; those of rejeu are made by policy_kwargs"
BY_HAND = "buffers cannot be made by hand; an agent's are compared in its cases"
NO_EFFECT = "without effect, which a warning says where it matters"
DEFAULT = "other values than the default are refused or warn"
REASONS: dict[str, str] = {
    **dict.fromkeys(("common.distributions.", "maskable.distributions.", "save_util."), "rejeu does not have it"),
    "common.envs.": "environments for the original's own tests, which rejeu does not have",
    **dict.fromkeys((".QNetwork.", ".Actor.", ".ContinuousCritic.", ".Critic.", ".CrossQCritic."), MODULE),
    **dict.fromkeys((".QuantileNetwork.", ".BaseModel.", "torch_layers.", "rmsprop_tf_like", ".BasePolicy."), MODULE),
    **dict.fromkeys(("contrib.common.utils", "recurrent.buffers.pad", ".create_sequencers."), "of PyTorch's tensors"),
    **dict.fromkeys(
        (".MaskableCategorical.", "update_learning_rate", "get_parameters_by_name"), "of PyTorch's tensors"
    ),
    **dict.fromkeys(("obs_as_tensor",), "of PyTorch's tensors"),
    **dict.fromkeys(("common.buffers.", "maskable.buffers.", "recurrent.buffers.", "HerReplayBuffer."), BY_HAND),
    **dict.fromkeys(("recurrent.type_aliases",), BY_HAND),
    **dict.fromkeys(("TrainFrequencyUnit.", "GoalSelectionStrategy."), "arguments of every Python Enum"),
    **dict.fromkeys((".optimize_memory_usage", ".use_sde_at_warmup", ".rollout_buffer_", ".sde_support"), NO_EFFECT),
    **dict.fromkeys((".monitor_wrapper", ".support_multi_env"), NO_EFFECT),
    **dict.fromkeys((".n_lstm_layers", ".lstm_kwargs", ".clip_mean", ".share_features_extractor"), DEFAULT),
    **dict.fromkeys((".batch_norm", ".with_bias"), DEFAULT),
    "maybe_make_env.verbose": "prints that an environment is made",
    ".buffer_size": "transitions there, rows here, of which an episode that ends uses one more (Replay buffers)",
    "features_extractor_kwargs": "arguments of a PyTorch module",
    "AsyncEval": "rejeu does not have it",
    **dict.fromkeys((".tile_images.", ".CloudpickleWrapper.", "vec_env.util."), "internal"),
    **dict.fromkeys((".plot_curves.", ".plot_results."), "a figure for people to look at"),
}
"""Reasons, by a part of module, owner and argument."""
NOT_COMPARABLE = {
    "device": "of PyTorch",
    "_init_setup_model": "internal",
    "policy": "a name or a class; compared in every case",
    "env": "given in every case",
    "lr_schedule": "given by the agent",
    "observation_space": "given by the environment",
    "action_space": "given by the environment",
    "features_extractor": "a PyTorch module",
    "optimizer_class": "a PyTorch class",
    "features_extractor_class": "a PyTorch module",
    "supported_action_spaces": "internal",
}
"""Reasons, by the name of the argument."""


def signatures(packages: dict[str, str]) -> Iterator[tuple[str, str, str]]:
    """Yields module, name and argument of every setting of the installed packages."""
    for package in packages:
        module = importlib.import_module(package)
        for info in pkgutil.walk_packages(module.__path__, f"{package}."):
            try:
                members = vars(importlib.import_module(info.name))
            except ImportError:  # of something optional
                continue
            for key, member in members.items():
                if not callable(member) or key.startswith("_") or getattr(member, "__module__", "") != info.name:
                    continue
                try:
                    parameters = inspect.signature(member).parameters.values()
                except (TypeError, ValueError):
                    continue
                for argument in parameters:
                    if argument.kind not in (argument.VAR_POSITIONAL, argument.VAR_KEYWORD):
                        yield info.name, key, argument.name


def compared(rows: list[dict[str, Any]]) -> dict[str, list[str]]:
    """Returns the results of the cases that compare each ``Class.argument``."""
    results: dict[str, list[str]] = {}
    for row in rows:
        for group in row["settings"].split():
            owner, _, names = group.partition(".")
            for name in names.split(","):
                results.setdefault(f"{owner}.{name}", []).append(row["result"])
                results.setdefault(f"{owner}.{name.removeprefix('policy_kwargs.')}", []).append(row["result"])
    return results


ON_POLICY = ("A2C", "PPO", "TRPO", "ARS", "RecurrentPPO", "MaskablePPO", "OnPolicyAlgorithm", "ActorCritic", "ars")
"""Parts of the names of algorithms and policies that have no replay buffer."""


def definition_of(module: str, owner: str, argument: str) -> str | None:
    """Returns the name of the code of ours that takes an argument; None if there is none.

    The settings of algorithms are the fields of their configurations, each of which one class defines, or arguments of all
    agents; those of policies, that all go to ``policy_kwargs``, are the same for algorithms with replay and for those without.
    """
    package, _, path = module.partition(".")
    family = "on policy" if any(word in f"{path}.{owner}" for word in ON_POLICY) else "off policy"
    if owner.endswith("Algorithm"):
        return f"{family}, any {argument}"
    try:
        definition = getattr(importlib.import_module(f"{PACKAGES[package]}.{path}".rstrip(".")), owner)
    except (ImportError, AttributeError):
        return None
    from rejeu.algorithms.config import OffPolicyConfig
    from rejeu.sb3 import algorithms, arguments, policy

    if isinstance(definition, str):  # of a policy
        return f"{family}, policy_kwargs.{argument}"
    if isinstance(definition, type) and issubclass(definition, algorithms.Original):
        config = definition.algorithm.Config
        family = "off policy" if issubclass(config, OffPolicyConfig) else "on policy"
        places = [base for base in config.__mro__ if argument in vars(base).get("__annotations__", {})]
        if places:
            module_name = places[-1].__module__.rpartition("rejeu.algorithms.")[2]
            return f"{family}, {'any' if module_name.endswith('config') else module_name} {argument}"
        shared_arguments = {*algorithms.AGENT_ARGUMENTS, *arguments.WITHOUT_EFFECT, "use_sde", "sde_sample_freq"}
        return f"{family}, {'any ' if argument in shared_arguments else 'policy_kwargs.'}{argument}"
    if isinstance(definition, type) and issubclass(definition, policy.BaseModel):
        prefixes = {
            "n_critics": "any ",
            "use_sde": "any ",
            "n_quantiles": f"{path.partition('.')[0]} ",
        }  # not of policy_kwargs
        return f"{family}, {prefixes.get(argument, 'policy_kwargs.')}{argument}"
    if isinstance(definition, type):
        if issubclass(definition, tuple):
            return f"{definition.__mro__[-3].__qualname__}.{argument}"
        definition = next(
            (vars(base)["__init__"] for base in definition.__mro__ if "__init__" in vars(base)), definition
        )
    names = inspect.signature(definition).parameters
    takes = argument in names or any(
        parameter.kind in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL) for parameter in names.values()
    )
    return (
        f"{getattr(definition, '__module__', '')}.{getattr(definition, '__qualname__', definition)}.{argument}"
        if takes
        else None
    )


def states_of(settings: list[tuple[str, str, str]], results: dict[str, list[str]]) -> list[str]:
    """Returns the state of each setting: compared itself, or by another one that the same code of ours takes.

    Where that differs with one algorithm and is equal with another, the difference is not of this setting.
    """
    codes = [definition_of(*setting) for setting in settings]
    by_code: dict[str, set[str]] = {}
    modules = {owner: module for module, owner, _ in settings}
    for key, outcomes in results.items():
        owner, _, argument = key.partition(".")
        if owner in modules and (code := definition_of(modules[owner], owner, argument)) is not None:
            by_code.setdefault(code, set()).add("equal" if {*outcomes} == {"equal"} else "different")
    states = []
    for code, (module, owner, argument) in zip(codes, settings, strict=True):
        outcomes = {*results.get(f"{owner}.{argument}", ())}
        places = (
            [code] if owner != "BaseAlgorithm" else [f"{family} policy, any {argument}" for family in ("on", "off")]
        )
        same = (
            {result for place_code in places for result in by_code.get(place_code, ())} if code is not None else set()
        )
        if outcomes:
            states.append("equal" if outcomes == {"equal"} else "different")
        elif same:
            states.append(f"{'equal' if 'equal' in same else 'different'}: by the same code")
        elif reason := next(
            (text for pattern, text in REASONS.items() if pattern in f"{module}.{owner}.{argument}"), ""
        ):
            states.append(f"not comparable: {reason}")
        elif argument in NOT_COMPARABLE:
            states.append(f"not comparable: {NOT_COMPARABLE[argument]}")
        else:
            states.append("not compared" if code is not None else "not compared: not in rejeu")
    return states


def result_row(name: str, original: Any, ours: Any) -> dict[str, Any]:
    """Returns the row of a case in the file of results."""
    gap = differs(original, ours)
    same = gap <= TOLERANCES.get(name, TOLERANCE)
    reason = "" if same else next((text for pattern, text in DIFFERENT.items() if pattern in name), "not explained yet")
    errors = [side["error"] for side in (original, ours) if isinstance(side, dict) and "error" in side]
    row = {"case": name, "settings": CASES[name][0], "result": "equal" if same else "different", "commit": commit()}
    return {
        **row,
        "difference": gap if math.isfinite(gap) else "other",
        "why": "; ".join([reason, *errors]).strip("; "),
    }


def report(
    peer: str, original: dict[str, Any], ours: dict[str, Any], recorded_rows: list[dict[str, Any]]
) -> dict[str, Any]:
    """Returns the content of the file of results, with the rows of cases that did not run now."""
    earlier = {row["case"]: row for row in recorded_rows if row["case"] in CASES and row["case"] not in original}
    rows = [result_row(name, original[name], ours[name]) for name in original]
    rows = [
        earlier.get(name) or next(row for row in rows if row["case"] == name)
        for name in CASES
        if name in earlier or name in original
    ]
    listed = subprocess.run([peer, __file__, "--list"], stdout=subprocess.PIPE, text=True, check=True).stdout
    results = compared(rows)
    every_one = json.loads(listed.strip().splitlines()[-1])
    settings = [
        {"setting": f"{owner}.{argument}", "state": state}
        for (_, owner, argument), state in zip(every_one, states_of(every_one, results), strict=True)
    ]
    by_state: dict[str, list[str]] = {}
    for setting in settings:
        by_state.setdefault(setting["state"], []).append(setting["setting"])
    every = {state: " ".join(names) for state, names in sorted(by_state.items())}
    counts = Counter(setting["state"].partition(":")[0] for setting in settings)
    cases = Counter(row["result"] for row in rows)
    return {
        **provenance({word: "PATH" if word == peer else "FILE" for word in sys.argv[1:] if word[:2] != "--"}),
        "settings": dict(counts),
        "cases": dict(cases),
        "all": every,
        "rows": rows,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--peer", default=sys.executable)
    parser.add_argument("--raw", type=Path, nargs="*", help="results of --keep to join instead of running")
    parser.add_argument("--keep", type=Path, help="file for what both libraries returned")
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--join", action="store_true", help="take the other cases from the file of results")
    parser.add_argument("--side", choices=["original", "rejeu"])
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--list", action="store_true")
    options = parser.parse_args()
    if options.list:
        print(json.dumps([*signatures(PACKAGES)]))
        return
    if options.side:
        run_side(options.side, options.folder, options.only)
        return
    original: dict[str, Any] = {}
    ours: dict[str, Any] = {}
    if options.raw:
        update_cases()
        for path in options.raw:
            for all_of, some in zip((original, ours), json.loads(path.read_text()), strict=True):
                all_of.update(some)
    else:
        update_cases()
        original, ours = both(options.peer, options.only)
    if options.keep:
        options.keep.write_text(json.dumps([original, ours]))
    recorded_rows = json.loads(RESULTS.read_text())["rows"] if options.join else []
    content = report(options.peer, original, ours, recorded_rows)
    for row in content["rows"]:
        print(f"{row['case']:45} {row['result']:10} {row['difference']} {row['why'][:150]}")
    print(content["settings"], content["cases"])
    if not options.only or options.join:
        write(RESULTS, content, "rows")


if __name__ == "__main__":
    main()
