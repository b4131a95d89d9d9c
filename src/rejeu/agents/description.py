"""The docstring and signature of an agent class, made from the configuration of its algorithm when they are asked for."""

from __future__ import annotations

import inspect
from typing import Any

from rejeu import validation

AGENT_ARGUMENTS = {
    "policy": "``MlpPolicy``, ``MultiInputPolicy`` (Dict observations) or ``CnnPolicy`` (images). All three build what "
    "the observation space needs; a name that does not fit the space is an error.",
    "env": "An id, a Gymnasium environment, a function that makes one, or a vector environment.",
    "seed": "Seeds everything: networks, exploration, batches and environments. None draws one.",
    "verbose": "0 is silent, 1 prints a table of statistics every ``log_interval`` episodes.",
    "tensorboard_log": "Folder for TensorBoard logs, None for none.",
    "stats_window_size": "Episodes over which reported means are taken.",
    "success_threshold": "Return from which on an episode counts as a success where the environment does not say; None: "
    "the environment's own reward threshold, if it has one.",
    "best_window": "Training episodes over whose mean return the best weights are kept; 1 keeps those of the best single "
    "episode. Raising it is surer to find a policy that is good again, as a single return may be luck.",
    "device": "Accepted for Stable-Baselines3's sake: JAX chooses the device (environment variable JAX_PLATFORMS).",
}
"""What every agent takes beside its hyper-parameters, with its meaning."""


class Documentation:
    """A class attribute ``__doc__``: the docstring of the class, of its configuration and of every hyperparameter."""

    def __init__(self, text: str | None) -> None:
        self.text = inspect.cleandoc(text or "")

    def __get__(self, instance: Any, owner: type) -> str:
        config = owner.algorithm.Config  # type: ignore[attr-defined]
        docs = validation.field_docs(config)
        lines = [f"    {key}: {text}" for key, text in AGENT_ARGUMENTS.items()]
        for key, default in validation.field_defaults(config).items():
            text = f"{docs[key]} " if key in docs else ""
            lines.append(
                f"    {key}: {text}" + ("" if default is inspect.Parameter.empty else f"Default: {default!r}.")
            )
        about = inspect.cleandoc(config.__doc__ or "")
        return "\n".join([self.text, "", about, "", "Args:", *lines])


class Signature:
    """A class attribute ``__signature__``: what every agent takes, then the hyperparameters."""

    def __init__(self, common: inspect.Signature) -> None:
        self.common = common
        """Of an agent's constructor, whose last parameter stands for the hyperparameters."""

    def __get__(self, instance: Any, owner: type) -> inspect.Signature:
        config = owner.algorithm.Config  # type: ignore[attr-defined]
        hyperparameters = [
            inspect.Parameter(key, inspect.Parameter.KEYWORD_ONLY, default=default)
            for key, default in validation.field_defaults(config).items()
        ]
        return inspect.Signature([*list(self.common.parameters.values())[1:-1], *hyperparameters])


class ClassOnly:
    """Makes ``load`` raise an error on an instance, where it would silently leave that instance as it was."""

    def __init__(self, method: Any) -> None:
        self.method = method
        self.__doc__ = method.__func__.__doc__

    def __get__(self, instance: Any, owner: type) -> Any:
        if instance is not None:
            raise TypeError(
                f"load is called on the class and returns a new agent: agent = {owner.__name__}.load(path); "
                "to change this one in place use agent.set_parameters(path)"
            )
        return self.method.__get__(None, owner)
