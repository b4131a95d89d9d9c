"""No key of random numbers is used twice: what is drawn by one key is independent of all else that is drawn."""

import itertools
from collections import Counter
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
import pytest

import rejeu
from rejeu import agents
from rejeu.algorithms.config import OffPolicyConfig
from rejeu.training.run import clock_of
from tests.algorithms.probes.environments import Discretely, Probe
from tests.tiers import only

DISCRETE = ("DQN", "QRDQN", "IQN", "PQN", "MaskablePPO")
VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    "SAC, held noise": ("SAC", {"noise_repeat": 4}),
    "FlashSAC, no held noise": ("FlashSAC", {"noise_repeat": 1}),
    "SAC, state-dependent noise": ("SAC", {"use_sde": True, "sde_sample_freq": 4}),
    "SAC, dropout and a subset": (
        "SAC",
        {"n_critics": 3, "target_subset": 2, "policy_kwargs": {"net_arch": [8], "dropout": 0.1}},
    ),
    "SAC, memory": ("SAC", {"policy_kwargs": {"net_arch": [8], "lstm_hidden_size": 4, "sequence_length": 4}}),
    "SAC, bonus": ("SAC", {"rnd": {"coefficient": 0.1}}),
    "PPO, bonus": ("PPO", {"rnd": {"coefficient": 0.1}}),
    "PPO, state-dependent noise": ("PPO", {"use_sde": True}),
    "TD3, action noise": ("TD3", {"action_noise": 0.1}),
    "TD3, parameter noise": ("TD3", {"action_noise": rejeu.ParameterNoise()}),
    "DQN, masks": ("DQN", {"action_masks": True}),
    "DQN, noisy": ("DQN", {"noisy": True, "double_q": True}),
    "IQN, noisy": ("IQN", {"noisy": True, "double_q": True}),
}
DEFAULT = (
    *("SAC, dropout and a subset", "SAC, memory", "SAC, held noise", "TD3, parameter noise", "CrossQ"),
    *("IQN, noisy", "PPO, bonus", "PPO", "ARS"),
)
"""Everything that draws: replay, noise, dropout, quantiles, memory, orders and directions."""
KINDS = {**{name: (name, {}) for name in agents.AGENTS}, **VARIANTS}


def twice(closed: Any) -> set[str]:
    """Returns the keys that a traced function draws by more than once, or both draws by and splits.

    Values that are computed alike get one number, so a key is known again if it is derived a second time. The bodies of loops
    are walked twice, because what they draw by a key from outside is drawn at every turn.
    """
    fresh, known = itertools.count(), dict[Any, int]()

    def walk(jaxpr: Any, inputs: Sequence[int], consts: Sequence[int]) -> tuple[list[int], Counter[tuple[str, int]]]:
        numbers = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *inputs], strict=True))
        uses: Counter[tuple[str, int]] = Counter()

        def number(value: Any) -> int:
            if hasattr(value, "val"):
                return known.setdefault(("literal", str(value.val), str(value.aval)), next(fresh))
            return numbers[value]

        for equation in jaxpr.eqns:
            given, name, params = [number(value) for value in equation.invars], equation.primitive.name, equation.params
            if name in ("random_bits", "random_split"):
                uses[name, given[0]] += 1
            results, inner = None, [part for part in jax.tree.leaves(list(params.values())) if hasattr(part, "eqns")]
            if name == "cond":
                found = [walk_closed(branch, given[1:])[1] for branch in params["branches"]]
                for key in {key for one in found for key in one}:
                    uses[key] += max(one[key] for one in found)
            elif name in ("scan", "while"):
                body = params["jaxpr" if name == "scan" else "body_jaxpr"]
                skipped = 0 if name == "scan" else params["cond_nconsts"]
                kept = given[skipped:][: params["body_nconsts"] if name == "while" else n_consts(params)]
                for _ in range(2):
                    carried = [next(fresh) for _ in range(len(body.jaxpr.invars) - len(kept))]
                    uses += walk_closed(body, [*kept, *carried])[1]
            elif inner and len(inner[0].invars if hasattr(inner[0], "invars") else inner[0].jaxpr.invars) == len(given):
                results, within = walk_closed(inner[0], given)
                uses += within
            kind = next(fresh) if inner or name in ("cond", "scan", "while") else str(params)
            for i, variable in enumerate(equation.outvars):
                own = (name, kind, *given, i)
                numbers[variable] = known.setdefault(own, next(fresh)) if results is None else results[i]
        return [number(value) for value in jaxpr.outvars], uses

    def walk_closed(closed: Any, inputs: Sequence[int]) -> tuple[list[int], Counter[tuple[str, int]]]:
        inner = getattr(closed, "jaxpr", closed)
        return walk(inner, inputs, [next(fresh) for _ in inner.constvars])

    uses = walk_closed(closed, [next(fresh) for _ in closed.jaxpr.invars])[1]
    drawn = {key: n for (name, key), n in uses.items() if name == "random_bits"}
    return {f"{n} times" for n in drawn.values() if n > 1} | {
        "split as well" for key in drawn if ("random_split", key) in uses
    }


def n_consts(params: Any) -> int:
    """Returns how many arguments of a scan are the same at every turn, by its parameters before and since JAX 0.12."""
    if "num_consts" in params:
        return params["num_consts"]
    return len(jax.tree.leaves(params["ft_in"][0], is_leaf=lambda leaf: leaf is None))


def draw_in_turns(key: Any) -> Any:
    """Draws by the same key three times."""
    return jax.lax.map(lambda i: i * jax.random.normal(key), jax.numpy.arange(3.0))


@pytest.mark.parametrize(
    ("function", "expected"),
    [
        (lambda key: jax.random.normal(key) + jax.random.normal(jax.random.fold_in(key, 1)), set()),
        (lambda key: sum(jax.random.normal(one) for one in jax.random.split(key)), set()),
        (lambda key: jax.random.normal(key) + jax.random.uniform(key), {"2 times"}),
        (lambda key: sum(jax.random.normal(jax.random.fold_in(key, 1)) for _ in range(3)), {"3 times"}),
        (lambda key: jax.random.normal(key) + jax.random.normal(jax.random.split(key)[0]), {"split as well"}),
        (lambda key: jax.jit(jax.random.normal)(key) + jax.random.normal(key), {"2 times"}),
        (draw_in_turns, {"2 times"}),
    ],
)
def test_keys_that_are_used_twice_are_found(function: Any, expected: set[str]) -> None:
    assert twice(jax.make_jaxpr(function)(jax.random.PRNGKey(0))) == expected


@pytest.mark.parametrize("name", only(DEFAULT, KINDS))
def test_no_key_of_an_algorithm_is_used_twice(name: str) -> None:
    """Neither where its state begins, nor where it acts, nor in an update."""
    kind, settings = KINDS[name]
    probe = Probe()
    env: Any = Discretely(probe) if kind in DISCRETE else probe
    env.action_masks = lambda: np.ones(env.action_space.n, bool)
    few = (
        {"learning_starts": 100, "batch_size": 8}
        if issubclass(agents.AGENTS[kind].algorithm.Config, OffPolicyConfig)
        else {}
    )
    agent = agents.AGENTS[kind]("MlpPolicy", env, seed=0, **{"policy_kwargs": {"net_arch": [8]}, **few, **settings})
    learner, run = agent.learner, agent.run
    agent.learn(20)
    clock = clock_of(run, 0.5)
    assert not twice(jax.make_jaxpr(learner._init)(run.key))
    acting = run.state, run.carry, run.obs, run.ended, run.key, clock
    assert not twice(jax.make_jaxpr(lambda *given: learner._act(learner.explorer, *given))(*acting))
    batch = run.replay.draw(np.random.default_rng(0), (8,))[0] if few else run.replay.rollout()
    assert not twice(jax.make_jaxpr(learner._update)(run.state, batch, clock))
