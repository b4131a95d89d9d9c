"""A policy with its environment as one page of HTML, which acts in a browser without a network."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax import Array, ShapeDtypeStruct

from rejeu.core import spaces
from rejeu.core.types import JsonObject, PyTree
from rejeu.envs import functional
from rejeu.envs.functional import FunctionalEnv
from rejeu.export.check import Run
from rejeu.export.contract import Exportable, Policy
from rejeu.export.loops import TEMPLATES, Language, Printer, indented, memory
from rejeu.export.program import TracedProgram, trace

ENVIRONMENTS = {
    name: f"jax/{name.removeprefix('rejeu/')}"
    for name in ("CartPole-v1", "Pendulum-v1", "MountainCar-v0", "MountainCarContinuous-v0", "rejeu/Ball-v0")
} | {"parking-v0": "jax/Parking-v0"}
"""Environments that a page can contain, with the ids of their equals in JAX, which it contains too."""
NUMBERS = ("float32", "int8", "int16", "int32", "uint8", "uint16", "uint32")
TYPES = {name: f"{name.capitalize()}Array" for name in NUMBERS} | {"bool": "Uint8Array"}
JAVASCRIPT = Language("JavaScript", TYPES)
KEY = ShapeDtypeStruct((2,), np.uint32)


def environment(env_id: str | None, kwargs: Mapping[str, object]) -> FunctionalEnv:
    """Returns the environment in JAX that a page contains.

    Raises:
        ValueError: if a page cannot contain it.
    """
    name = env_id if env_id in ENVIRONMENTS.values() else ENVIRONMENTS.get(env_id or "")
    if name is None or kwargs.get("dimension", 2) != 2:
        unnamed = "an environment that was given as an object (name it: agent.set_env(ID), --env ID)"
        description = f"{env_id}{dict(kwargs) or ''}" if env_id else unnamed
        raise ValueError(
            f"a page cannot contain {description}; it can contain {', '.join(ENVIRONMENTS)} in two dimensions"
        )
    try:
        return functional.make(name, **kwargs)
    except TypeError:
        raise ValueError(f"a page cannot contain {env_id} with the arguments {', '.join(kwargs)}") from None


def script(policy: Policy, env: FunctionalEnv, card: JsonObject) -> str:
    """Returns the policy and the environment as JavaScript.

    Raises:
        ValueError: if the policy does not take the observations of the environment alone, or cannot be written.
    """
    expected = [(leaf.path or "observation", leaf.shape) for leaf in spaces.leaves(env.observation_space)]
    if expected != [(port.name, port.shape) for port in policy.inputs if port.role in ("observation", "action_mask")]:
        raise ValueError("a page cannot contain a policy with wrappers around its environment, frame stacks or masks")
    action = policy.outputs[0]
    state, obs = jax.eval_shape(env.reset, KEY)
    action_input = ShapeDtypeStruct(action.shape, spaces.narrow(action.dtype))

    def step(state: PyTree, action: Array, key: Array) -> PyTree:
        return env.step(key, state, action)

    reset, stepped = trace(env.reset, KEY, draws=True), trace(step, state, action_input, KEY, draws=True)
    description = {
        "environment": type(env).__name__,
        "card": card,
        "n_state": len(jax.tree.leaves(state)),
        "n_obs": len(jax.tree.leaves(obs)),
        "memory": [math.prod(port.shape) for port in policy.of("state")],
        "reset_draws": draws_of(reset),
        "step_draws": draws_of(stepped),
    }
    constant = json.dumps(description).replace("<", "\\u003c")
    functions = (("policy", policy.program), ("resetWorld", reset), ("stepWorld", stepped))
    parts = [function(name, program) for name, program in functions]
    shared = (TEMPLATES / "web.js").read_text(encoding="utf-8")
    return "\n".join(['"use strict";', f"const ABOUT = {constant};", *parts, shared])


def write(script: str) -> bytes:
    """Returns the page with a script."""
    return (TEMPLATES / "web.html").read_text(encoding="utf-8").replace("/* script */", script).encode()


def files(source: Exportable) -> tuple[tuple[bytes, ...], Run | None]:
    """Returns the page, and the run of its policy."""
    code = script(source.single, environment(source.env_id, source.env_kwargs), source.card)
    return (write(code),), node_run(source.single, code)


def node_run(policy: Policy, script: str) -> Run | None:
    """Returns the run of a policy in JavaScript; None without Node.js."""
    if shutil.which("node") is None:
        return None

    def run(inputs: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        n = len(next(iter(inputs.values())))
        observation_ports = [port.name for port in policy.inputs if port.role == "observation"]
        starts = next((inputs[port.name] for port in policy.of("episode_start")), np.zeros(n, bool)).tolist()
        rows = [([inputs[name][i].ravel().tolist() for name in observation_ports], starts[i]) for i in range(n)]
        actions, seconds = node(script + (TEMPLATES / "node.js").read_text(encoding="utf-8"), rows)
        action = policy.outputs[0]
        return np.array(actions, action.dtype).reshape(n, *action.shape), np.array(seconds)

    return run


def node(script: str, message: object) -> Any:
    """Returns the JSON value that a script writes to standard output, when it reads ``message`` from standard input."""
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "main.js"
        path.write_text(script, encoding="utf-8")
        sent = json.dumps(message)
        completed = subprocess.run(["node", path], input=sent, capture_output=True, text=True, check=True)
    return json.loads(completed.stdout)


def draws_of(program: TracedProgram) -> list[tuple[str, int]]:
    """Returns distribution and number of the random numbers that a program takes."""
    return [(draw_name, math.prod(value.sizes)) for draw_name, value in program.draws]


def function(name: str, program: TracedProgram) -> str:
    """Returns a function from arrays to arrays."""
    printer, arguments = Printer(JAVASCRIPT), [f"a{i}" for i in range(len(program.arguments))]
    results: list[str] = []
    for value, result in zip(program.outputs, printer.run(program, arguments), strict=True):
        out = memory(f"out{len(results)}", result.shape, value.dtype)
        results.append(out.name)
        printer.lines.append(f"const {out.name} = {array(out.dtype, max(math.prod(out.shape), 1))};")
        printer.copy(result, out)
    lines = [
        f"const {name} = (() => {{",
        *(f"const {key} = {array(str(data.dtype), numbers(data))};" for key, data in printer.constants.items()),
        *(f"const {key} = {array(dtype, n)};" for key, dtype, n in printer.buffers),
        f"return ({', '.join(arguments)}) => {{",
        *printer.lines,
        f"return [{', '.join(results)}];",
        "};",
        "})();",
    ]
    return indented(lines, 0)


def array(dtype: str, content: int | Sequence[float]) -> str:
    """Returns a new array of a number of zeros, or of numbers."""
    return f"new {TYPES[dtype]}({json.dumps(content)})"


def numbers(data: np.ndarray) -> list[float]:
    """Returns the elements of an array, with as many digits as float32 needs."""
    is_float = data.dtype.kind == "f"
    return [float(f"{number:.9g}") if is_float else int(number) for number in data.ravel().tolist()]
