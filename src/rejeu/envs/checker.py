"""Checks of an environment before training: errors, and properties that make learning harder."""

from __future__ import annotations

import copy
import re
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from itertools import islice
from typing import Any, Literal, NamedTuple

import gymnasium as gym
import jax
import numpy as np
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env as check_gymnasium_env

from rejeu.core.errors import BadEnvironmentError
from rejeu.core.spaces import (
    GOAL_KEYS,
    bounded,
    check_action,
    check_goal_space,
    check_policy,
    members,
    plain,
    random_action,
)
from rejeu.core.types import Info, Observation
from rejeu.envs import masks, validation
from rejeu.envs.base import SEEDS_END, success_of
from rejeu.envs.functional.gym_env import GymnasiumEnv
from rejeu.envs.functional.protocol import FunctionalEnv
from rejeu.envs.goals import attribute, goal_functions, is_batch, one_number

MOST_STEPS = 2_000
"""Random steps after which episodes are assumed never to end, in an environment that declares no time limit."""
ENOUGH_STEPS, ENOUGH_EPISODES = 100, 2
"""Random steps and complete episodes that are checked, if they do not take too long."""
MOST_SECONDS = 5.0
"""Time limit of these steps, in seconds."""
MOST_GOALS = 32
"""Steps whose goals are checked."""
SEED = 0


Level = Literal["error", "warning"]
"""An error stops training or makes its result wrong; a warning may be intended."""


class Effort(NamedTuple):
    """How long an environment is checked."""

    most_steps: int = MOST_STEPS
    enough_steps: int = ENOUGH_STEPS
    seconds: float = MOST_SECONDS
    is_patient: bool = True
    """Whether ``most_steps`` are taken, and not only those of ``seconds``, where no episode ends and none has to."""
    keeps_infos: bool = False
    """Whether functions of goals may depend on the info of the step."""


QUICK = Effort(500, 20, 1.0, is_patient=False)
"""The check before training."""


class Finding(NamedTuple):
    """A problem found in an environment."""

    level: Level
    text: str
    """The received value, the expected one, and the fix."""


_error, _warning = partial(Finding, "error"), partial(Finding, "warning")


class Problems(dict[str, Finding]):
    """The problems found so far, the first of each key. Mutable."""

    def add(self, key: str, text: str | None, level: Level = "error", method: str = "") -> None:
        """Adds a problem, unless the text is None or there is one of this key; ``method`` returned what the text names."""
        if text is not None:
            self.setdefault(key, Finding(level, f"{method} returned {text}" if method else text))


class SeenStep(NamedTuple):
    """One step, with copies of the returned values."""

    obs: Observation
    reward: float
    terminated: bool
    truncated: bool
    info: Info
    judged: dict[str, list[Any]]
    """Results of each function of goals for the :func:`_pairs`, right after the step."""


def check_env(env: gym.Env | FunctionalEnv, warn: bool = True, skip_render_check: bool = True) -> None:
    """Runs some episodes of an environment; raises its errors and warns about its other problems.

    Errors: observations whose structure, shape or dtype differs from the space, numbers that are not finite, rewards and
    flags of the wrong type, a reset without seed or info, a ``compute_reward`` that disagrees with ``step`` or reads more than
    its arguments. Warnings: numbers outside of the bounds, time limits reported as ``terminated``, episodes that never end,
    those that end at a goal without ``compute_terminated``, what Gymnasium's checker finds (such as resets that a seed does
    not reproduce), and observations that are hard to learn from.
    :func:`findings` returns all of them; ``rejeu check ENV`` prints them.

    Args:
        env: an environment, of Gymnasium or in JAX; it is reset and stepped, and left open.
        warn: whether to warn; errors are always raised.
        skip_render_check: skip the check of its render modes.

    Raises:
        TypeError: if it is no Gymnasium environment.
        BadEnvironmentError: with all errors, one per line.

    >>> check_env(gym.make("Pendulum-v1"), warn=False)
    """
    if errors := errors_of(findings(env, skip_render_check), warn):
        name = type(env).__name__ if isinstance(env, FunctionalEnv) else validation.id_of(env)
        raise BadEnvironmentError(f"{name}: " + "\n".join(errors))


def errors_of(problems: Sequence[Finding], warn: bool = True) -> list[str]:
    """Returns the texts of the errors; warns of the others if ``warn``."""
    for finding in problems if warn else ():
        if finding.level == "warning":
            warnings.warn(finding.text, UserWarning, stacklevel=3)
    return [finding.text for finding in problems if finding.level == "error"]


def findings(env: gym.Env | FunctionalEnv, skip_render_check: bool = True) -> list[Finding]:
    """Returns the problems of an environment; see :func:`check_env`.

    Raises:
        TypeError: if it is no Gymnasium environment.

    >>> findings(gym.make("Acrobot-v1"))
    []
    """
    if isinstance(env, FunctionalEnv):
        try:
            env = GymnasiumEnv(env)
        except BadEnvironmentError as error:  # of what it traces
            return [Finding("error", str(error))]
    problems = _played(env, Effort(seconds=MOST_SECONDS))
    messages = [] if errors_of([*problems.values()], warn=False) else _gymnasium_messages(env, skip_render_check)
    for text in (*messages, *advice_on_observations(env.observation_space), *advice_on_actions(env.action_space)):
        problems.add(text, text, "warning")
    return [*problems.values()]


def quick_findings(env: gym.Env, keeps_infos: bool = False) -> list[Finding]:
    """Returns the errors that :func:`findings` returns, and whether episodes never end, from few steps (:class:`Effort`)."""
    problems = _played(env, QUICK._replace(keeps_infos=keeps_infos))
    return [finding for key, finding in problems.items() if finding.level == "error" or key == "endless"]


def _played(env: gym.Env, effort: Effort) -> Problems:
    """Returns the problems that random steps show, by kind."""
    if (fault := validation.environment_fault(env)) is not None:
        raise TypeError(fault)
    problems = Problems()
    try:
        is_nested = isinstance(env.observation_space, spaces.Dict | spaces.Tuple)
        check_policy("MultiInputPolicy" if is_nested else "MlpPolicy", env.observation_space)
        random_action(env.action_space, 1, np.random.default_rng(SEED))
        # Whole numbers of a Box are taken by off-policy algorithms alone.
        if not isinstance(env.action_space, spaces.Box) or env.action_space.dtype.kind == "f":
            check_action(env.action_space, "every algorithm")
    except (TypeError, ValueError) as error:
        problems.add("space", str(error))
        return problems
    steps = _play(env, problems, effort)
    if steps and isinstance(env.observation_space, spaces.Dict) and "desired_goal" in env.observation_space.spaces:
        for level, text in goal_problems(env, steps, effort.keeps_infos):
            problems.add(text, text, level)
    return problems


def _play(env: gym.Env, problems: Problems, effort: Effort) -> list[SeenStep] | None:
    """Takes random steps and records each kind of problem once. Returns the steps, None if they had to stop."""
    space = env.observation_space
    env.action_space.seed(SEED)
    try:
        for seed in (SEEDS_END - 1, SEED):  # the largest that a run may choose is taken too
            validation.called_reset(env, seed)
    except BadEnvironmentError as error:
        problems.add("seed", str(error))
        env = env.unwrapped if validation.arguments_fault(env) else env  # wrappers pass a seed on
    if (begun := _reset(env, problems)) is None:
        with suppress(Exception):  # whatever step raises after a wrong reset
            _check_step(env.step(env.action_space.sample()), space, problems)
        return None
    steps: list[SeenStep] = []
    functions = _functions_of_goals(env)
    seeks_end = effort.is_patient and _lacks_terminated(env)
    limit, length = known_limit(env), 0
    lengths: list[int] = []
    at_limit: list[bool] = []
    until, info = time.monotonic() + effort.seconds, begun[1]
    while len(steps) < effort.most_steps:
        if len(steps) >= effort.enough_steps and len(lengths) >= ENOUGH_EPISODES and not seeks_end:
            break
        is_endless = effort.is_patient and not lengths and limit is None
        if len(steps) >= effort.enough_steps and time.monotonic() > until and not is_endless:
            break
        action = env.action_space.sample()
        with suppress(BadEnvironmentError):  # of a mask that is none
            action = masks.sampled(env, info)
        result = env.step(action)
        if not _check_step(result, space, problems):
            return None
        obs, reward, terminated, truncated, info = validation.convert_step(result)
        obs_copy = jax.tree.map(np.array, plain(space, obs))
        if effort.is_patient and length > 0:
            problems.add("resolution", validation.lost_change(space, steps[-1].obs, obs_copy), "warning")
        steps.append(SeenStep(obs_copy, reward, terminated, truncated, copy.deepcopy(info), {}))
        seeks_end = seeks_end and not terminated and success_of(info) != 1.0 and len(steps) < QUICK.most_steps
        for name, function in functions.items() if len(steps) <= MOST_GOALS else ():
            steps[-1].judged[name] = [_attempt(function, *pair, info) for pair in _pairs(steps[0], steps[-1])]
        length += 1
        if terminated or truncated:
            lengths.append(length)
            if length == limit:
                at_limit.append(terminated)
            length = 0
            if (begun := _reset(env, problems)) is None:
                return None
            info = begun[1]
    if len(at_limit) >= ENOUGH_EPISODES and all(at_limit):
        text = (
            f"every one of {len(at_limit)} episodes that came so far terminated at its time limit of {limit} steps; if "
            "that is the limit and not the task, return terminated=False, truncated=True there, or what comes after is "
            "learned to have no value"
        )
        problems.add("limit", text, "warning")
    if len(steps) >= effort.most_steps and not lengths and limit is None:
        text = (
            f"no episode ended in {effort.most_steps:,} steps; it declares no time limit, so give it one: "
            "gymnasium.register(..., max_episode_steps=1000), or gymnasium.wrappers.TimeLimit(env, 1000)"
        )
        problems.add("endless", text, "warning")
    return steps


def _reset(env: gym.Env, problems: Problems) -> tuple[Observation, Info] | None:
    """Resets the environment and checks its observation, which is returned with the info; None if it is unusable."""
    space = env.observation_space
    result = env.reset()
    problems.add("reset", validation.reset_fault(result, space))
    has_info = isinstance(result, tuple) and len(result) == 2 and isinstance(result[1], dict)
    obs = result[0] if has_info else result
    if validation.observation_fault(space, obs) is not None:
        return None
    _check_observation(obs, space, problems, "reset")
    return obs, result[1] if has_info else {}


def _check_step(result: object, space: gym.Space, problems: Problems) -> bool:
    """Checks the values of a step, and returns whether training could go on after it."""
    faults = dict(validation.step_faults(result, space, strict=True))
    for name, text in faults.items():
        problems.add(name, text)
    if not isinstance(result, tuple) or len(result) != 5:
        return False
    obs, _, terminated, truncated, info = result
    if "step" not in faults:
        _check_observation(obs, space, problems, "step")
    success = info.get("is_success", info.get("success")) if isinstance(info, dict) else None
    if success is not None and (np.size(success) != 1 or np.asarray(success).dtype.kind not in "biuf"):
        text = (
            f"step returned the info {{'is_success': {success!r:.80}}}, expected one bool; an array counts as a success "
            "where all its numbers are at least 1, and what is no number as unknown"
        )
        problems.add("success", text, "warning")
    if isinstance(info, dict) and info.get("TimeLimit.truncated") and not truncated:
        text = (
            f"step returned info['TimeLimit.truncated']={info['TimeLimit.truncated']!r} with terminated={terminated} and "
            "truncated=False; return truncated=True where a time limit ended the episode"
        )
        problems.add("folded", text)
    return validation.step_fault(result, space) is None


def _check_observation(obs: Observation, space: gym.Space, problems: Problems, method: str) -> None:
    problems.add("observation", validation.observation_fault(space, obs, strict=True), method=method)
    fault = validation.nonfinite_fault(space, obs)
    problems.add("finite", fault, method=method)
    if fault is None and (outside := validation.bounds_fault(space, obs)) is not None:
        # Networks never see the bounds of a Box, but a choice that does not exist has no place in them.
        level, fault = outside
        problems.add("bounds", fault, level, method)


def known_limit(env: gym.Env) -> int | None:
    """Returns the time limit that an environment declares, or None."""
    if env.spec is not None:
        registered = gym.registry.get(env.spec.id, env.spec)  # whose limit the spec of an unwrapped environment lacks
        limit = env.spec.max_episode_steps or registered.max_episode_steps
        if limit is not None:
            return limit
    for name in ("_max_episode_steps", "max_episode_steps", "max_steps"):
        limit = env.get_wrapper_attr(name) if env.has_wrapper_attr(name) else None
        if isinstance(limit, int | np.integer) and not isinstance(limit, bool):
            return int(limit)
    return None


def _gymnasium_messages(env: gym.Env, skip_render_check: bool) -> list[str]:
    """Returns the warnings and errors of Gymnasium's own checker."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        refused = []
        try:
            check_gymnasium_env(env, skip_render_check=skip_render_check)
        except Exception as error:  # whatever it refuses by, such as its own mask, which that checker does not ask for
            refused = [] if attribute(env, masks.METHOD) or masks.MASK in env.reset()[1] else [f"{error}"]
    messages = [re.sub(r"\x1b\[[\d;]*m|WARN: ", "", str(warning.message)) for warning in caught] + refused
    hidden = ("different from the unwrapped version", "symmetric and normalized")  # rejeu scales actions
    shown = [text for text in dict.fromkeys(messages) if not any(part in text for part in hidden)]
    return [f"gymnasium.utils.env_checker: {' '.join(text.split())}" for text in shown]


def goal_problems(env: gym.Env, steps: Sequence[SeenStep], keeps_infos: bool = False) -> Iterator[Finding]:
    """Yields the problems with the goals of an environment, from some of its steps: the first of each function."""
    try:
        check_goal_space(env.observation_space)
    except ValueError as error:
        yield _error(str(error))
        return
    functions = _functions_of_goals(env)
    if "compute_reward" not in functions:
        yield _error(
            "observations with a desired_goal need the method compute_reward(achieved_goal, desired_goal, info), and "
            "there is none; add it, for hindsight replay"
        )
        return
    ended = [step for step in steps if step.terminated][: MOST_GOALS // 4]
    rows = [*steps[:MOST_GOALS], *ended]
    env.reset()  # to another state than that of any step
    for name, function in functions.items():
        yield from islice(_goal_faults(name, function, rows, keeps_infos), 1)
    if _lacks_terminated(env):
        yield from islice(_ends_at_goals(functions["compute_reward"], ended), 1)


def _functions_of_goals(env: gym.Env) -> dict[str, Callable[..., Any]]:
    """Returns those functions that an environment with goals has, by name."""
    keys = env.observation_space.spaces if isinstance(env.observation_space, spaces.Dict) else ()
    names = ("compute_reward", "compute_terminated") if {*GOAL_KEYS} <= {*keys} else ()
    return {name: function for name in names if (function := attribute(env, name)) is not None}


def _lacks_terminated(env: gym.Env) -> bool:
    """Returns whether hindsight replay does not know where the goals of an environment end its episodes."""
    functions = goal_functions(env)
    return functions is not None and functions.terminated is None


def _pairs(first: SeenStep, row: SeenStep) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    """Returns goals that are met if achieved is read from the environment after ``row``, and if desired is."""
    return (_goals(first)[0], _goals(row)[0]), (_goals(row)[1], _goals(first)[0])


def _ends_at_goals(reward: Callable[..., Any], ended: Sequence[SeenStep]) -> Iterator[Finding]:
    """Yields advice where an episode ended at its goal, in an environment without ``compute_terminated``."""
    for row in ended:
        _, desired = _goals(row)
        is_best = _agree(row.reward, one_number(_attempt(reward, desired, desired, row.info)))
        if is_best or success_of(row.info) == 1.0:
            yield _warning(
                "an episode terminated at its goal, and there is no compute_terminated(achieved_goal, desired_goal, info); "
                "add it, or hindsight replay teaches that episodes go on at all other goals"
            )


def _goal_faults(
    name: str, function: Callable[..., Any], rows: Sequence[SeenStep], keeps_infos: bool
) -> Iterator[Finding]:
    """Yields the problems with ``compute_reward`` or ``compute_terminated``, the worst first."""
    for row in rows:
        goals = copy.deepcopy(_goals(row))
        result = one_number(function(*goals, row.info))
        if (fault := _result_fault(name, result)) is not None:
            yield _error(f"{name} of one goal returned {fault}")
        if not all(map(np.array_equal, goals, _goals(row))):
            yield _error(f"{name} changes its arguments in place; compute new arrays: achieved_goal - desired_goal")
        for pair, before in zip(_pairs(rows[0], row), row.judged.get(name, ()), strict=False):
            after = _attempt(function, *pair, row.info)
            if not _agree(one_number(before), one_number(after)):
                yield _error(
                    f"{name} of the same two goals gave {before} after one step and {after} later: it reads something else, "
                    "such as the state of the environment; compute it from its arguments alone"
                )
        yield from _against_step(name, result, row)
        alone = result if keeps_infos else _attempt(function, *_goals(row), {})
        if not _agree(result, one_number(alone)):
            yield _error(
                f"{name} gave {result} with the info of the step, and {_describe_result(alone)} with an empty info; let it "
                "depend on the goals alone, or keep infos with replay_buffer_kwargs={'copy_info_dict': True}"
            )
    if not keeps_infos:
        yield from _against_batches(name, function, rows)


def _against_step(name: str, result: object, row: SeenStep) -> Iterator[Finding]:
    """Yields the difference between a step and the function for one goal."""
    if name == "compute_terminated" and result and not row.terminated:  # it may end otherwise, as in a crash
        yield _error(
            "compute_terminated gave True where step gave terminated=False; hindsight replay goes by the former: let step "
            "return it too"
        )
    if name == "compute_reward" and not _agree(result, row.reward):
        text = f"step gave the reward {row.reward}, and compute_reward of the same goals {result}"
        if row.terminated:
            yield _warning(f"{text}, where the episode ended; hindsight replay will not know of the difference")
        yield _error(f"{text}; they must agree: let step call compute_reward")


def _against_batches(name: str, function: Callable[..., Any], rows: Sequence[SeenStep]) -> Iterator[Finding]:
    """Yields the difference between the results for many goals at once and for each alone."""
    achieved, desired = (np.array([_goals(row)[k] for row in rows]) for k in range(2))
    achieved, desired = np.concatenate([achieved] * 2), np.concatenate([np.roll(desired, 1, axis=0), achieved])
    single = [one_number(_attempt(function, a, d, {})) for a, d in zip(achieved, desired, strict=True)]
    for result in single:
        if (fault := _result_fault(name, result)) is not None:
            yield _error(f"{name} of goals of other steps returned {fault}; it must take any goals of the space")
    if name == "compute_reward" and _agree(single, single[0]):
        yield _warning(
            f"compute_reward gave {single[0]} for each of {len(single)} pairs of goals, also of equal ones; let it compare "
            "achieved_goal with desired_goal, with a tolerance that some pass and some do not"
        )
    whole = _attempt(function, achieved, desired, {})
    if isinstance(whole, Exception) or not is_batch(whole, len(achieved)):
        got = _describe_result(whole) if isinstance(whole, Exception) else f"gave {validation.describe_value(whole)}"
        yield _warning(
            f"{name} of {len(achieved)} goals at once {got}, expected numbers ({len(achieved)},); rejeu then calls it row by "
            "row, which is slow: compute over the last axis, as np.linalg.norm(achieved - desired, axis=-1) does"
        )
    elif not _agree(whole, np.array(single)):
        at = int(np.flatnonzero(~np.isclose(whole, single, rtol=1e-4, atol=1e-5))[0])
        yield _error(
            f"{name} of many goals at once gave {whole[at]} in row {at}, and {single[at]} of the same goals one by one; "
            "compute each row by itself: over the last axis"
        )


def _result_fault(name: str, result: object) -> str | None:
    """Returns the fault of the result for one pair of goals, None without one."""
    if isinstance(result, Exception):
        return f"nothing, but {_describe_result(result)}"
    is_reward = name == "compute_reward"
    return validation.reward_fault(result, strict=True) if is_reward else validation.flag_fault("terminated", result)


def _goals(row: SeenStep) -> tuple[Any, Any]:
    _, achieved, desired = (row.obs[key] for key in GOAL_KEYS)
    return achieved, desired


def _attempt(function: Callable[..., Any], *arguments: object) -> Any:
    """Returns the result of a function, or the exception that it raised."""
    try:
        return function(*copy.deepcopy(arguments))
    except Exception as error:  # whatever it raises of goals that it did not expect
        return error


def _agree(a: object, b: object) -> bool:
    try:
        first, second = np.asarray(a, np.float64), np.asarray(b, np.float64)
    except (TypeError, ValueError):  # of errors, and of what is no number
        return type(a) is type(b)
    return bool(np.allclose(first, second, rtol=1e-4, atol=1e-5, equal_nan=True))


def _describe_result(result: object) -> str:
    return f"raised {type(result).__name__}: {result}" if isinstance(result, Exception) else f"{result}"


def advice_on_actions(space: spaces.Space) -> Iterator[str]:
    """Yields advice on unbounded actions, which only some algorithms take."""
    for subspace in members(space) if isinstance(space, spaces.Dict | spaces.Tuple) else ():
        yield from advice_on_actions(subspace)
    if isinstance(space, spaces.Box) and not bounded(space).all():
        yield (
            f"the actions {space} have no bounds, or practically none; SAC, TD3 and others refuse them, and PPO does not "
            "scale them: declare the bounds that they really have, such as Box(-1.0, 1.0, ...)"
        )


def advice_on_observations(space: spaces.Space, path: str = "", dtypes: bool = True) -> Iterator[str]:
    """Yields advice on an observation space, one sentence each: nothing fails, but learning may be slower.

    ``dtypes=False`` leaves out those of vectors, of which Stable-Baselines3 does not warn.
    """
    where = f" under {path!r}" if path else ""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        for key, subspace in space.spaces.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces):
            name = f"{path}.{key}".lstrip(".")
            if isinstance(subspace, spaces.Dict | spaces.Tuple):
                yield f"the observation under {name!r} is nested; rejeu takes it, Stable-Baselines3 takes one level only"
            yield from advice_on_observations(subspace, name, dtypes)
    elif not isinstance(space, spaces.Box):
        return
    elif len(space.shape) == 3:
        if space.dtype != np.uint8:
            yield f"the image{where} has the dtype {space.dtype}; only uint8 images go through convolutions"
        elif np.any(space.low != 0) or np.any(space.high != 255):
            yield f"the image{where} has other bounds than 0 and 255; it is divided by 255 in any case"
        if min(sorted(space.shape)[1:]) < 36 and space.dtype == np.uint8:
            yield f"the image{where} has the shape {space.shape}; below 36x36 small convolutions are used, below 8x8 none"
    elif len(space.shape) > 1:
        yield f"the observation{where} has the shape {space.shape}; arrays of two axes are flattened"
    elif dtypes and space.dtype != np.float32 and space.dtype != np.uint8:
        yield f"the observation{where} has the dtype {space.dtype}; use float32, which networks compute with"
