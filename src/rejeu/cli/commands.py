"""The commands and their arguments. What a command does is in the module of its name, which is imported when it runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg

Which = Literal["best", "last"]
EnvironmentId = Annotated[Positional[str], arg(metavar="ENV")]
RunPath = Annotated[Positional[Path], arg(metavar="RUN")]
Count = Annotated[int | None, arg(metavar="N", help_behavior_hint="")]
Minutes = Annotated[float | None, arg(metavar="M", help_behavior_hint="")]
Name = Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")]
Return = Annotated[float | None, arg(metavar="RETURN", help_behavior_hint="")]
Folder = Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")]
Assignments = tuple[tuple[str, ...], ...]


@dataclass(frozen=True, kw_only=True)
class EnvironmentOptions:
    """How an environment is made. Abstract: options of the commands that use one."""

    env_kwargs: Annotated[Assignments, UseAppendAction, arg(metavar="NAME=VALUE ...")] = ()
    """Keyword arguments of the environment: sigma=2 map_name=8x8."""
    wrapper: Annotated[tuple[str, ...], UseAppendAction, arg(metavar="MODULE:CLASS")] = ()
    """Wrap it in this gymnasium.Wrapper, such as gymnasium.wrappers:FlattenObservation; repeat for several, inner first."""
    imports: Annotated[tuple[str, ...], UseAppendAction, arg(name="import", metavar="MODULE")] = ()
    """Import this module or Python file first: one that registers algorithms or environments; repeat for several."""


@dataclass(frozen=True, kw_only=True)
class RunOptions(EnvironmentOptions):
    """The same where a run names the environment. Abstract."""

    env: Annotated[str | None, arg(metavar="ENV", help_behavior_hint="")] = None
    """Environment, as for rejeu train; by default the run's. One that is imported must be named again."""


@dataclass(frozen=True)
class Train(EnvironmentOptions):
    """Trains an agent and leaves a run folder: models, tables, learning curve, video.

    Ctrl-C stops cleanly; rejeu resume continues. Example: rejeu train Pendulum-v1 --steps 20000 --set learning_rate=1e-3
    """

    env: EnvironmentId
    """Id of an environment, such as parking-v0; or my_env:MyEnv-v0 or my_env.py, which is imported."""
    algo: Name = None
    """Algorithm; by default the preset's, else the one that fits the environment's actions."""
    steps: Count = None
    """Environment steps to take, over all environments; by default the preset's, else 100000."""
    minutes: Minutes = None
    """Train for this long instead."""
    envs: Count = None
    """Environments stepped at once; by default the preset's, else 1."""
    backend: Name = None
    """auto, envpool, gymnasium or gymnasium-async; by default the preset's, else auto."""
    restart_workers: Annotated[int, arg(metavar="N")] = 0
    """With --backend gymnasium-async: how many worker processes that crashed or hung are restarted."""
    seed: Count = None
    """Seeds everything; by default a random one."""
    assignments: Annotated[Assignments, UseAppendAction, arg(name="set", metavar="NAME=VALUE ...")] = ()
    """Hyperparameters, dotted where nested: policy_kwargs.net_arch=[64,64] train_freq=[1,"episode"]."""
    out: Folder = None
    """Run folder, new or empty; by default one under runs, named after the run and the time."""
    success_threshold: Return = None
    """Return from which on an episode counts as a success; by default what the environment reports or declares."""
    video_every: Count = None
    """Environment steps between two videos of the policy, in the folder videos; by default none are recorded."""
    checkpoint_minutes: Annotated[float, arg(metavar="M", help_behavior_hint="(default: 5)")] = 5.0
    """Minutes between two checkpoints, from which rejeu resume continues; 0 for none."""
    evaluate_every: Count = None
    """Environment steps between two evaluations; by default the preset's, else 5000."""
    evaluate_episodes: Count = None
    """Episodes of each evaluation; by default the preset's, else 20."""


@dataclass(frozen=True)
class Resume(RunOptions):
    """Resumes a run that was stopped, or that crashed, from its newest checkpoint.

    Without --steps or --minutes it trains to the goal that was set when it began. Example: rejeu resume runs/NAME
    """

    run: RunPath
    """Its folder."""
    steps: Count = None
    """Pause after so many environment steps; the goal stays. Of a complete run, or beyond the goal: train for so many more."""
    minutes: Minutes = None
    """Pause after so many minutes; the goal stays. Of a complete run: train for so many more."""


@dataclass(frozen=True)
class Evaluate(RunOptions):
    """Evaluates the deterministic policy of a trained agent on whole episodes and prints the results."""

    run: RunPath
    """Folder of a run, or a .safetensors file."""
    episodes: Count = None
    """How many; 100, or with --minutes as many as there is time for."""
    minutes: Minutes = None
    """Wall time after which no further episode begins; running episodes are finished."""
    backend: Annotated[str, arg(metavar="NAME")] = "auto"
    """auto, envpool, gymnasium or gymnasium-async; gymnasium is the environment's own package."""
    seed: Count = None
    """Of the environments; by default a random one."""
    success_threshold: Return = None
    """Return from which on an episode counts as a success; by default as in training."""
    which: Which = "best"
    """Of a folder: the model that evaluated best in training, or the last."""


@dataclass(frozen=True)
class Record(RunOptions):
    """Records a video of a few episodes of a trained agent in the environment's own package."""

    run: RunPath
    """Folder of a run, or a .safetensors file."""
    out: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Where to write; by default video.mp4 in the folder, or next to the file under its name."""
    episodes: Annotated[int, arg(metavar="N")] = 3
    """How many."""
    seed: Count = None
    """Of the environment; by default a random one."""
    which: Which = "best"
    """Of a folder: the model that evaluated best in training, or the last."""


@dataclass(frozen=True)
class Play(EnvironmentOptions):
    """Opens a window in which you play an environment with a, s, d, w or the arrows.

    Any keys may be held together. The window says what each does; r restarts, p pauses, q quits.
    """

    env: EnvironmentId
    """Id of an environment with Discrete or Box actions, as for rejeu train; or Car, Mountain or Lunar."""
    keys: Annotated[Assignments, UseAppendAction, arg(metavar="KEYS=ACTION ...")] = ()
    """Other keys: a=0 d=2 none=1 for Discrete actions, w=[1,0] a+w=[1,-1] for Box actions; none is nothing held."""
    seed: Count = None
    """Of the first episode; each further one has the next seed. By default a random one."""
    fps: Annotated[float | None, arg(metavar="N", help_behavior_hint="")] = None
    """Steps a second; by default the environment's own."""
    episodes: Count = None
    """Close after so many; by default when you do."""
    record: Folder = None
    """New or empty folder for a Minari dataset and a video of what you play."""
    against: Annotated[Path | None, arg(metavar="RUN", help_behavior_hint="")] = None
    """Folder of a run, or a .safetensors file, whose agent plays the same episodes next to you."""
    which: Which = "best"
    """Of a folder: the model that evaluated best in training, or the last."""


@dataclass(frozen=True)
class Watch(RunOptions):
    """Opens a window in which a trained agent plays, in the environment's own package.

    r restarts the episode, p pauses, q quits.
    """

    run: RunPath
    """Folder of a run, or a .safetensors file."""
    episodes: Count = None
    """Close after so many; by default when you do."""
    seed: Count = None
    """Of the first episode; each further one has the next seed. By default a random one."""
    which: Which = "best"
    """Of a folder: the model that evaluated best in training, or the last."""
    fps: Annotated[float | None, arg(metavar="N", help_behavior_hint="")] = None
    """Steps a second; by default the environment's own."""


@dataclass(frozen=True)
class Check(EnvironmentOptions):
    """Checks an environment for a few seconds and prints what is wrong with it; exit status 1 after errors.

    An environment of your own: rejeu check my_env.py, or my_package.my_module:MyEnv-v0, where the module registers it.
    """

    env: EnvironmentId
    """Id of an environment, such as parking-v0; or my_env:MyEnv-v0 or my_env.py, which is imported."""
    all: Annotated[bool, FlagCreatePairsOff] = False
    """Of an installed package's environment, show the warnings too, which only its authors can act on."""


@dataclass(frozen=True)
class List:
    """Lists the algorithms and the environments with tuned hyperparameters."""

    imports: Annotated[tuple[str, ...], UseAppendAction, arg(name="import", metavar="MODULE")] = ()
    """Import this module or Python file first: one that registers algorithms; repeat for several."""


COMMANDS: dict[str, Callable[..., Any]] = {
    "train": Train,
    "resume": Resume,
    "evaluate": Evaluate,
    "record": Record,
    "play": Play,
    "watch": Watch,
    "check": Check,
    "list": List,
}
"""The arguments of each command, by its name."""
