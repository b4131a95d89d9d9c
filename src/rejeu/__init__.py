"""rejeu: reinforcement learning with hindsight replay, compiled with JAX, for any Gymnasium environment.

>>> import rejeu
>>> agent = rejeu.SAC("MlpPolicy", "Pendulum-v1", learning_starts=50, seed=0).learn(100)
>>> agent.num_timesteps
100
"""

from rejeu.agents import interrupt

interrupt.guard_imports()

from rejeu.agents import A2C, AGENTS, DDPG, DQN, PPO, QRDQN, SAC, TD3, TQC, CrossQ, MaskablePPO, RecurrentPPO, load
from rejeu.buffers.hindsight import GoalSelectionStrategy, HerReplayBuffer
from rejeu.buffers.replay_memory import ReplayMemory
from rejeu.buffers.uniform import ReplayBuffer
from rejeu.envs.checker import check_env
from rejeu.envs.make import make_vector
from rejeu.envs.monitor import Monitor
from rejeu.envs.time_limit import TimeLimitTerminates
from rejeu.errors import BadEnvironmentError, CheckpointError, MissingExtra, WorkerError
from rejeu.exploration.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from rejeu.exploration.parameter_space import ParameterNoise
from rejeu.reporting import plots
from rejeu.reporting.evaluation import Evaluation, evaluate_policy
from rejeu.reporting.video import record_video, show_videos
from rejeu.schedules import Exponential, Linear

__version__ = "0.1.0"

__all__ = [
    "A2C",
    "AGENTS",
    "DDPG",
    "DQN",
    "PPO",
    "QRDQN",
    "SAC",
    "TD3",
    "TQC",
    "BadEnvironmentError",
    "CheckpointError",
    "CrossQ",
    "Evaluation",
    "Exponential",
    "GoalSelectionStrategy",
    "HerReplayBuffer",
    "Linear",
    "MaskablePPO",
    "MissingExtra",
    "Monitor",
    "NormalActionNoise",
    "OrnsteinUhlenbeckActionNoise",
    "ParameterNoise",
    "RecurrentPPO",
    "ReplayBuffer",
    "ReplayMemory",
    "TimeLimitTerminates",
    "WorkerError",
    "check_env",
    "evaluate_policy",
    "load",
    "make_vector",
    "plots",
    "record_video",
    "show_videos",
]
