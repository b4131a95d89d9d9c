"""The docstring and the signature of an agent's class, made of its configuration when they are asked for."""

from __future__ import annotations

import inspect

from rejeu.checkpoints.agent_state import AGENT_ARGUMENTS
from rejeu.core import validation


class Documentation:
    """A class attribute ``__doc__``: the docstring of the class, of its configuration and of every hyperparameter."""

    def __init__(self, text: str | None) -> None:
        self.text = inspect.cleandoc(text or "")

    def __get__(self, instance: object, owner: type) -> str:
        config = owner.algorithm.Config  # type: ignore[attr-defined]
        docs = validation.field_docs(config)
        lines = [f"    {key}: {text}" for key, text in AGENT_ARGUMENTS.items()]
        for key, default in validation.field_defaults(config).items():
            text = f"{docs[key]} " if key in docs else ""
            has_default = default is not inspect.Parameter.empty
            lines.append(f"    {key}: {text}" + f"Default: {default!r}." * has_default)
        config_text = inspect.cleandoc(config.__doc__ or "")
        return "\n".join([self.text, "", config_text, "", "Args:", *lines])


class Signature:
    """A class attribute ``__signature__``: what every agent takes, then the hyperparameters."""

    def __init__(self, common: inspect.Signature) -> None:
        self.common = common
        """Of an agent's constructor, whose last parameter stands for the hyperparameters."""

    def __get__(self, instance: object, owner: type) -> inspect.Signature:
        config = owner.algorithm.Config  # type: ignore[attr-defined]
        hyperparameters = [
            inspect.Parameter(key, inspect.Parameter.KEYWORD_ONLY, default=default)
            for key, default in validation.field_defaults(config).items()
        ]
        return inspect.Signature([*list(self.common.parameters.values())[1:-1], *hyperparameters])
