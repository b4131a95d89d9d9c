"""Counts everything that is called on five paths through the package, and compares it with ``docs/design.md``.

    python scripts/paths.py
    python scripts/paths.py --list     # prints the functions too, in the order in which they are called first
    python scripts/paths.py --write

Real steps of each path run under a profiler. Each function of the package that is called counts with all its lines, and with
the functions inside it, except those of ``EXEMPT``, which every path shares. Exits with status 1 if a path has more files or
lines than the page says, or more than the page allows. ``--write`` puts the measured numbers into the page.
"""

from __future__ import annotations

import ast
import inspect
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import rejeu
from rejeu.lab import cli
from rejeu.training.compiled import Stops, train_one
from rejeu.training.off_policy import off_policy
from rejeu.training.on_policy import on_policy

PACKAGE = Path(rejeu.__file__).parent
DESIGN = PACKAGE.parent.parent / "docs" / "design.md"
EXEMPT = ("core/algorithm.py", "networks/", "core/spaces.py", "core/distributions.py", "core/prng.py")
"""The vocabulary of the package: types, layers, spaces, distributions and random keys."""
TABLE = re.compile(r"(<!-- paths -->\n)(.*?)(<!-- end of paths -->)", re.DOTALL)
ROW = re.compile(r"^\| ([^|]+?) \| (\d+) \| ([\d,]+) \| (\d+) \| ([\d,]+) \|$", re.MULTILINE)
"""Path, files and lines, and the most of each."""
Called = dict[tuple[str, str], None]
"""Files and outermost names of functions, in the order of their first calls."""
SMALL = {"policy_kwargs": {"net_arch": [8]}, "seed": 0}


class Reached(BaseException):
    """Raised when the last function of a trace is called."""


class Reach(gym.Env):
    """A goal environment: move a point to a place on a line."""

    def __init__(self) -> None:
        box = gym.spaces.Box(-9.0, 9.0, (1,), np.float32)
        self.observation_space = gym.spaces.Dict(observation=box, achieved_goal=box, desired_goal=box)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def _observation(self) -> dict[str, np.ndarray]:
        return {"observation": self.place, "achieved_goal": self.place, "desired_goal": np.ones(1, np.float32)}

    def reset(self, **options: Any) -> Any:
        super().reset(**options)
        self.place, self.n_steps = np.zeros(1, np.float32), 0
        return self._observation(), {}

    def step(self, action: np.ndarray) -> Any:
        self.place, self.n_steps = self.place + np.float32(0.1) * action, self.n_steps + 1
        observation = self._observation()
        reward = self.compute_reward(self.place, observation["desired_goal"], {})
        return observation, float(reward), False, self.n_steps == 4, {}

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> np.ndarray:
        """Returns 0 close to the goal and -1 elsewhere."""
        return -(np.abs(achieved - desired)[..., 0] > 0.2).astype(np.float32)


@contextmanager
def tracing(called: Called, until: Callable[..., Any] | None = None) -> Iterator[None]:
    """Adds the file and the outermost name of every function of the package that is called."""
    prefix = str(PACKAGE)

    def trace(frame: Any, event: str, argument: Any) -> None:
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(prefix):
            if until is not None and code is until.__code__:
                sys.setprofile(None)
                raise Reached
            name = code.co_qualname.partition(".<")[0]
            if code.co_flags & inspect.CO_NEWLOCALS and not name.startswith("<"):  # not the body of a class
                called.setdefault((Path(code.co_filename).relative_to(PACKAGE).as_posix(), name))

    sys.setprofile(trace)
    try:
        yield
    finally:
        sys.setprofile(None)


def trace_loop(agent: Any, loop: Any, n_turns: int) -> Called:
    """Returns the functions called by some turns of a loop."""
    called: Called = {}
    with tracing(called):
        for _ in loop(agent.run, agent.learner, agent.config, n_turns, lambda step: 0.0):
            pass
    return called


def trace_sac() -> Called:
    """Returns the functions called by turns of SAC: random and policy actions, updates, and the end of an episode."""
    env = gym.make("Pendulum-v1", max_episode_steps=4)
    agent = rejeu.SAC("MlpPolicy", env, learning_starts=4, batch_size=4, **SMALL)
    return trace_loop(agent, off_policy, 10)


def trace_sac_on_device() -> Called:
    """Returns the functions called by the first chunk of SAC on the device, which is traced."""
    env = rejeu.make_vector("jax/Pendulum-v1", 2)
    agent = rejeu.SAC("MlpPolicy", env, learning_starts=4, batch_size=4, **SMALL)
    loop, called = train_one(agent.run, agent.learner, agent.config, 16, lambda step: 0.0, Stops()), Called()
    with tracing(called):
        next(loop)
    loop.close()
    return called


def trace_ppo() -> Called:
    """Returns the functions called by two rollouts of PPO."""
    env = gym.make("Pendulum-v1", max_episode_steps=3)
    agent = rejeu.PPO("MlpPolicy", env, n_steps=8, batch_size=4, n_epochs=1, **SMALL)
    return trace_loop(agent, on_policy, 17)


def trace_her() -> Called:
    """Returns the functions called by sampling a relabeled batch."""
    buffer = {"replay_buffer_class": "HerReplayBuffer", "learning_starts": 10}
    agent = rejeu.SAC("MultiInputPolicy", Reach(), **buffer, **SMALL)
    agent.learn(9)
    called: Called = {}
    with tracing(called):
        for _ in range(2):
            agent.run.replay.draw(agent.run.rng, (8,), 0.0)
    return called


def trace_train() -> Called:
    """Returns the functions called by ``rejeu train`` before the loop starts."""
    called: Called = {}
    with tempfile.TemporaryDirectory() as folder:
        words = ["train", "Pendulum-v1", "--algo", "SAC", "--steps", "2", "--out", f"{folder}/run", "--set"]
        with suppress(Reached), redirect_stdout(None), tracing(called, until=off_policy):
            cli.main([*words, "policy_kwargs.net_arch=[8]"])
    return called


TRACES = {
    "SAC": trace_sac,
    "PPO": trace_ppo,
    "HER": trace_her,
    "SAC on the device": trace_sac_on_device,
    "rejeu train": trace_train,
}


def lengths(path: Path) -> dict[str, int]:
    """Returns the number of lines of each function, class and method of a file, decorators included."""
    lines_by_name: dict[str, int] = {}

    def visit(node: ast.AST, prefix: str) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.FunctionDef | ast.ClassDef):
                first = min([child.lineno, *(decorator.lineno for decorator in child.decorator_list)])
                lines_by_name[prefix + child.name] = (child.end_lineno or first) - first + 1
                if isinstance(child, ast.ClassDef):
                    visit(child, f"{prefix}{child.name}.")

    visit(ast.parse(path.read_text(encoding="utf-8")), "")
    return lines_by_name


def counted(called: Called) -> dict[str, dict[str, int]]:
    """Returns the lines of each function that counts, by file."""
    functions_by_file: dict[str, dict[str, int]] = {}
    for file, name in called:
        if not file.startswith(EXEMPT):
            functions_by_file.setdefault(file, {})[name] = lengths(PACKAGE / file).get(name, 0)
    return functions_by_file


def total(functions: dict[str, dict[str, int]]) -> tuple[int, int]:
    """Returns the numbers of files and lines."""
    return len(functions), sum(sum(lines.values()) for lines in functions.values())


def block(measured: dict[str, dict[str, dict[str, int]]], limits: dict[str, tuple[int, int]]) -> str:
    """Returns the table of the page about the paths."""
    lines = ["| path | files | lines | files, at most | lines, at most |", "|---|---|---|---|---|"]
    for name, functions in measured.items():
        (n_files, n_lines), (files, of_lines) = total(functions), limits[name]
        lines.append(f"| {name} | {n_files} | {n_lines:,} | {files} | {of_lines:,} |")
    return "\n".join(lines) + "\n"


def main() -> int:
    """Measures all paths; returns 1 if one has grown beyond the page."""
    text = DESIGN.read_text(encoding="utf-8")
    rows = {name: [int(number.replace(",", "")) for number in numbers] for name, *numbers in ROW.findall(text)}
    measured = {name: counted(trace()) for name, trace in TRACES.items()}
    problems = []
    for name, functions in measured.items():
        n_files, n_lines = total(functions)
        known_files, known_lines, most_files, most_lines = rows[name]
        print(f"{name:<18} {n_files} files, {n_lines} lines (page {known_files}, {known_lines})")
        if "--list" in sys.argv:
            print(*(f"    {file}: {', '.join(names)}" for file, names in functions.items()), sep="\n")
        if n_files > most_files or n_lines > most_lines:
            problems.append(f"{name}: {n_files} files and {n_lines} lines exceed {most_files} and {most_lines}")
        elif (n_files > known_files or n_lines > known_lines) and "--write" not in sys.argv:
            problems.append(f"{name} has grown; if it must, say why in the commit, and run scripts/paths.py --write")
    if "--write" in sys.argv:
        new = block(measured, {name: (files, lines) for name, (_, _, files, lines) in rows.items()})
        DESIGN.write_text(TABLE.sub(lambda match: match[1] + new + match[3], text), encoding="utf-8")
    print("\n".join(problems), file=sys.stderr, end="\n" if problems else "")
    return bool(problems)


if __name__ == "__main__":
    sys.exit(main())
