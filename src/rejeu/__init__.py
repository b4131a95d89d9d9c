"""rejeu: reinforcement learning with hindsight replay, compiled with JAX, for any Gymnasium environment.

>>> import rejeu
>>> agent = rejeu.SAC("MlpPolicy", "Pendulum-v1", learning_starts=50, seed=0).learn(100)
>>> agent.num_timesteps
100
"""

from rejeu.core import interrupt

if interrupt.is_command():  # which ends with one line until it listens, so that this is before all other imports
    interrupt.install(lambda number, frame: interrupt.leave(number))

import importlib
import importlib.util
from typing import TYPE_CHECKING, Any

from rejeu.algorithms.catalog import CATALOG

if not interrupt.is_command():  # which imports them when it makes an environment
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

__version__ = "0.1.0"

_MODULES = {
    "rejeu.agents": f"AGENTS OffPolicyAgent OnPolicyAgent load register {' '.join(CATALOG)}",
    "rejeu.agents.together": "train_seeds",
    "rejeu.replay.hindsight": "GoalSelectionStrategy HerReplayBuffer",
    "rejeu.replay.replay_memory": "ReplayMemory",
    "rejeu.replay.uniform": "ReplayBuffer",
    "rejeu.core.algorithm": "Algorithm Clock Rollout Transition",
    "rejeu.envs.checker": "check_env",
    "rejeu.envs.make": "make_vec make_vector",
    "rejeu.sb3.common.evaluation": "evaluate_policy",
    "rejeu.sb3.common.monitor": "Monitor",
    "rejeu.sb3.common.vec_env.adapters": "to_vec_env",
    "rejeu.envs.wrappers": "FlatGoals OldEnvironment TimeLimitTerminates",
    "rejeu.core.errors": "BadEnvironmentError CheckpointError MissingExtra NonFiniteError RunInUseError WorkerError",
    "rejeu.exploration.noise": "NormalActionNoise OrnsteinUhlenbeckActionNoise",
    "rejeu.exploration.parameter_space": "ParameterNoise",
    "rejeu.logs": "plots",
    "rejeu.lab.policies": "load_policy",
    "rejeu.lab.reporting.comparison": "compare",
    "rejeu.logs.evaluation": "Evaluation",
    "rejeu.lab.reporting.report": "write_report",
    "rejeu.logs.video": "record_video show_videos",
    "rejeu.core.schedules": "Exponential Linear",
    "rejeu.lab.experiments.sweep": "sweep",
    "rejeu.lab.experiments.tune": "tune",
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
            hint = importlib.import_module("rejeu.core.validation").nearest(name, __all__, "dir(rejeu) lists them")
            raise AttributeError(f"module 'rejeu' has no attribute {name!r}; {hint}")
        globals()[name] = value
        return value

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})
