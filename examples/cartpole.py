"""Trains PPO on CartPole, evaluates the agent, and saves and loads the model."""

import rejeu

agent = rejeu.PPO("MlpPolicy", "CartPole-v1", n_steps=512, learning_rate=1e-3, seed=0)
agent.learn(50_000, progress_bar=True)
print(agent.evaluate(episodes=100))
agent.save("cartpole")
agent = rejeu.load("cartpole")
