"""DQN from its parts: networks, TD target and loss of rejeu; loop, optimizer, exploration and target network of one's own.

python examples/dqn_from_parts.py
"""

import gymnasium as gym
import jax
import numpy as np
import optax

import rejeu
from rejeu.algorithms import dqn
from rejeu.core.spaces import leaves
from rejeu.networks import Network, PolicyConfig


def train_from_parts(episodes, seed=0, epsilon=(0.9, 0.01), copy_every=10):
    """Returns a network of action values, and the return of every episode."""
    env = gym.make("CartPole-v1")
    n_actions = int(env.action_space.n)
    network = Network(jax.random.PRNGKey(seed), leaves(env.observation_space), n_actions, (128, 128), PolicyConfig())
    target_network = network  # arrays never change in place, so a name is a copy
    optimizer = optax.chain(optax.clip(100.0), optax.adam(1e-3))
    optimizer_state = optimizer.init(network)

    @jax.jit
    def action_values(network, obs):
        return network(obs)

    @jax.jit
    def learn(network, target_network, optimizer_state, batch):
        target = dqn.td_target(network, target_network, batch, double_q=False)
        loss = jax.value_and_grad(dqn.td_loss, has_aux=True)
        (value, _), gradients = loss(network, batch, target, dqn.LOSSES["squared"])
        change, optimizer_state = optimizer.update(gradients, optimizer_state)
        return optax.apply_updates(network, change), optimizer_state, value

    memory = rejeu.ReplayMemory(10_000, env.observation_space, env.action_space, gamma=0.99, seed=seed)
    rng, step, returns = np.random.default_rng(seed), 0, []
    for episode in range(episodes):
        random_share = epsilon[0] * (epsilon[1] / epsilon[0]) ** (episode / episodes)
        obs, _ = env.reset(seed=seed if episode == 0 else None)
        total, done = 0.0, False
        while not done:
            if rng.random() < random_share:
                action = int(rng.integers(n_actions))
            else:
                action = int(action_values(network, obs[None])[0].argmax())
            next_obs, reward, terminated, truncated, _ = env.step(action)
            memory.push(obs, action, reward, next_obs, terminated)
            if len(memory) >= 64:
                network, optimizer_state, _ = learn(network, target_network, optimizer_state, memory.sample(64))
            if step % copy_every == 0:
                target_network = network
            obs, done = next_obs, terminated or truncated
            total, step = total + reward, step + 1
        returns.append(total)
    return network, returns


if __name__ == "__main__":
    network, returns = train_from_parts(episodes=20)
    print(f"mean return of the last 10 episodes: {np.mean(returns[-10:]):.1f}")
