"""Stable-Baselines3's arguments as those of rejeu's agents."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

from rejeu.agents import Agent
from rejeu.algorithms import config as configs
from rejeu.algorithms.config import REPLAY_BUFFERS
from rejeu.checkpoints.agent_state import AGENT_ARGUMENTS
from rejeu.core import validation
from rejeu.core.types import Arguments, Settings
from rejeu.sb3.common import buffers, utils
from rejeu.sb3.common.noise import VectorizedActionNoise
from rejeu.sb3.common.torch_layers import encoder_of, is_torch

WITHOUT_EFFECT = (
    "_init_setup_model",
    "optimize_memory_usage",
    "use_sde_at_warmup",
    "rollout_buffer_class",
    "rollout_buffer_kwargs",
    "monitor_wrapper",
    "support_multi_env",
)
"""Arguments that mean nothing here and are accepted with any value; those in ``NEUTRAL`` warn of other values."""
NEUTRAL: dict[str, tuple[Any, ...]] = {
    "use_sde": (False,),
    "use_sde_at_warmup": (False,),
    "rollout_buffer_class": (None,),
    "rollout_buffer_kwargs": (None, {}),
    "sde_sample_freq": (-1,),
    "squash_output": (False, True),
    "use_expln": (False,),
    "full_std": (True,),
    "clip_mean": (2.0,),
    "log_std_init": (0.0, -3, -2),
    "share_features_extractor": (False,),
    "n_critics": (1,),
    "ortho_init": (True, False),
    "n_lstm_layers": (1,),
    "lstm_kwargs": (None, {}),
    "enable_critic_lstm": (True,),
}
"""Settings that some algorithms do not have, with the values that they would have there."""
OPTIMIZERS: dict[str, Settings] = {
    "Adam": {"name": "adam"},
    "AdamW": {"name": "adamw", "weight_decay": 1e-2},
    "NAdam": {"name": "nadam"},
    "RAdam": {"name": "radam"},
    "RMSprop": {"name": "rmsprop", "decay": 0.99, "eps": 1e-8, "eps_in_sqrt": False},
    "RMSpropTFLike": {"name": "rmsprop", "decay": 0.99, "eps": 1e-8, "initial_scale": 1.0},
    "SGD": {"name": "sgd"},
}
"""Optimizers by the names of PyTorch's classes, with the settings by which they differ from Optax's."""
OFF_POLICY = ("learning_rate", "buffer_size", "learning_starts", "batch_size", "tau", "gamma", "train_freq")
POSITIONAL = {
    "PPO": ("learning_rate", "n_steps", "batch_size", "n_epochs", "gamma", "gae_lambda", "clip_range"),
    "A2C": ("learning_rate", "n_steps", "gamma", "gae_lambda", "ent_coef", "vf_coef", "max_grad_norm"),
}
"""Arguments after ``policy`` and ``env`` by position."""


def converted(agent_class: type[Agent], settings: Mapping[str, object]) -> Settings:
    """Returns keyword arguments of the constructor or of ``load`` as rejeu's agent takes them."""
    config = agent_class.algorithm.Config
    setting_names = {*validation.field_names(config), *AGENT_ARGUMENTS}
    result: Settings = {}
    for key, value in settings.items():
        if key in WITHOUT_EFFECT or (key not in setting_names and value in NEUTRAL.get(key, ())):
            if value not in NEUTRAL.get(key, (value,)):
                unsupported(key, value)
            continue
        result[key] = utils.of_progress(value) if configs.takes_schedule(config, key) else value
    if isinstance(result.get("priorities"), Mapping):
        result["priorities"] = {key: utils.of_progress(value) for key, value in result["priorities"].items()}
    if isinstance(noise := result.get("action_noise"), VectorizedActionNoise):
        result["action_noise"] = noise.base_noise
    if result.get("use_sde") and result.get("action_noise") is not None:
        unsupported("action_noise", result.pop("action_noise"), "is not used: use_sde=True explores by itself")
    if isinstance(frequency := result.get("train_freq"), tuple):
        result["train_freq"] = tuple(getattr(unit, "value", unit) for unit in frequency)
    if "device" in result:
        result["device"] = "auto" if result["device"] is None else str(result["device"])
    convert_buffer(result)
    if isinstance(result.get("policy_kwargs"), Mapping):
        shape, others = shape_of(agent_class, result["policy_kwargs"])
        result = others | result | {"policy_kwargs": shape}
    return result


def convert_buffer(settings: Settings) -> None:
    """Replaces the settings of a replay buffer by rejeu's."""
    buffer, options = (settings.get("replay_buffer_class"), dict(settings.get("replay_buffer_kwargs") or {}))
    if isinstance(buffer, type) and issubclass(buffer, buffers.ReplayBuffer):
        if buffer.__name__ not in REPLAY_BUFFERS and buffer.__module__ != buffers.__name__:
            raise TypeError(
                f"replay_buffer_class={buffer.__name__}: a class of your own derives from rejeu.ReplayBuffer, "
                "which stores every observation once; the classes of rejeu.sb3.common.buffers show an agent's"
            )
        if buffer is buffers.NStepReplayBuffer:
            settings["n_steps"] = options.pop("n_steps", settings.get("n_steps", 3))
            settings["gamma"] = options.pop("gamma", settings.get("gamma", 0.99))
        settings["replay_buffer_class"] = "HerReplayBuffer" if buffer is buffers.HerReplayBuffer else "ReplayBuffer"
    if options.pop("handle_timeout_termination", True) is False:
        unsupported(
            "handle_timeout_termination",
            False,
            "is not followed for vector environments: wrap theirs in TimeLimitTerminates",
        )
    options.pop("optimize_memory_usage", None)
    if "replay_buffer_kwargs" in settings:
        settings["replay_buffer_kwargs"] = options or None


def shape_of(agent_class: type[Agent], policy_kwargs: Arguments) -> tuple[Settings, Settings]:
    """Returns ``policy_kwargs`` as rejeu takes them, and the hyperparameters that they contain."""
    config = agent_class.algorithm.Config
    fields, names = (validation.field_names(owner) for owner in (config.policy_kwargs_class, config))
    shape: Settings = {}
    others: Settings = {}
    for key, value in policy_kwargs.items():
        if key in ("features_extractor_class", "optimizer_class", "features_extractor_kwargs", "optimizer_kwargs"):
            continue
        if key == "net_arch" and value is not None:
            shape[key] = layers_of(value)
        elif key == "activation_fn" and value is not None:
            value = type(value) if is_torch(value) and not isinstance(value, type) else value
            shape[key] = {"LeakyReLU": "leaky_relu"}.get(getattr(value, "__name__", ""), value)
        elif key == "log_std_init" and "sde_log_std_init" in names:
            others["sde_log_std_init"] = value
        elif key in fields:
            shape[key] = value
        elif key in names:
            others[key] = value
        elif key not in NEUTRAL:
            shape[key] = value  # an error that suggests a name
        elif value not in NEUTRAL[key]:
            unsupported(key, value)
    normalizes = policy_kwargs.get("normalize_images", True)
    settings = policy_kwargs.get("features_extractor_kwargs") or {}
    shape |= encoder_of(policy_kwargs.get("features_extractor_class"), settings, normalizes)
    optimizer = optimizer_of(policy_kwargs.get("optimizer_class"), policy_kwargs.get("optimizer_kwargs") or {})
    others |= {} if optimizer is None else {"optimizer": optimizer}
    return {key: value for key, value in shape.items() if value is not None}, others


def unsupported(name: str, value: object, effect: str = "has no effect") -> None:
    """Warns that a setting of Stable-Baselines3 is not followed."""
    warnings.warn(f"{name}={value!r} {effect} in rejeu; see docs/coming-from-sb3.md", UserWarning, stacklevel=5)


def optimizer_of(optimizer_class: Any, settings: Mapping[str, Any]) -> Any:
    """Returns the setting ``optimizer`` for a class of PyTorch's, its name, or one of Optax, and its arguments."""
    label = optimizer_class if isinstance(optimizer_class, str) else getattr(optimizer_class, "__name__", "")
    defaults = OPTIMIZERS.get(label)
    if defaults is None and is_torch(optimizer_class):
        raise TypeError(
            f"optimizer_class={label or optimizer_class} is of PyTorch; use one of {', '.join(OPTIMIZERS)}, or give "
            "the agent one of Optax: optimizer=optax.lamb"
        )
    if defaults is None:
        return optimizer_class if optimizer_class is not None else {"name": "adam", **settings} if settings else None
    renamed = {"alpha": "decay"}
    args = {renamed.get(key, key): value for key, value in settings.items() if key not in ("lr", "betas", "centered")}
    if "betas" in settings:
        args["b1"], args["b2"] = settings["betas"]
    if args.pop("amsgrad", False):
        args["name"] = "amsgrad"
    return {**defaults, **args} if len(defaults | args) > 1 else defaults["name"]


def layers_of(net_arch: Any) -> Any:
    """Returns ``net_arch`` as rejeu takes it."""
    if isinstance(net_arch, list | tuple) and net_arch and isinstance(net_arch[-1], Mapping):
        warnings.warn(
            "net_arch=[dict(...)] is net_arch=dict(...) since Stable-Baselines3 1.8", UserWarning, stacklevel=6
        )
        net_arch = net_arch[-1]
    if isinstance(net_arch, Mapping):
        others = ("qf",) if "qf" in net_arch else ("vf",)
        return {key: list(net_arch.get(key, ())) for key in ("pi", *others)}
    return list(net_arch)
