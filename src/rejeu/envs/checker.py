"""Looking at an environment of one's own before training: what would fail, and what would make learning needlessly hard."""

from __future__ import annotations

import copy
import re
import time
import warnings
from typing import Any, Literal, NamedTuple

import gymnasium as gym
import jax
import numpy as np
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env as check_gymnasium_env

from rejeu.envs import answers, conversions, faults
from rejeu.envs.advice import advice_on_observations
from rejeu.errors import BadEnvironmentError
from rejeu.spaces import leaves, plain

MOST_STEPS = 10_000
"""Random steps after which an environment counts as one whose episodes never end."""
ENOUGH_STEPS, ENOUGH_EPISODES = 100, 2
"""Random steps and whole episodes that are looked at, if they do not take too long."""
MOST_SECONDS = 5.0
"""After which no further steps are taken."""
SEED = 0


class Finding(NamedTuple):
    """One thing that an environment does not do as it should."""

    level: Literal["error", "warning"]
    """An error stops training or spoils what is learnt; a warning may be as it is meant to be."""
    text: str
    """What was received, what was expected, and the fix."""


class Seen(NamedTuple):
    """One step as it was seen, with copies of what was returned."""

    obs: Any
    reward: float
    terminated: bool
    truncated: bool
    info: dict[str, Any]


def check_env(env: gym.Env, warn: bool = True, skip_render_check: bool = True) -> None:
    """Plays some episodes of an environment, raises what is wrong with it and warns of what may be.

    Errors: answers of another structure, shape or dtype than declared, numbers that are not finite, rewards and flags of
    the wrong kind, a reset without seed or info, goals whose ``compute_reward`` disagrees with ``step``. Warnings: numbers
    outside of the declared bounds, time limits that are told as ``terminated``, episodes that never end, arrays that are
    written again, resets that cannot be repeated, what Gymnasium's own (strict) checker says, and observations that are
    hard to learn from. See :func:`findings` for all of them as a list; ``rejeu check ENV`` prints them.

    Args:
        env: an environment; it is reset and stepped, and left open.
        warn: whether to warn as well; errors are raised in any case.
        skip_render_check: leave out whether it renders in each of its modes.

    Raises:
        TypeError: if it is no Gymnasium environment.
        BadEnvironmentError: with all errors, one a line.

    >>> check_env(gym.make("Pendulum-v1"), warn=False)
    """
    found = findings(env, skip_render_check)
    if warn:
        for finding in found:
            if finding.level == "warning":
                warnings.warn(finding.text, UserWarning, stacklevel=2)
    errors = [finding.text for finding in found if finding.level == "error"]
    if errors:
        raise BadEnvironmentError(f"{faults.id_of(env)}: " + "\n".join(errors))


def findings(env: gym.Env, skip_render_check: bool = True) -> list[Finding]:
    """Returns all that is found in an environment by playing it; see :func:`check_env`.

    Raises:
        TypeError: if it is no Gymnasium environment.

    >>> findings(gym.make("Acrobot-v1"))
    []
    """
    if not isinstance(env, gym.Env):
        raise TypeError(f"env must be a gymnasium.Env, got {type(env).__name__}; derive its class from gymnasium.Env")
    try:
        leaves(env.observation_space)
        check_action_space(env.action_space)
    except TypeError as error:
        return [Finding("error", str(error))]
    found: dict[str, Finding] = {}
    seen = _play(env, found)
    if seen is not None:
        _check_repeats(env, found)
        if isinstance(env.observation_space, spaces.Dict) and "desired_goal" in env.observation_space.spaces:
            from rejeu.envs.goal_checks import goal_findings  # which imports this module

            for finding in goal_findings(env, seen):
                found[finding.text] = finding
    if all(finding.level == "warning" for finding in found.values()):
        for text in _said_by_gymnasium(env, skip_render_check):
            found[text] = Finding("warning", text)
    for text in advice_on_observations(env.observation_space):
        found[text] = Finding("warning", text)
    return [*found.values()]


def check_action_space(space: gym.Space) -> None:
    """Raises ``TypeError`` unless actions are of a kind that an agent can choose."""
    if not isinstance(space, spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary):
        raise TypeError(
            f"the action space is {space}; agents choose Box, Discrete, MultiDiscrete or MultiBinary actions"
        )


def _play(env: gym.Env, found: dict[str, Finding]) -> list[Seen] | None:
    """Takes random steps and notes what is wrong, each kind of fault once; None if it cannot be stepped on."""
    space = env.observation_space
    env.action_space.seed(SEED)
    obs = _begun(env, found, SEED)
    if obs is None:
        return None
    seen: list[Seen] = []
    limit, length = known_limit(env), 0
    lengths: list[int] = []
    at_limit: list[bool] = []
    kept = _copied(space, obs)
    until = time.monotonic() + MOST_SECONDS
    while len(seen) < MOST_STEPS and not (len(seen) >= ENOUGH_STEPS and len(lengths) >= ENOUGH_EPISODES):
        if len(seen) >= ENOUGH_STEPS and time.monotonic() > until:
            break
        answer = env.step(env.action_space.sample())
        fault = faults.step_fault(answer, space)
        if fault is not None:
            found.setdefault("step", Finding("error", fault))
            return None
        _look(answer, space, found)
        if _rewritten(space, obs, kept, answer[0]):
            text = (
                "step returns the same array each time and writes the next observation into it; rejeu copies "
                "observations, but other code that keeps them sees them change: return a copy"
            )
            found.setdefault("same array", Finding("warning", text))
        obs, reward, terminated, truncated, info = conversions.numbers_of(answer)
        kept = _copied(space, obs)
        seen.append(Seen(kept, reward, terminated, truncated, copy.deepcopy(info)))
        length += 1
        if terminated or truncated:
            lengths.append(length)
            if length == limit:
                at_limit.append(terminated)
            length = 0
            obs = _begun(env, found)
            if obs is None:
                return None
            kept = _copied(space, obs)
    if len(at_limit) >= ENOUGH_EPISODES and all(at_limit):
        text = (
            f"every one of {len(at_limit)} episodes that came so far terminated at its time limit of {limit} steps; if "
            "that is the limit and not the task, return terminated=False, truncated=True there, or what comes after is "
            "learnt to be worth nothing"
        )
        found["limit"] = Finding("warning", text)
    if len(seen) >= MOST_STEPS and not lengths and limit is None:
        text = (
            f"no episode ended in {MOST_STEPS:,} steps; give it a time limit: gymnasium.register(..., "
            "max_episode_steps=1000), or gymnasium.wrappers.TimeLimit(env, 1000)"
        )
        found["endless"] = Finding("warning", text)
    return seen


def _begun(env: gym.Env, found: dict[str, Finding], seed: int | None = None) -> Any:
    """Returns the first observation of an episode, None if there is none; notes what is wrong with it."""
    try:
        obs = answers.reset(env, seed)[0]
    except BadEnvironmentError as error:
        found.setdefault("reset", Finding("error", str(error)))
        return None
    _look_at_observation(obs, env.observation_space, found, "reset")
    return obs


def _look(answer: tuple[Any, ...], space: gym.Space, found: dict[str, Finding]) -> None:
    """Notes what is wrong with the answer to a step that can be learnt from at all."""
    obs, reward, terminated, truncated, info = answer
    _look_at_observation(obs, space, found, "step")
    for kind, fault in (
        ("reward", faults.reward_fault(reward, strict=True)),
        ("terminated", faults.flag_fault("terminated", terminated, strict=True)),
        ("truncated", faults.flag_fault("truncated", truncated, strict=True)),
    ):
        if fault is not None:
            found.setdefault(kind, Finding("error", f"step returned {fault}"))
    if info.get("TimeLimit.truncated") and not truncated:
        text = (
            f"step returned info['TimeLimit.truncated']={info['TimeLimit.truncated']!r} with terminated={terminated} and "
            "truncated=False; return truncated=True where a time limit ended the episode"
        )
        found.setdefault("folded", Finding("error", text))


def _look_at_observation(obs: Any, space: gym.Space, found: dict[str, Finding], said: str) -> None:
    fault = faults.observation_fault(space, obs, strict=True)
    if fault is not None:
        found.setdefault("observation", Finding("error", f"{said} returned {fault}"))
    fault = faults.finite_fault_of(space, obs)
    if fault is not None:
        found.setdefault("finite", Finding("error", f"{said} returned {fault}"))
    elif (outside := faults.bounds_fault(space, obs)) is not None:
        # Networks never see the bounds of a Box, but a choice that does not exist has no place in them.
        level, fault = outside
        found.setdefault("bounds", Finding(level, f"{said} returned {fault}"))


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


def _copied(space: gym.Space, obs: Any) -> Any:
    return jax.tree.map(np.array, plain(space, obs))


def _rewritten(space: gym.Space, before: Any, kept: Any, after: Any) -> bool:
    """Returns whether an array returned earlier is one that was returned again, with other numbers."""
    return any(
        isinstance(old, np.ndarray)
        and np.may_share_memory(old, new)
        and not np.array_equal(old, copied, equal_nan=True)
        for old, copied, new in zip(*(jax.tree.leaves(plain(space, one)) for one in (before, kept, after)), strict=True)
        if np.asarray(new).dtype.kind in "fiub"
    )


def _check_repeats(env: gym.Env, found: dict[str, Finding]) -> None:
    """Warns where one seed does not give the same episode twice."""
    space, walks = env.observation_space, []
    env.action_space.seed(SEED)
    actions = [env.action_space.sample() for _ in range(5)]
    for _ in range(2):
        walk = [_copied(space, answers.reset(env, SEED)[0])]
        for action in actions:
            obs, _, terminated, truncated, _ = conversions.numbers_of(env.step(action))
            walk.append(_copied(space, obs))
            if terminated or truncated:
                break
        walks.append(walk)
    same = [
        jax.tree.all(jax.tree.map(lambda a, b: np.array_equal(a, b, equal_nan=a.dtype.kind == "f"), one, two))
        for one, two in zip(*walks, strict=False)
    ]
    fix = "draw everything from self.np_random"
    if not same[0]:
        text = (
            f"two resets with one seed gave different observations; call super().reset(seed=seed) in reset, and {fix}"
        )
        found["repeat"] = Finding("warning", text)
    elif not all(same) or len(walks[0]) != len(walks[1]):
        text = f"one seed and the same actions led to different observations; {fix}"
        found["repeat"] = Finding("warning", text)


def _said_by_gymnasium(env: gym.Env, skip_render_check: bool) -> list[str]:
    """Returns what Gymnasium's own checker warns of or refuses, which is more than learning needs."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        refused = []
        try:
            check_gymnasium_env(env, skip_render_check=skip_render_check)
        except Exception as error:  # whatever it refuses by
            refused = [f"{error}"]
    said = [re.sub(r"\x1b\[[\d;]*m|WARN: ", "", str(one.message)) for one in caught] + refused
    return [
        f"gymnasium.utils.env_checker: {' '.join(one.split())}"
        for one in dict.fromkeys(said)
        if "different from the unwrapped version" not in one
    ]
