"""Counts the floating-point operations of updates with XLA's cost analysis.

The cost analysis counts the body of a loop once, regardless of the number of iterations, and the more expensive branch
of a conditional. The count here corrects this. It adds the cost of each loop's body for every further iteration. It
subtracts the difference between the branches of a conditional for the fraction of calls that do not take the more
expensive one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun


def flops(function: Callable[..., Any], *args: Any, while_runs: int = 1, expensive_share: float = 1.0) -> float:
    """Returns the floating-point operations of one call of ``function``, including elementwise operations.

    Args:
        function: a function that JAX can trace.
        args: arrays, or shapes of arrays.
        while_runs: number of iterations of a ``while_loop``, which the program does not contain.
        expensive_share: fraction of the calls in which a conditional takes its more expensive branch.

    >>> import jax, jax.numpy as jnp
    >>> flops(jnp.matmul, jnp.ones((4, 5), jnp.float32), jnp.ones((5, 6), jnp.float32))
    240.0
    """
    return _flops(jax.make_jaxpr(function)(*args), while_runs, expensive_share)


def _flops(program: ClosedJaxpr, while_runs: int, expensive_share: float) -> float:
    total = _by_xla(program)
    for equation in _equations(program.jaxpr):
        name, params = equation.primitive.name, equation.params
        if name == "scan":
            total += (params["length"] - 1) * _flops(params["jaxpr"], while_runs, expensive_share)
            total += _inner(params["jaxpr"], while_runs, expensive_share)
        elif name == "while":
            total += (while_runs - 1) * _flops(params["body_jaxpr"], while_runs, expensive_share)
            total += _inner(params["body_jaxpr"], while_runs, expensive_share)
        elif name == "cond":
            branches = sorted(_flops(branch, while_runs, expensive_share) for branch in params["branches"])
            total -= (1.0 - expensive_share) * (branches[-1] - branches[0])
    return total


def _inner(program: ClosedJaxpr, while_runs: int, expensive_share: float) -> float:
    """Returns the operations inside loops that the cost analysis of the whole program does not count."""
    return _flops(program, while_runs, expensive_share) - _by_xla(program)


def _equations(jaxpr: Any) -> Iterator[Any]:
    """Yields the equations of a program and of the functions that it calls, without the bodies of loops."""
    for equation in jaxpr.eqns:
        yield equation
        if equation.primitive.name in ("scan", "while", "cond"):
            continue
        for value in equation.params.values():
            if isinstance(value, ClosedJaxpr):
                yield from _equations(value.jaxpr)


def _by_xla(program: ClosedJaxpr) -> float:
    inputs = [jax.ShapeDtypeStruct(value.aval.shape, value.aval.dtype) for value in program.jaxpr.invars]
    cost = jax.jit(jaxpr_as_fun(program)).lower(*inputs).compile().cost_analysis()
    return float((cost or {}).get("flops", 0.0))


def sac_by_hand(obs_dim: int, action_dim: int, hidden: tuple[int, int], batch: int) -> int:
    """Returns the operations of the matrix products in one update of SAC with two critics, as a check of the count.

    The product of a batch with a layer of n by m weights takes 2 n m operations per transition. The backward pass takes
    the same again for the gradient of the weights, and again for the gradient of the inputs if an earlier layer needs
    it.
    """
    first, last = hidden
    actor = obs_dim * first + first * last + last * 2 * action_dim
    critic = (obs_dim + action_dim) * first + first * last + last
    target = actor + 2 * critic
    critics = 2 * (3 * critic - (obs_dim + action_dim) * first)
    policy = 3 * actor - obs_dim * first + 2 * 2 * critic
    return 2 * batch * (target + critics + policy)


def off_policy(agent: Any, n_envs: int) -> dict[str, float]:
    """Returns the operations of one gradient step, and of acting for one environment step, of an off-policy agent."""
    import numpy as np

    from rejeu.core.algorithm import Clock

    config, algorithm, shapes = agent.config, agent.learner.algorithm, agent.learner.shapes
    batch = agent.replay_buffer.sample(np.random.default_rng(0), (config.batch_size,))
    clock = Clock(np.uint32(0), np.uint32(0), np.float32(0.0))
    update = flops(algorithm.update, shapes, batch, clock, expensive_share=1.0 / getattr(config, "policy_delay", 1))
    return {"update_flops": update, "act_flops": _act(agent, jax.tree.map(lambda x: x[:n_envs], batch.obs), clock)}


def on_policy(agent: Any, n_envs: int) -> dict[str, float]:
    """Returns the operations of one update with all its epochs, and of acting, per environment step."""
    import numpy as np

    from rejeu.core.algorithm import Clock

    config, algorithm, shapes = agent.config, agent.learner.algorithm, agent.learner.shapes
    rollout = agent.run.replay.rollout()
    clock = Clock(np.uint32(0), np.uint32(0), np.float32(0.0))
    steps = config.n_steps * n_envs
    runs = config.n_epochs * -(-steps // config.batch_size) if hasattr(config, "n_epochs") else 1
    update = flops(algorithm.update, shapes, rollout, clock, while_runs=runs)
    obs = jax.tree.map(lambda x: x[0], rollout.obs)
    return {"update_flops": update / steps, "act_flops": _act(agent, obs, clock)}


def _act(agent: Any, obs: Any, clock: Any) -> float:
    algorithm = agent.learner.algorithm
    n_envs = len(jax.tree.leaves(obs)[0])

    def act(state: Any, obs: Any, key: Any) -> Any:
        return algorithm.explore(algorithm.actor(state), obs, key, clock)

    return flops(act, agent.learner.shapes, obs, jax.random.PRNGKey(0)) / n_envs
