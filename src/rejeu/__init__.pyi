"""The public names, for type checkers and editors; ``__init__.py`` imports each from here when it is first used."""

from rejeu.agents import (
    AGENTS as AGENTS,
    OffPolicyAgent as OffPolicyAgent,
    OnPolicyAgent as OnPolicyAgent,
    load as load,
    register as register,
)
from rejeu.agents.named import *  # noqa: F403
from rejeu.agents.together import train_seeds as train_seeds
from rejeu.core.algorithm import (
    Algorithm as Algorithm,
    Clock as Clock,
    Rollout as Rollout,
    Transition as Transition,
)
from rejeu.core.errors import (
    BadEnvironmentError as BadEnvironmentError,
    CheckpointError as CheckpointError,
    MissingExtra as MissingExtra,
    NonFiniteError as NonFiniteError,
    RunInUseError as RunInUseError,
    WorkerError as WorkerError,
)
from rejeu.core.schedules import Exponential as Exponential, Linear as Linear
from rejeu.envs.checker import check_env as check_env
from rejeu.envs.make import make_vec as make_vec, make_vector as make_vector
from rejeu.envs.wrappers import (
    FlatGoals as FlatGoals,
    OldEnvironment as OldEnvironment,
    TimeLimitTerminates as TimeLimitTerminates,
)
from rejeu.exploration.noise import (
    NormalActionNoise as NormalActionNoise,
    OrnsteinUhlenbeckActionNoise as OrnsteinUhlenbeckActionNoise,
)
from rejeu.exploration.parameter_space import ParameterNoise as ParameterNoise
from rejeu.lab.experiments.sweep import sweep as sweep
from rejeu.lab.experiments.tune import tune as tune
from rejeu.lab.policies import load_policy as load_policy
from rejeu.lab.reporting.comparison import compare as compare
from rejeu.lab.reporting.report import write_report as write_report
from rejeu.logs import plots as plots
from rejeu.logs.evaluation import Evaluation as Evaluation
from rejeu.logs.video import record_video as record_video, show_videos as show_videos
from rejeu.replay.hindsight import (
    GoalSelectionStrategy as GoalSelectionStrategy,
    HerReplayBuffer as HerReplayBuffer,
)
from rejeu.replay.replay_memory import ReplayMemory as ReplayMemory
from rejeu.replay.uniform import ReplayBuffer as ReplayBuffer
from rejeu.sb3.common.evaluation import evaluate_policy as evaluate_policy
from rejeu.sb3.common.monitor import Monitor as Monitor
from rejeu.sb3.common.vec_env.adapters import to_vec_env as to_vec_env

__version__: str
__all__: list[str]

def __dir__() -> list[str]: ...
