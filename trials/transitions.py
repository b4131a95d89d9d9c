"""Samples transitions from replay buffers during training, and compares each with the records of the environments.

    python trials/transitions.py

The agents train in environments that record everything they return. Between two calls of ``learn``, batches are sampled
from
the replay buffer. Every transition is recomputed from the records in plain Python that shares no code with the buffers:
observation, action, n-step reward, discount, next observation, goal, priority and weight. The cases are uniform and
prioritized replay, 1 and 3 steps, all four hindsight strategies with and without ``compute_terminated``, and frame
stacking, each with 1 and 3 environments. Episodes are short and end by termination and by truncation. The buffers are
so small that they wrap around many times. Calls of ``learn`` end within episodes, and within a vector step.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import time
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from scipy.stats import chisquare

import rejeu
from rejeu.envs.make import InProcess

RESULT = Path(__file__).parent / "results" / "transitions.json"
GAMMA, ALPHA, EPSILON, BETA = 0.9, 0.6, 1e-3, (0.4, 1.0)
K, STACK, SIDE = 4, 4, 36
ROWS, CALLS = 50, 24
"""Buffer size in rows per environment, and number of calls of ``learn``."""
BATCHES, BATCH = 2, 64
NEAR = 0.5
"""Distance at which a goal is reached. All positions are multiples of 1/8, so sums are exact in any precision."""


class Case(NamedTuple):
    """A configuration of the replay buffer."""

    n_envs: int
    n_steps: int
    prioritized: bool
    strategy: str | None = None
    """Hindsight strategy; None without hindsight."""
    ends: bool = False
    """Whether the environment has ``compute_terminated``."""
    frames: bool = False
    """Whether observations are stacked frames."""


class Row:
    """An observation and, once it has been taken, the step from it."""

    def __init__(self, serial: int, episode: int, obs: Any) -> None:
        self.serial, self.episode, self.obs = serial, episode, obs
        self.step: tuple[Any, float, bool] | None = None
        """Action, reward and whether the step terminated."""


class Recorded(gym.Env):
    """Records everything that it returns. Episodes have 1 to 9 steps; half of them terminate."""

    def __init__(self, number: int, case: Case) -> None:
        self.number, self.case = number, case
        self.rng = np.random.default_rng([number, 17])
        self.rows: list[Row] = []
        self.serials = itertools.count()
        self.episode = -1
        real = spaces.Box(-np.inf, np.inf, (3,), np.float32)
        self.observation_space: spaces.Space = real
        if case.strategy is not None:
            self.observation_space = spaces.Dict(dict.fromkeys(("achieved_goal", "desired_goal", "observation"), real))
        if case.frames:
            self.observation_space = spaces.Box(0, 255, (SIDE, SIDE), np.uint8)
        self.action_space = spaces.Discrete(5) if case.frames else spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.episode += 1
        self.length, self.terminates = int(self.rng.integers(1, 10)), bool(self.rng.integers(2))
        self.time, self.position, self.goal = 0, self.on_grid(8), self.on_grid(8)
        return self.observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.time += 1
        self.position = self.position + self.on_grid(8)
        over = self.time == self.length
        terminated = over and self.terminates
        if self.case.strategy is None:
            reward = float(self.on_grid(80)[0])
        else:
            reward = reward_of(self.position, self.goal) - 5.0 * terminated  # a penalty, independent of the goal
            terminated = terminated or (self.case.ends and distance(self.position, self.goal) <= NEAR)
        self.rows[-1].step = (np.array(action), reward, bool(terminated))
        return self.observe(), reward, bool(terminated), over, {}

    def on_grid(self, most: int) -> np.ndarray:
        return self.rng.integers(-most, most + 1, 2) / 8

    def observe(self) -> Any:
        serial = next(self.serials)
        obs: Any = np.array([self.number, serial, self.rng.random()], np.float32)
        if self.case.strategy is not None:
            reached = np.array([*self.position, 10_000 * self.number + serial], np.float32)
            wanted = np.array([*self.goal, -1], np.float32)
            obs = {"observation": obs, "achieved_goal": reached, "desired_goal": wanted}
        if self.case.frames:
            obs = self.rng.integers(256, size=(SIDE, SIDE), dtype=np.uint8)
            obs[0, :3] = self.number, serial // 256, serial % 256
        self.rows.append(Row(serial, self.episode, obs))
        return obs


class Goals(Recorded):
    """A version with goals. The third component of an achieved goal is its id, which the reward ignores."""

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> np.ndarray:
        apart = np.abs(achieved - desired)[..., :2].sum(axis=-1)
        return (np.where(apart <= NEAR, 1.0, 0.0) - apart).astype(np.float32)


class EndingGoals(Goals):
    """A version that also defines at which goals an episode terminates."""

    def compute_terminated(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> np.ndarray:
        return np.abs(achieved - desired)[..., :2].sum(axis=-1) <= NEAR


def distance(achieved: Any, desired: Any) -> float:
    return abs(float(achieved[0]) - float(desired[0])) + abs(float(achieved[1]) - float(desired[1]))


def reward_of(achieved: Any, desired: Any) -> float:
    apart = distance(achieved, desired)
    return (1.0 if apart <= NEAR else 0.0) - apart


class Truth:
    """The expected contents of a buffer with a given number of rows per environment, from the environments' records."""

    def __init__(self, envs: list[Recorded], case: Case, rows: int) -> None:
        self.envs, self.case, self.rows = envs, case, rows
        self.largest, self.priority = 1.0, {}
        """The largest priority so far, and the priorities of all steps by environment and serial number."""

    def look(self) -> None:
        """Adds the steps that were recorded since the last call."""
        self.first = [max(len(env.rows) - self.rows, 0) for env in self.envs]
        """Index of the oldest stored row, by environment."""
        self.place = [{row.serial: i for i, row in enumerate(env.rows)} for env in self.envs]
        self.steps = [
            (e, row.serial)
            for e, env in enumerate(self.envs)
            for row in env.rows[self.first[e] :]
            if row.step is not None
        ]
        """All steps that can be sampled."""
        for key in self.steps:
            self.priority.setdefault(key, self.largest)

    def give(self, keys: list[tuple[int, int]], errors: np.ndarray) -> None:
        """Applies TD errors, also those of steps that are no longer stored."""
        priorities = [(abs(float(error)) + EPSILON) ** ALPHA for error in errors]
        kept = {*self.steps}
        self.priority.update({key: p for key, p in zip(keys, priorities, strict=True) if key in kept})
        self.largest = max(self.largest, *priorities)

    def probability(self, key: tuple[int, int]) -> float:
        if not self.case.prioritized:
            return 1.0 / len(self.steps)
        return self.priority[key] / math.fsum(self.priority[one] for one in self.steps)

    def goals(self, env: int, at: int) -> list[tuple[int, int]]:
        """Returns the achieved goals that the step at an index can be relabeled with, as environment and index."""
        strategy, rows = self.case.strategy, self.envs[env].rows
        if strategy == "random":
            return [(e, self.place[e][serial] + 1) for e, serial in self.steps]
        mine = [i for i in range(self.first[env], len(rows)) if rows[i].episode == rows[at].episode]
        chosen = {"future": [i for i in mine if i > at], "final": mine[-1:], "episode": mine[1:]}[str(strategy)]
        return [(env, i) for i in chosen]

    def transition(self, env: int, at: int, goal: Any = None) -> tuple[float, int, float]:
        """Returns reward, next observation's index and discount of the step at an index, for a new goal if given."""
        rows, total, factor = self.envs[env].rows, 0.0, 1.0
        for i in range(at, at + self.case.n_steps):
            step = rows[i].step
            if step is None:
                return total, i, factor
            reward, terminated = step[1], step[2]
            if goal is not None:
                reached = rows[i + 1].obs["achieved_goal"]
                reward = reward_of(reached, goal)
                terminated = distance(reached, goal) <= NEAR if self.case.ends else terminated
            total += factor * reward
            factor *= GAMMA
            if terminated:
                return total, i + 1, 0.0
        return total, at + self.case.n_steps, factor

    def observation(self, env: int, at: int) -> Any:
        """Returns the observation at an index. It repeats frames that are not stored or of another episode."""
        rows = self.envs[env].rows
        if not self.case.frames:
            return rows[at].obs
        start = next(i for i in range(self.first[env], at + 1) if rows[i].episode == rows[at].episode)
        return np.stack([rows[max(at - back, start)].obs for back in reversed(range(STACK))])


class Tally:
    """Counts of comparisons and differences."""

    def __init__(self) -> None:
        self.transitions = self.relabeled = self.n_ends = self.cut = 0
        self.wrong: list[str] = []
        self.shares: list[float] = []
        """Position of the sampled goal among the possible goals, in [0, 1]."""

    def check(self, good: Any, what: str) -> None:
        if not good:
            self.wrong.append(what)


def same(one: Any, two: Any) -> bool:
    if isinstance(one, dict):
        return one.keys() == two.keys() and all(np.array_equal(one[key], two[key]) for key in one)
    return np.array_equal(one, two)


def name(case: Case, obs: Any) -> tuple[int, int]:
    """Returns the environment and serial number of a sampled observation."""
    if case.frames:
        e, high, low = (int(n) for n in obs[-1, 0, :3])
        return e, 256 * high + low
    numbers = obs["observation"] if case.strategy is not None else obs
    return int(numbers[0]), int(numbers[1])


def rows_of(tree: Any, index: tuple[int, ...]) -> Any:
    return {key: part[index] for key, part in tree.items()} if isinstance(tree, dict) else tree[index]


def compare(truth: Truth, batch: Any, weights: np.ndarray | None, tally: Tally) -> list[tuple[int, int]]:
    """Compares batches ``(batches, size)`` with the expected values and returns the sampled steps in order."""
    case, keys = truth.case, []
    n_batches, size = batch.reward.shape
    share = int(size * K / (K + 1)) if case.strategy is not None else 0
    for b, i in itertools.product(range(n_batches), range(size)):
        obs, next_obs = rows_of(batch.obs, (b, i)), rows_of(batch.next_obs, (b, i))
        e, serial = name(case, obs)
        keys.append((e, serial))
        tally.transitions += 1
        at = truth.place[e].get(serial)
        if at is None or at < truth.first[e] or truth.envs[e].rows[at].step is None:
            tally.check(False, f"step {serial} of environment {e} is no step that is kept")
            continue
        goal = None
        if i < share:
            goal = obs["desired_goal"]
            allowed = truth.goals(e, at)
            said = [truth.envs[one].rows[place].obs["achieved_goal"] for one, place in allowed]
            found = [j for j, one in enumerate(said) if np.array_equal(one, goal)]
            tally.check(len(found) == 1, f"goal {goal} is none of the {len(said)} of {case.strategy}")
            tally.shares += [(j + 0.5) / len(said) for j in found if len(said) > 1]
            tally.relabeled += 1
        reward, following, discount = truth.transition(e, at, goal)
        expected = [truth.observation(e, at), truth.observation(e, following)]
        if goal is not None:
            expected = [{**one, "desired_goal": goal} for one in expected]
        tally.n_ends += discount == 0.0
        tally.cut += following - at < case.n_steps and discount > 0.0
        tally.check(same(obs, expected[0]), f"observation of step {serial} of environment {e}")
        tally.check(same(next_obs, expected[1]), f"next observation of step {serial} of environment {e}")
        step = truth.envs[e].rows[at].step
        assert step is not None
        tally.check(np.array_equal(batch.action[b, i], step[0]), f"action of step {serial} of environment {e}")
        close = math.isclose(float(batch.reward[b, i]), reward, rel_tol=1e-6, abs_tol=1e-5)
        tally.check(close, f"reward {batch.reward[b, i]} of step {serial}, expected {reward}")
        close = math.isclose(float(batch.discount[b, i]), discount, rel_tol=1e-6)
        tally.check(close, f"discount {batch.discount[b, i]} of step {serial}, expected {discount}")
    if weights is not None:
        unscaled = [(len(truth.steps) * truth.probability(key)) ** -weights[0] for key in keys]
        expected_weight = np.reshape(unscaled, (n_batches, size))
        expected_weight /= expected_weight.max(axis=1, keepdims=True)
        tally.check(np.allclose(batch.weight, expected_weight, rtol=1e-4), "importance weights")
    return keys


def make(case: Case) -> tuple[list[Recorded], Any]:
    kind = Recorded if case.strategy is None else EndingGoals if case.ends else Goals
    envs = [kind(i, case) for i in range(case.n_envs)]
    settings: dict[str, Any] = {"buffer_size": ROWS * case.n_envs, "learning_starts": 10**9, "gamma": GAMMA, "seed": 0}
    settings |= {"batch_size": 1, "n_steps": case.n_steps, "policy_kwargs": {"net_arch": [4]}}
    if case.prioritized:
        beta = rejeu.Linear(*BETA)
        settings["priorities"] = {"alpha": ALPHA, "epsilon": EPSILON, "beta": beta}
    if case.frames:
        wrapped = [gym.wrappers.FrameStackObservation(env, STACK) for env in envs]
        return envs, rejeu.DQN("CnnPolicy", InProcess(wrapped), frame_stack=STACK, **settings)
    if case.strategy is not None:
        settings["replay_buffer_class"] = "HerReplayBuffer"
        settings["replay_buffer_kwargs"] = {"n_sampled_goal": K, "goal_selection_strategy": case.strategy}
    policy = "MlpPolicy" if case.strategy is None else "MultiInputPolicy"
    return envs, rejeu.SAC(policy, InProcess(envs), **settings)


def learn(agent: Any, envs: list[Recorded], n: int) -> None:
    """Takes ``n`` steps and removes from the records what the last vector step discards.

    If the number of environments does not divide ``n``, the last vector step steps all environments but stores only the
    steps of the first ones. The episodes of the others are discarded.
    """
    agent.learn(n, reset_num_timesteps=False)
    for env in envs[n % len(envs) :] if n % len(envs) else ():
        assert env.rows[-1].episode > env.rows[-2].episode, "the environment was not reset"
        del env.rows[-2]
        env.rows[-2].step = None


def try_case(case: Case, seed: int) -> dict[str, Any]:
    rng, tally = np.random.default_rng([seed, 1]), Tally()
    envs, agent = make(case)
    truth, buffer = Truth(envs, case, ROWS), agent.replay_buffer
    pending: tuple[Any, list[tuple[int, int]], np.ndarray] | None = None
    for _ in range(CALLS):
        learn(agent, envs, int(rng.integers(1, 40)))
        truth.look()
        if pending is not None:  # one call later, because some of the steps were overwritten
            drawn, keys, errors = pending
            buffer.update_priorities([(drawn, errors)])
            truth.give(keys, errors)
        tally.check(buffer.size() == len(truth.steps), f"{buffer.size()} steps, expected {len(truth.steps)}")
        if not truth.steps:
            continue
        progress = float(rng.random())
        batch, drawn = buffer.draw(rng, (BATCHES, BATCH), progress)
        beta = BETA[0] + (BETA[1] - BETA[0]) * progress
        keys = compare(truth, batch, np.array([beta]) if case.prioritized else None, tally)
        if case.prioritized:
            pending = drawn, keys, rng.exponential(2.0, (BATCHES, BATCH)).astype(np.float32).ravel()
    counts = dict.fromkeys(truth.steps, 0)
    many = buffer.sample(rng, (100 * len(truth.steps),))
    for i in range(len(many.reward)):
        key = name(case, rows_of(many.obs, (i,)))
        tally.check(key in counts, f"step {key} is no step that is kept")
        counts[key] = counts.get(key, 0) + 1
    tally.check(all(counts.values()) or case.prioritized, "a step that is kept was never drawn")
    expected = np.array([truth.probability(key) for key in truth.steps]) * len(many.reward)
    p = float(chisquare([counts[key] for key in truth.steps], expected).pvalue)
    tally.check(p > 1e-6, f"steps are not drawn in proportion: p = {p:.1e}")
    if tally.shares:
        off = abs(np.mean(tally.shares) - 0.5) * math.sqrt(12 * len(tally.shares))
        tally.check(off < 5, f"goals are not drawn uniformly: {off:.1f} standard errors")
    wrapped = min(len(env.rows) for env in envs) / ROWS
    return {
        **case._asdict(),
        "transitions": tally.transitions,
        "relabeled": tally.relabeled,
        "terminal": tally.n_ends,
        "shorter_than_n_steps": tally.cut,
        "times_wrapped": round(wrapped, 1),
        "p_of_the_frequencies": round(p, 4),
        "differ": len(tally.wrong),
        "first_differences": tally.wrong[:3],
    }


def cases() -> list[Case]:
    plain = [Case(*parts) for parts in itertools.product((1, 3), (1, 3), (False, True))]
    strategies = ("future", "final", "episode", "random")
    goals = [case._replace(strategy=one, ends=ends) for one in strategies for ends in (False, True) for case in plain]
    return [*plain, *goals, *(case._replace(frames=True) for case in plain)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    warnings.simplefilter("error")
    began, results = time.monotonic(), []
    for case in cases():
        results.append(try_case(case, arguments.seed))
        print(json.dumps(results[-1]), flush=True)
    totals = {key: sum(one[key] for one in results) for key in ("transitions", "relabeled", "terminal", "differ")}
    from provenance import provenance, write

    content = {**provenance(), "seconds": round(time.monotonic() - began), **totals, "cases": results}
    write(RESULT, content, rows="cases")
    print(
        f"{totals['transitions']:,} transitions in {len(results)} cases, {totals['relabeled']:,} with another goal, "
        f"{totals['terminal']:,} into a terminal state: {totals['differ']} differ"
    )
    if totals["differ"]:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
