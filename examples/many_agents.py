"""Trains 2,048 agents at once, each with a seed of its own, in one program, and prints the distribution of their returns.

    python examples/many_agents.py
    python examples/many_agents.py --agents 256 --steps 60000

Algorithm and environment are pure functions, so ``jax.vmap`` turns the training of one agent into that of many. For a few
agents with histories, checkpoints and run folders use ``rejeu.train_seeds`` or ``rejeu train jax/CartPole-v1 --seeds 8``.
"""

import argparse
import time

import jax
import jax.numpy as jnp
import numpy as np
import optax

from rejeu.algorithms import pqn
from rejeu.core.algorithm import Clock, Rollout
from rejeu.envs.functional import make
from rejeu.envs.functional.vector import reset_all, reset_done, step_all

N_ENVS, N_STEPS, N_PARTS = 4, 32, 10
config = pqn.Config(
    n_steps=N_STEPS,
    batch_size=32,
    n_epochs=4,
    q_lambda=0.9,
    learning_rate="lin_3e-3",
    optimizer=optax.radam,  # the step of "radam" is compiled for one agent: to one kernel, in one thread
    exploration_fraction=0.5,
    exploration_final_eps=0.05,
    policy_kwargs=dict(net_arch=[32, 32]),
)
env = make("jax/CartPole-v1")
algorithm = pqn.make(config, env.observation_space, env.action_space)


def begin(seed):
    """Returns an agent before training, and its environments."""
    agent_key, env_key = jax.random.split(jax.random.PRNGKey(seed))
    return algorithm.init(agent_key), reset_all(env, jax.random.wrap_key_data(env_key), N_ENVS)


def learn(agent, envs, key, progress):
    """Returns agent and environments after one rollout for each number of ``progress``, the fractions of training done.

    The third value is the share of steps that ended an episode.
    """

    def step(carry, key):
        agent, envs, clock = carry
        obs = envs.obs
        action = algorithm.explore(algorithm.actor(agent), obs, key, clock)
        envs, next_obs, reward, terminated, truncated, _ = step_all(env, envs, action)
        envs, _ = reset_done(env, envs, terminated | truncated)
        discount = jnp.where(terminated, 0.0, config.gamma)
        return (agent, envs, clock), (obs, action, reward, next_obs, discount, terminated | truncated)

    def update(carry, progress):
        agent, envs = carry
        clock = Clock(jnp.uint32(0), jnp.uint32(0), progress)
        keys = jax.random.split(jax.random.fold_in(key, agent.n_rollouts), N_STEPS)
        (_, envs, _), steps = jax.lax.scan(step, (agent, envs, clock), keys)
        valid, unused = jnp.ones((N_STEPS, N_ENVS), bool), ()
        rollout = Rollout(*steps, valid, unused, unused, unused)
        agent, _ = algorithm.update(agent, rollout, clock)
        return (agent, envs), jnp.mean(rollout.ended, dtype=jnp.float32)

    (agent, envs), ended = jax.lax.scan(update, (agent, envs), progress)
    return agent, envs, jnp.mean(ended)


def evaluate(agent, seed):
    """Returns the mean return of the greedy policy, each environment playing one episode."""

    def step(carry, _):
        envs, over, value = carry
        action = algorithm.exploit(algorithm.actor(agent), envs.obs)
        envs, _, reward, terminated, truncated, _ = step_all(env, envs, action)
        return (envs, over | terminated | truncated, value + jnp.where(over, 0.0, reward)), None

    envs = reset_all(env, jax.random.key(seed), N_ENVS)
    begin = (envs, jnp.zeros(N_ENVS, bool), jnp.zeros(N_ENVS))
    (_, _, value), _ = jax.lax.scan(step, begin, length=env.max_episode_steps)
    return jnp.mean(value)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--agents", type=int, default=2048)
    parser.add_argument("--steps", type=int, default=30_000, help="environment steps of each agent")
    arguments = parser.parse_args()
    n_rollouts = max(arguments.steps // (N_ENVS * N_STEPS * N_PARTS), 1) * N_PARTS
    seeds = jnp.arange(arguments.agents)
    keys = jax.vmap(jax.random.PRNGKey)(seeds + 1_000_000)
    agents, envs = jax.jit(jax.vmap(begin))(seeds)
    learn_all = jax.jit(jax.vmap(learn, in_axes=(0, 0, 0, None)), donate_argnums=(0, 1))
    evaluate_all = jax.jit(jax.vmap(evaluate))

    began = time.perf_counter()
    for progress in np.linspace(0, 1, n_rollouts, dtype=np.float32).reshape(N_PARTS, -1):
        agents, envs, ended = learn_all(agents, envs, keys, progress)
        length = 1 / np.mean(ended)
        print(f"{time.perf_counter() - began:6.1f} s   mean length of an episode {length:6.1f}", flush=True)
    returns = np.asarray(evaluate_all(agents, seeds + 2_000_000))
    print(f"mean return of {arguments.agents:,} greedy policies: {returns.mean():.1f}")
    low, *quartiles, high = np.quantile(returns, [0.0, 0.25, 0.5, 0.75, 1.0])
    print(f"lowest {low:.1f}, quartiles {', '.join(f'{q:.1f}' for q in quartiles)}, highest {high:.1f}")
    counts, edges = np.histogram(returns, bins=10, range=(0, env.max_episode_steps))
    for count, left, right in zip(counts, edges[:-1], edges[1:], strict=True):
        print(f"{left:4.0f} to {right:3.0f}  {count:5d}  {'#' * round(50 * count / arguments.agents)}")


if __name__ == "__main__":
    main()
