"""Trains SAC with hindsight experience replay to park a car, in 16 environments at once.

Observations of parking-v0 contain the goal: the pose in which the car must stop. Requires ``pip install
"rejeu[parking]"`` or EnvPool, which rejeu uses if it is installed.
"""

import rejeu

env = rejeu.make_vec("parking-v0", n_envs=16, seed=0)
agent = rejeu.SAC(
    "MultiInputPolicy",
    env,
    replay_buffer_class=rejeu.HerReplayBuffer,
    replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"},
    policy_kwargs={"net_arch": [64, 64, 64], "layer_norm": True},
    learning_rate=rejeu.Linear(1e-3),
    learning_starts=1_024,
    batch_size=128,
    gamma=0.95,
    seed=0,
)
agent.learn(56_000, progress_bar=True)
print(agent.evaluate(episodes=100, env="parking-v0"))
agent.save("parking")
