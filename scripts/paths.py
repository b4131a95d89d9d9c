"""Counts what one must read to follow four paths through the package, and verifies the lists in ``docs/design.md``.

The section "One transition" of that page lists definitions by file, one path under each heading such as
``### SAC (5 files, 600 lines)``, and the leaf helpers, which need not be read, under ``### Leaf helpers``. This script
counts files and lines, runs real steps of each path under a profiler, and fails if a function that they call is in no list,
if a listed definition does not exist, or if a total exceeds its target. A target marked ``not reached yet`` is printed only.
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
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

import rejeu
from rejeu import cli
from rejeu.loops.off_policy import off_policy
from rejeu.loops.on_policy import on_policy

PACKAGE = Path(rejeu.__file__).parent
DESIGN = PACKAGE.parent.parent / "docs" / "design.md"
HEADING = re.compile(r"^### (.+?) \((\d+) files, (\d+) lines(, not reached yet)?\)$")
ENTRY = re.compile(r"^- `([\w/]+\.py)`: (.+)$")
LEAF = re.compile(r"^- `([\w/]+(?:\.py|/))`(?: in ([\w ]+))?: .+")
SMALL = {"policy_kwargs": {"net_arch": [8]}, "seed": 0}


class Listed(NamedTuple):
    """A path as listed on the page."""

    files: dict[str, list[str]]
    most_files: int
    most_lines: int
    is_enforced: bool


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
def tracing(called: set[tuple[str, str]], until: Callable[..., Any] | None = None) -> Iterator[None]:
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
                called.add((Path(code.co_filename).relative_to(PACKAGE).as_posix(), name))

    sys.setprofile(trace)
    try:
        yield
    finally:
        sys.setprofile(None)


def trace_loop(agent: Any, loop: Any, n_turns: int) -> set[tuple[str, str]]:
    """Returns the functions called by some turns of a loop."""
    called: set[tuple[str, str]] = set()
    with tracing(called):
        for _ in loop(agent.run, agent.learner, agent.config, n_turns, lambda step: 0.0):
            pass
    return called


def trace_sac() -> set[tuple[str, str]]:
    """Returns the functions called by turns of SAC: random and policy actions, updates, and the end of an episode."""
    env = gym.make("Pendulum-v1", max_episode_steps=4)
    agent = rejeu.SAC("MlpPolicy", env, learning_starts=4, batch_size=4, **SMALL)
    return trace_loop(agent, off_policy, 10)


def trace_ppo() -> set[tuple[str, str]]:
    """Returns the functions called by two rollouts of PPO."""
    env = gym.make("Pendulum-v1", max_episode_steps=3)
    agent = rejeu.PPO("MlpPolicy", env, n_steps=8, batch_size=4, n_epochs=1, **SMALL)
    return trace_loop(agent, on_policy, 17)


def trace_her() -> set[tuple[str, str]]:
    """Returns the functions called by sampling a relabeled batch."""
    buffer = {"replay_buffer_class": "HerReplayBuffer", "learning_starts": 10}
    agent = rejeu.SAC("MultiInputPolicy", Reach(), **buffer, **SMALL)
    agent.learn(9)
    called: set[tuple[str, str]] = set()
    with tracing(called):
        for _ in range(2):
            agent.run.replay.draw(agent.run.rng, (8,), 0.0)
    return called


def trace_train() -> set[tuple[str, str]]:
    """Returns the functions called by ``rejeu train`` before the loop starts."""
    called: set[tuple[str, str]] = set()
    with tempfile.TemporaryDirectory() as folder:
        words = ["train", "Pendulum-v1", "--algo", "SAC", "--steps", "2", "--out", f"{folder}/run", "--set"]
        with suppress(Reached), redirect_stdout(None), tracing(called, until=off_policy):
            cli.main([*words, "policy_kwargs.net_arch=[8]"])
    return called


TRACES = {"SAC": trace_sac, "PPO": trace_ppo, "HER": trace_her, "rejeu train": trace_train}


def read_page(text: str) -> tuple[dict[str, Listed], list[tuple[str, str | None]]]:
    """Returns the paths by name, and the prefixes of leaf helpers with the path of each (None: all paths)."""
    paths: dict[str, Listed] = {}
    leaves: list[tuple[str, str | None]] = []
    current: Listed | None = None
    in_leaves = False
    for line in text.splitlines():
        if line.startswith("#"):
            current, in_leaves = None, line == "### Leaf helpers"
        if heading := HEADING.match(line):
            current = paths[heading[1]] = Listed({}, int(heading[2]), int(heading[3]), heading[4] is None)
        elif current is not None and (entry := ENTRY.match(line)):
            current.files[entry[1]] = re.findall(r"`([\w.]+)`", entry[2])
        elif in_leaves and (leaf := LEAF.match(line)):
            leaves.append((leaf[1], leaf[2]))
    return paths, leaves


def lengths(path: Path) -> dict[str, int]:
    """Returns the number of lines of each function, class and method of a file, decorators included."""
    found: dict[str, int] = {}

    def visit(node: ast.AST, prefix: str) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.FunctionDef | ast.ClassDef):
                first = min([child.lineno, *(decorator.lineno for decorator in child.decorator_list)])
                found[prefix + child.name] = (child.end_lineno or first) - first + 1
                if isinstance(child, ast.ClassDef):
                    visit(child, f"{prefix}{child.name}.")

    visit(ast.parse(path.read_text(encoding="utf-8")), "")
    return found


def check(name: str, listed: Listed, called: set[tuple[str, str]], leaves: list[tuple[str, str | None]]) -> list[str]:
    """Prints the totals of a path and returns the errors of its list."""
    problems, n_lines = [], 0
    for file, names in listed.files.items():
        sizes = lengths(PACKAGE / file) if (PACKAGE / file).exists() else {}
        problems += [f"{name}: {file} has no {one}" for one in names if one not in sizes]
        n_lines += sum(sizes.get(one, 0) for one in names)
    helpers: dict[tuple[str, str], int] = {}
    prefixes = tuple(prefix for prefix, path in leaves if path in (None, name))
    for file, function in sorted(called):
        names = listed.files.get(file, [])
        is_listed = function in names or function.partition(".")[0] in names
        if not is_listed and not file.startswith(prefixes):
            problems.append(f"{name}: calls {file}: {function}, which is not listed")
        elif not is_listed:
            helpers[file, function] = lengths(PACKAGE / file).get(function, 0)
    n_files, is_within = len(listed.files), len(listed.files) <= listed.most_files and n_lines <= listed.most_lines
    target = f"target {listed.most_files} files, {listed.most_lines} lines"
    all_files, all_lines = len({file for file, _ in helpers} | set(listed.files)), n_lines + sum(helpers.values())
    print(
        f"{name:<12} {n_files} files, {n_lines} lines ({target}{'' if is_within else ': exceeded'}); "
        f"with all leaf helpers that are called {all_files} files, {all_lines} lines"
    )
    if listed.is_enforced and not is_within:
        problems.append(f"{name}: {n_files} files and {n_lines} lines exceed the {target}")
    return problems


def main() -> int:
    """Checks all paths; returns 1 if there are errors."""
    paths, leaves = read_page(DESIGN.read_text(encoding="utf-8"))
    problems = [f"{DESIGN.name} lists no path {name}" for name in TRACES if name not in paths]
    for name, trace in TRACES.items():
        if name in paths:
            problems += check(name, paths[name], trace(), leaves)
    print("\n".join(problems), file=sys.stderr, end="\n" if problems else "")
    return bool(problems)


if __name__ == "__main__":
    sys.exit(main())
