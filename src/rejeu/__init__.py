"""rejeu: reinforcement learning with hindsight replay, compiled with JAX, for any Gymnasium environment.

>>> import rejeu
>>> agent = rejeu.SAC("MlpPolicy", "Pendulum-v1", learning_starts=50, seed=0).learn(100)
>>> agent.num_timesteps
100
"""

import importlib
import importlib.util
from typing import TYPE_CHECKING, Any

from rejeu import interrupt
from rejeu.algorithms.catalog import CATALOG

if interrupt.is_command():  # which imports them when it makes an environment, and ends with one line until then
    interrupt.install(lambda number, frame: interrupt.leave(number))
else:
    importlib.import_module("rejeu.envs")  # registers rejeu's environments

if TYPE_CHECKING:
    from rejeu.agents import (
        AGENTS as AGENTS,
        OffPolicyAgent as OffPolicyAgent,
        OnPolicyAgent as OnPolicyAgent,
        load as load,
        register as register,
    )
    from rejeu.agents.named import *  # noqa: F403
    from rejeu.agents.together import train_seeds as train_seeds
    from rejeu.buffers.hindsight import (
        GoalSelectionStrategy as GoalSelectionStrategy,
        HerReplayBuffer as HerReplayBuffer,
    )
    from rejeu.buffers.replay_memory import ReplayMemory as ReplayMemory
    from rejeu.buffers.uniform import ReplayBuffer as ReplayBuffer
    from rejeu.core import Algorithm as Algorithm, Clock as Clock, Rollout as Rollout, Transition as Transition
    from rejeu.envs.checker import check_env as check_env
    from rejeu.envs.make import make_vec as make_vec, make_vector as make_vector
    from rejeu.envs.wrappers import (
        FlatGoals as FlatGoals,
        OldEnvironment as OldEnvironment,
        TimeLimitTerminates as TimeLimitTerminates,
    )
    from rejeu.errors import (
        BadEnvironmentError as BadEnvironmentError,
        CheckpointError as CheckpointError,
        MissingExtra as MissingExtra,
        NonFiniteError as NonFiniteError,
        RunInUseError as RunInUseError,
        WorkerError as WorkerError,
    )
    from rejeu.experiments.sweep import sweep as sweep
    from rejeu.experiments.tune import tune as tune
    from rejeu.exploration.noise import (
        NormalActionNoise as NormalActionNoise,
        OrnsteinUhlenbeckActionNoise as OrnsteinUhlenbeckActionNoise,
    )
    from rejeu.exploration.parameter_space import ParameterNoise as ParameterNoise
    from rejeu.export.numpy_policy import load_policy as load_policy
    from rejeu.reporting import plots as plots
    from rejeu.reporting.comparison import compare as compare
    from rejeu.reporting.evaluation import Evaluation as Evaluation
    from rejeu.reporting.report import write_report as write_report
    from rejeu.reporting.video import record_video as record_video, show_videos as show_videos
    from rejeu.sb3.common.evaluation import evaluate_policy as evaluate_policy
    from rejeu.sb3.common.monitor import Monitor as Monitor
    from rejeu.sb3.common.vec_env.adapters import to_vec_env as to_vec_env
    from rejeu.schedules import Exponential as Exponential, Linear as Linear

__version__ = "0.1.0"

_MODULES = {
    "rejeu.agents": f"AGENTS OffPolicyAgent OnPolicyAgent load register {' '.join(CATALOG)}",
    "rejeu.agents.together": "train_seeds",
    "rejeu.buffers.hindsight": "GoalSelectionStrategy HerReplayBuffer",
    "rejeu.buffers.replay_memory": "ReplayMemory",
    "rejeu.buffers.uniform": "ReplayBuffer",
    "rejeu.core": "Algorithm Clock Rollout Transition",
    "rejeu.envs.checker": "check_env",
    "rejeu.envs.make": "make_vec make_vector",
    "rejeu.sb3.common.evaluation": "evaluate_policy",
    "rejeu.sb3.common.monitor": "Monitor",
    "rejeu.sb3.common.vec_env.adapters": "to_vec_env",
    "rejeu.envs.wrappers": "FlatGoals OldEnvironment TimeLimitTerminates",
    "rejeu.errors": "BadEnvironmentError CheckpointError MissingExtra NonFiniteError RunInUseError WorkerError",
    "rejeu.export.numpy_policy": "load_policy",
    "rejeu.exploration.noise": "NormalActionNoise OrnsteinUhlenbeckActionNoise",
    "rejeu.exploration.parameter_space": "ParameterNoise",
    "rejeu.reporting": "plots",
    "rejeu.reporting.comparison": "compare",
    "rejeu.reporting.evaluation": "Evaluation",
    "rejeu.reporting.report": "write_report",
    "rejeu.reporting.video": "record_video show_videos",
    "rejeu.schedules": "Exponential Linear",
    "rejeu.experiments.sweep": "sweep",
    "rejeu.experiments.tune": "tune",
}
"""The public names by the module that defines them."""

__all__ = sorted(" ".join(_MODULES.values()).split())

if not TYPE_CHECKING:  # type checkers find the names above, and report misspelt ones

    def __getattr__(name: str) -> Any:
        """Imports a public name or a submodule when it is first used (PEP 562)."""
        module = next((module for module, names in _MODULES.items() if name in names.split()), None)
        if module is not None:
            value = getattr(__import__(module, fromlist=[name]), name)  # a submodule too
        elif name.isidentifier() and not name.startswith("_") and importlib.util.find_spec(f"rejeu.{name}") is not None:
            value = importlib.import_module(f"rejeu.{name}")
        else:
            raise AttributeError(f"module 'rejeu' has no attribute {name!r}")
        globals()[name] = value
        return value

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})
