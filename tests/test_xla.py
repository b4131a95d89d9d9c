"""What runs once is compiled quickly by whichever XLA there is, and updates run in one thread of it."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from gymnasium import spaces

from rejeu import xla
from rejeu.algorithms import ddpg, dqn, sac, sac_discrete, td3, tqc
from rejeu.core import Clock, Transition, descend, polyak
from rejeu.loops.learner import Learner

ON_CPU = pytest.mark.skipif(jax.default_backend() != "cpu", reason="of XLA on CPUs")
AS_USERS_DO = {"xla_backend_optimization_level": 3, "xla_cpu_use_fusion_emitters": True}
AT_ONCE = 8
"""Kernels that may wait before XLA gives some of them to another thread."""


def test_what_runs_once_is_computed_also_where_xla_does_not_know_the_options(monkeypatch):
    monkeypatch.setattr(xla, "RUN_ONCE", {"xla_an_option_that_is_gone": False})
    with pytest.raises(jax.errors.JaxRuntimeError, match="No such compile option"):
        jax.jit(lambda x: 2.0 * x, compiler_options=xla.RUN_ONCE)(jnp.float32(3.0))
    assert xla.run_once(lambda x: 2.0 * x)(jnp.float32(3.0)) == 6.0


def test_other_errors_of_the_device_are_not_hidden():
    def broken(x):
        def raises(_):
            raise RuntimeError("the cause")

        return jax.pure_callback(raises, x, x)

    with pytest.raises(jax.errors.JaxRuntimeError, match="the cause"):
        jax.block_until_ready(xla.run_once(broken)(jnp.float32(1.0)))


@pytest.mark.parametrize("wrapped", [xla.outlined, xla.one_kernel])
def test_a_function_apart_computes_the_same_and_takes_any_tree_and_setting(wrapped):
    def function(tree, factor, activation, *, nothing):
        assert nothing is None
        return {"sum": tree["a"] + factor * tree["b"], "activated": activation(tree["a"]), "a": tree["a"]}

    tree = {"a": jnp.linspace(-1.0, 1.0, 7), "b": np.arange(7, dtype=np.float32)}
    expected = function(tree, 0.5, jnp.tanh, nothing=None)
    inside = jax.jit(lambda tree: wrapped(function)(tree, 0.5, jnp.tanh, nothing=None))
    for found in (wrapped(function)(tree, 0.5, jnp.tanh, nothing=None), inside(tree)):
        jax.tree.map(lambda e, f: np.testing.assert_allclose(f, e, rtol=1e-6), expected, found)


@pytest.mark.parametrize("wrapped", [xla.outlined, xla.one_kernel])
def test_a_function_apart_may_be_differentiated_and_batched(wrapped):
    cube = wrapped(lambda x: x**3)
    np.testing.assert_allclose(jax.jit(jax.vmap(jax.grad(cube)))(jnp.arange(4.0)), 3 * np.arange(4.0) ** 2, rtol=1e-6)


@ON_CPU
def test_an_optimizers_step_is_one_kernel_unless_much_goes_into_it():
    def kernels(width):
        params = [jnp.ones((width, width)), jnp.ones(width)]
        optimizer = optax.scale_by_adam()

        def step(params, gradients, state):
            after, state = descend(params, gradients, state, optimizer, 0.1)
            return polyak(params, after, 0.5), state

        lowered = jax.jit(step).lower(params, params, optimizer.init(params))
        return sum(
            " call(" in line and "xla_cpu_small_call" in line for line in lowered.compile().as_text().splitlines()
        )

    assert kernels(8) == 2
    assert kernels(1024) == 0


def test_other_processors_are_told_nothing(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    lowered = jax.jit(xla.one_kernel(lambda x: 2.0 * x)).lower(jnp.ones(3))
    assert "call" not in lowered.as_text()


@ON_CPU
@pytest.mark.parametrize("module", [ddpg, td3, sac, tqc, dqn, sac_discrete])
def test_an_update_never_has_so_many_kernels_waiting_that_xla_shares_them_among_threads(module):
    text = compiled_update(module)
    most = {name: most_waiting(text, name) for name in computations_run(text)}
    assert len(most) >= 3, "targets and gradients are functions of their own"
    assert max(most.values()) <= AT_ONCE, most


def test_kernels_that_wait_are_counted():
    wide = jax.jit(lambda xs: [jnp.sum(x) for x in xs]).lower([jnp.ones((k, 50)) for k in range(2, 14)])
    text = wide.compile(AS_USERS_DO).as_text()
    assert most_waiting(text, computations_run(text)[0]) == 11  # one of the twelve runs


def compiled_update(module) -> str:
    """Returns the compiled program of an update of batches of 32 with 32-32, as XLA writes it."""
    discrete = module in (dqn, sac_discrete)
    action_space = spaces.Discrete(3) if discrete else spaces.Box(-1, 1, (2,), np.float32)
    config = module.Config(policy_kwargs={"net_arch": [32, 32]}, batch_size=32)
    compiled = Learner(module.make(config, spaces.Box(-np.inf, np.inf, (5,), np.float32), action_space), None)
    batch = Transition(
        obs=np.zeros((32, 5), np.float32),
        action=np.zeros(32, np.int32) if discrete else np.zeros((32, 2), np.float32),
        reward=np.zeros(32, np.float32),
        next_obs=np.zeros((32, 5), np.float32),
        discount=np.zeros(32, np.float32),
    )
    clock = Clock(step=np.uint32(1), episode=np.uint32(1), progress=np.float32(0))
    vectors, plan = compiled._update_packer((batch, clock), 32)
    state = compiled.init(jax.random.PRNGKey(0))
    return compiled._update.lower(state, vectors, plan).compile(AS_USERS_DO).as_text()


def instructions(text: str, computation: str) -> list[tuple[str, str, list[str], str]]:
    """Returns name, operation, operands and the whole line of each instruction of a computation."""
    text = re.sub(r"/\*.*?\*/", "", text)
    body = re.search(rf"^(?:ENTRY )?%?{re.escape(computation)} .*?^}}", text, re.M | re.S)
    assert body is not None
    found = []
    for line in body.group().splitlines()[1:-1]:
        parts = re.match(r"\s*(?:ROOT )?%?(\S+) = (?:\([^=]*?\)|\S+) ([\w\-]+)\((.*)", line)
        assert parts is not None, line
        operands = parts.group(3).split("), ")[0]
        found.append((parts.group(1), parts.group(2), re.findall(r"%([\w.\-]+)", operands), line))
    return found


def computations_run(text: str) -> list[str]:
    """Returns the computations whose kernels XLA runs one by one: the entry and what it calls, but for single kernels."""
    entry = re.search(r"^ENTRY %?(\S+)", text, re.M)
    assert entry is not None
    names = [entry.group(1)]
    for name in names:  # grows meanwhile
        for _, operation, _, line in instructions(text, name):
            if operation in ("call", "conditional", "while") and "xla_cpu_small_call" not in line:
                called = re.findall(r"(?:to_apply|body|true_computation|false_computation)=%?([\w.\-]+)", line)
                for branches in re.findall(r"branch_computations=\{(.*?)\}", line):
                    called += re.findall(r"[\w.\-]+", branches)
                names += [c for c in called if c not in names]
    return names


def most_waiting(text: str, computation: str) -> int:
    """Returns how many kernels wait at most beside the one that runs, if each is run in the order in which it could be."""
    none = ("parameter", "bitcast", "tuple", "get-tuple-element", "constant", "opt-barrier")
    stands_for: dict[str, set[str]] = {}
    needs: dict[str, set[str]] = {}
    for name, operation, operands, _ in instructions(text, computation):
        inputs = set().union(*[stands_for[o] for o in operands if o in stands_for])
        if operation not in none:
            needs[name] = set(inputs)
        stands_for[name] = inputs if operation in none else {name}
    ready, most = [name for name in needs if not needs[name]], 0
    for ran, name in enumerate(ready):  # grows meanwhile
        most = max(most, len(ready) - ran - 1)
        for other in needs:
            if name in needs[other]:
                needs[other].remove(name)
                if not needs[other]:
                    ready.append(other)
    assert len(ready) == len(needs)
    return most
