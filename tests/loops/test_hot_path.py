"""What an environment step costs in crossings between Python and XLA: counted, so that no machine's speed matters.

Three things are counted. Calls of compiled functions, by wrapping each that ``Learner`` makes, with the NumPy arrays among
their arguments, each of which crosses to the device. Reads from the device, wherever a ``jax.Array`` becomes a NumPy array
or a Python number. And compilations, by JAX's own events; as every program must be compiled again after
``jax.clear_caches()``, their number in a stretch after it is the number of different programs that ran there, which shows
that nothing but the counted functions was dispatched, no arithmetic on device arrays either.
"""

from __future__ import annotations

import functools
import itertools
from collections import Counter
from typing import Any, NamedTuple

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rejeu
from rejeu.envs.make import InProcess
from tests.environments import Reach, Sampled

COMPILED = "/jax/core/compile/backend_compile_duration"
_compilations: list[str] = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, seconds, **_: _compilations.append(event) if event == COMPILED else None
)


class Tally:
    """What has crossed so far."""

    def __init__(self) -> None:
        self.calls: Counter[str] = Counter()
        """Calls, by compiled function."""
        self.arrays: Counter[str] = Counter()
        """NumPy arrays and numbers among their arguments, by function."""
        self.reads = 0

    def now(self) -> dict[str, int]:
        """Everything, to be subtracted from later."""
        counted = {**self.calls, **{f"{name} in": n for name, n in self.arrays.items()}}
        return {**counted, "reads": self.reads, "compilations": len(_compilations)}


def since(before: dict[str, int], after: dict[str, int]) -> dict[str, int]:
    """What was counted in between, without what did not happen."""
    return {key: after[key] - before.get(key, 0) for key in after if after[key] != before.get(key, 0)}


@pytest.fixture
def tally(monkeypatch):
    counted = Tally()
    jit, asarray, get = jax.jit, np.asarray, jax.device_get

    def counting_jit(function: Any = None, **options: Any) -> Any:
        if function is None:
            return functools.partial(counting_jit, **options)
        compiled, name = jit(function, **options), function.__name__

        def call(*arguments: Any) -> Any:
            counted.calls[name] += 1
            leaves = jax.tree.leaves(arguments)
            counted.arrays[name] += sum(isinstance(leaf, np.ndarray | np.generic | float | int) for leaf in leaves)
            return compiled(*arguments)

        return call

    def reading(function: Any) -> Any:
        @functools.wraps(function)
        def read(array: Any, *arguments: Any, **keywords: Any) -> Any:
            counted.reads += isinstance(array, jax.Array)
            return function(array, *arguments, **keywords)

        return read

    monkeypatch.setattr(jax, "jit", counting_jit)
    monkeypatch.setattr(np, "asarray", reading(asarray))
    monkeypatch.setattr(np, "array", reading(np.array))
    monkeypatch.setattr(jax, "device_get", reading(get))
    for name in ("__array__", "__float__", "__int__", "__bool__", "__index__", "item", "tolist"):
        kind = type(jnp.zeros(()))
        monkeypatch.setattr(kind, name, reading(getattr(kind, name)))
    return counted


def sampled(n_envs: int = 1, n_actions: int | None = None) -> InProcess:
    """Environments with 3 numbers to see, 1 or a choice to do, and episodes of 5 steps."""
    actions = None if n_actions is None else gym.spaces.Discrete(n_actions)
    return InProcess([Sampled(gym.spaces.Box(-1.0, 1.0, (3,)), actions) for _ in range(n_envs)], seed=0)


OFF = {"learning_starts": 4, "batch_size": 4, "buffer_size": 300, "policy_kwargs": {"net_arch": [8]}, "seed": 0}
ON = {"n_steps": 4, "policy_kwargs": {"net_arch": [8]}, "seed": 0}


class Case(NamedTuple):
    make: Any
    turn: dict[str, int]
    """What a turn costs that is no multiple of :attr:`every`."""
    update: dict[str, int] | None = None
    """What one costs that ends in an update, where there is none in every turn."""
    n_envs: int = 1


OFF_POLICY = {"act": 1, "act in": 1, "update": 1, "update in": 1, "reads": 2}
"""Two calls a turn, with one array each. Two reads: the actions, and whether the update before left finite numbers."""
ACT = {"act": 1, "act in": 1, "reads": 1}
LEARN = {**ACT, "update": 1, "update in": 1, "copy": 1}
HER = {"replay_buffer_class": "HerReplayBuffer", **OFF}
EVERY = 4
"""Turns between two updates of the on-policy agents."""

CASES = {
    "SAC": Case(lambda: rejeu.SAC("MlpPolicy", sampled(), **OFF), OFF_POLICY),
    "SAC, 3 environments": Case(lambda: rejeu.SAC("MlpPolicy", sampled(3), **OFF), OFF_POLICY, n_envs=3),
    "SAC, 4 gradient steps": Case(lambda: rejeu.SAC("MlpPolicy", sampled(), gradient_steps=4, **OFF), OFF_POLICY),
    "SAC, skipping": Case(lambda: rejeu.SAC("MlpPolicy", sampled(), nonfinite="skip", **OFF), OFF_POLICY),
    "SAC with hindsight": Case(lambda: rejeu.SAC("MultiInputPolicy", InProcess([Reach()]), **HER), OFF_POLICY),
    "SAC with hindsight, 2 environments": Case(
        lambda: rejeu.SAC("MultiInputPolicy", InProcess([Reach(), Reach()]), **HER), OFF_POLICY, n_envs=2
    ),
    "SAC, normalised": Case(
        lambda: rejeu.SAC("MlpPolicy", sampled(), normalize=True, **OFF),
        {**OFF_POLICY, "observe": 1, "observe in": 1},
    ),
    "TD3": Case(lambda: rejeu.TD3("MlpPolicy", sampled(), **OFF), OFF_POLICY),
    "DQN": Case(lambda: rejeu.DQN("MlpPolicy", sampled(1, 3), train_freq=1, **OFF), OFF_POLICY),
    "DQN, 2 environments": Case(
        lambda: rejeu.DQN("MlpPolicy", sampled(2, 3), train_freq=1, **OFF), OFF_POLICY, n_envs=2
    ),
    "DQN with priorities": Case(
        lambda: rejeu.DQN("MlpPolicy", sampled(1, 3), train_freq=1, priorities={}, **OFF),
        {**OFF_POLICY, "reads": 3},
    ),
    "PPO": Case(
        lambda: rejeu.PPO("MlpPolicy", sampled(), batch_size=4, n_epochs=2, **ON),
        ACT,
        LEARN,
    ),
    "PPO, 3 environments": Case(
        lambda: rejeu.PPO("MlpPolicy", sampled(3), batch_size=4, n_epochs=2, **ON),
        ACT,
        LEARN,
        3,
    ),
    "A2C": Case(lambda: rejeu.A2C("MlpPolicy", sampled(1, 3), **ON), ACT, LEARN),
    "A2C, 3 environments": Case(lambda: rejeu.A2C("MlpPolicy", sampled(3, 3), **ON), ACT, LEARN, 3),
}


def counts(agent: rejeu.agents.Agent, tally: Tally, n_turns: int) -> list[dict[str, int]]:
    """Learns and returns what each of so many turns costs, from the second on."""
    seen: list[dict[str, int]] = []
    agent.learn(n_turns * agent.n_envs, lambda *_: seen.append(tally.now()), reset_num_timesteps=False)
    return [since(one, two) for one, two in itertools.pairwise(seen)]


@pytest.mark.parametrize("name", CASES)
def test_a_step_crosses_to_the_device_and_back_exactly_so_often(name, tally):
    """Over 20 turns, four ends of episodes among them, after 12 to warm up; no copy for the watch falls into them."""
    case = CASES[name]
    agent = case.make()
    agent.learn(12 * case.n_envs)
    for i, turn in enumerate(counts(agent, tally, 20)):
        number = i + 14  # of the turns of the run, counted from 1
        if case.update is None:
            assert turn == case.turn, number
        else:
            # The turn after an update reads whether it left finite numbers.
            flag = {"reads": 2} if number % EVERY == 1 else {}
            assert turn == {**(case.update if number % EVERY == 0 else case.turn), **flag}, number


@pytest.mark.parametrize("name", ["SAC", "SAC, 3 environments", "DQN with priorities", "PPO", "A2C, 3 environments"])
def test_nothing_is_dispatched_but_the_counted_functions(name, tally):
    case = CASES[name]
    agent = case.make()
    agent.learn(12 * case.n_envs)
    jax.clear_caches()
    before = tally.now()
    agent.learn(9 * case.n_envs, reset_num_timesteps=False)
    spent = since(before, tally.now())
    assert spent["compilations"] == len({"act", "update", "copy"} & {*spent})


@pytest.mark.parametrize("name", CASES)
def test_nothing_is_compiled_after_the_first_steps(name, tally):
    """Not where episodes end, in a last turn that keeps some of its steps, in a second ``learn`` nor in a third."""
    case = CASES[name]
    agent = case.make()
    n = case.n_envs
    agent.learn(12 * n + (n > 1))  # a turn that is cut is met, as are remainders of a scan
    agent.learn(8 * n, reset_num_timesteps=False)
    before = len(_compilations)
    agent.learn(9 * n + (n > 1), reset_num_timesteps=False)
    agent.learn(11 * n, reset_num_timesteps=False)
    assert len(_compilations) == before


def test_delayed_updates_are_no_programs_of_their_own(tally):
    """Of TD3 every second update moves the actor; one program holds both kinds."""
    agent = CASES["TD3"].make()
    agent.learn(12)
    turns = counts(agent, tally, 8)
    assert all(turn == CASES["TD3"].turn for turn in turns)
    assert int(agent.state.n_updates) == agent.n_updates == 16


def test_the_watch_copies_the_state_once_in_64_updates(tally):
    """Episodes of 10 steps here: from the 20th on the best weights are copied too."""
    agent = CASES["SAC with hindsight"].make()
    agent.learn(4 + 64)
    before = tally.now()
    agent.learn(64, reset_num_timesteps=False)
    # Reads: two a turn but one in the first, three to look at the state before all, one to look at the last update.
    assert since(before, tally.now()) == {
        "act": 64,
        "act in": 64,
        "update": 64,
        "update in": 64,
        "copy": 1,
        "reads": 2 * 64 - 1 + 3 + 1,
    }


# The counters count


def extra(agent: rejeu.agents.Agent, tally: Tally, what: Any) -> dict[str, int]:
    """What one turn costs in which ``what(agent)`` is called."""
    seen: list[dict[str, int]] = []

    def callback(agent: Any, progress: Any) -> None:
        seen.append(tally.now())
        what(agent)

    agent.learn(4, callback, reset_num_timesteps=False)
    return since(seen[1], seen[2])


EXTRA = {
    "a call": (lambda agent: agent.learner.copy(agent.run.state), {"copy": 1}),
    "an argument": (lambda agent: agent.learner.copy([np.zeros(3)]), {"copy": 1, "copy in": 1}),
    "np.asarray": (lambda agent: np.asarray(agent.run.metrics["q_value"].block_until_ready()), {"reads": 1}),
    "float": (lambda agent: float(agent.run.metrics.vector[0]), {"reads": 1}),
    "jax.device_get": (lambda agent: jax.device_get(agent.run.metrics.vector), {"reads": 1}),
}


@pytest.mark.parametrize("what", EXTRA)
def test_one_crossing_more_is_seen(what, tally):
    agent = CASES["SAC"].make()
    agent.learn(12)
    action, more = EXTRA[what]
    action(agent)  # compiled by now
    turn = extra(agent, tally, action)
    budget = Counter(CASES["SAC"].turn)
    for key, n in more.items():
        assert turn[key] >= budget[key] + n, key


def test_a_program_more_is_seen(tally):
    """Arithmetic on an array of the device is a program, though none of ours."""
    agent = CASES["SAC"].make()
    agent.learn(12)
    vector = jnp.ones(7) * 3
    _ = vector * 2.5
    jax.clear_caches()
    before = tally.now()
    agent.learn(4, lambda *_: bool((vector * 2.5).shape), reset_num_timesteps=False)
    spent = since(before, tally.now())
    assert spent["compilations"] > len({"act", "update", "copy"} & {*spent})


def test_a_compilation_more_is_seen(tally):
    agent = CASES["SAC"].make()
    agent.learn(12)
    before = len(_compilations)
    agent.predict(np.zeros((5, 3), np.float32), deterministic=True)  # a batch of a size that nothing had
    assert len(_compilations) == before + 1
