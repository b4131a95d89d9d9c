"""How an agent's class shows itself: signature and docstring from its configuration, and ``load`` on the class only."""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Any

from rejeu import validation
from rejeu.agents.model_files import AGENT_ARGUMENTS

if TYPE_CHECKING:
    from rejeu.agents.base import Agent


def describe(cls: type[Agent], common: inspect.Signature) -> None:
    """Writes signature and docstring of an agent's class from the configuration of its algorithm.

    Args:
        cls: the class; its docstring and its signature are replaced.
        common: what every agent takes, whose last parameter stands for the hyper-parameters.
    """
    config = cls.algorithm.Config
    docs = validation.field_docs(config)
    lines = [f"{(config.__doc__ or '').strip()}", "", "Args:"]
    lines += [f"    {key}: {text}" for key, text in AGENT_ARGUMENTS.items()]
    defaults = config()
    parameters = list(common.parameters.values())[:-1]
    for key in validation.field_names(config):
        default = getattr(defaults, key)
        lines.append(f"    {key}: {docs[key]} Default: {default!r}.")
        parameters.append(inspect.Parameter(key, inspect.Parameter.KEYWORD_ONLY, default=default))
    cls.__doc__ = "\n".join([f"{(cls.__doc__ or '').strip()}", "", *lines])
    cls.__signature__ = inspect.Signature(parameters[1:])  # type: ignore[attr-defined]


class ClassOnly:
    """Makes ``load`` refuse to be called on an instance, where it would silently leave that instance as it was."""

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
