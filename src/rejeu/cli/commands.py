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
Json = Annotated[bool, FlagCreatePairsOff]
Device = Annotated[str, arg(metavar="NAME")]


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
    preset: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Use the preset in this file, such as the preset.json of rejeu tune, in the place of rejeu's own."""
    steps: Count = None
    """Environment steps to take, over all environments; by default the preset's, else 100000."""
    minutes: Minutes = None
    """Train for this long instead."""
    pause: Count = None
    """Pause after so many environment steps; rejeu resume continues to the goal."""
    envs: Count = None
    """Environments stepped at once; by default the preset's, else 1."""
    backend: Name = None
    """auto, envpool, gymnasium, gymnasium-async, jax or ray; by default the preset's, else auto."""
    restart_workers: Annotated[int, arg(metavar="N")] = 0
    """With --backend gymnasium-async or ray: how many workers that crashed, hung or were lost are restarted."""
    wait_for: Annotated[int | None, arg(metavar="K", help_behavior_hint="")] = None
    """With these: take the first K results that arrive, and do not wait for the other environments."""
    arrivals: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """With --wait-for: take the results in the order of an earlier run, its arrivals.npy."""
    ray: Annotated[str | None, arg(metavar="ADDRESS", help_behavior_hint="")] = None
    """With --backend ray: HOST:PORT of the cluster, or auto; by default RAY_ADDRESS, else Ray on this machine."""
    env_cpus: Annotated[float | None, arg(metavar="N", help_behavior_hint="")] = None
    """With --backend ray: CPUs for each environment, a fraction if it mostly waits; by default 1, or 0 without --ray."""
    device: Device = "auto"
    """auto, cpu or gpu; auto is the device that JAX chooses, a GPU if it has one."""
    seed: Count = None
    """Seeds everything; by default a random one."""
    seeds: Count = None
    """Train this many seeds, from --seed on, each in a folder of its own, and compare them at the end. In JAX environments one
    program trains all of them; elsewhere, and with --jobs, each has a process of its own."""
    jobs: Count = None
    """With --seeds: how many are trained at once; by default half as many as there are cores."""
    assignments: Annotated[Assignments, UseAppendAction, arg(name="set", metavar="NAME=VALUE ...")] = ()
    """Hyperparameters, dotted where nested: "policy_kwargs.net_arch=[64,64]" "train_freq=[1,'episode']"."""
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
    no_report: Annotated[bool, FlagCreatePairsOff] = False
    """Write no report.html at the end."""
    no_video: Annotated[bool, FlagCreatePairsOff] = False
    """Record no video at the end."""
    log: Annotated[Assignments, UseAppendAction, arg(metavar="NAME ...")] = ()
    """Log to these too: json, tensorboard, wandb, mlflow, trackio. metrics.csv is always written."""
    json: Json = False
    """Print the result as one JSON document, and messages to standard error."""


@dataclass(frozen=True)
class Sweep:
    """Trains many runs: the environments, algorithms, settings and seeds of a plan, on one machine, several, or a Ray cluster.

    Ctrl-C stops all runs cleanly; rejeu resume continues. Example: rejeu sweep plan.toml --workers 4
    """

    plan: Annotated[Positional[Path], arg(metavar="FILE")]
    """TOML file with the plan."""
    out: Folder = None
    """Folder of the sweep; one of the same plan is joined. By default a new one under runs."""
    workers: Count = None
    """Runs trained at once; by default half as many as there are cores, with --ray as many as the cluster has room for."""
    ray: Annotated[str | None, arg(metavar="ADDRESS", help_behavior_hint="")] = None
    """Train on this Ray cluster: auto, or HOST:PORT."""
    imports: Annotated[tuple[str, ...], UseAppendAction, arg(name="import", metavar="MODULE")] = ()
    """Import this module or Python file first, in each run: one that registers algorithms or environments."""
    json: Json = False
    """Print the result as one JSON document, and messages to standard error."""


@dataclass(frozen=True)
class Resume(RunOptions):
    """Resumes a run that was stopped, or that crashed, from its newest checkpoint; or a sweep, a study or a population.

    Without --steps or --minutes it trains to the goal that was set when it began. Example: rejeu resume runs/NAME
    """

    run: RunPath
    """Its folder."""
    finish: Annotated[bool, FlagCreatePairsOff] = False
    """Of a complete run whose process ended before all files were written: write them, rather than report an error."""
    workers: Count = None
    """Of a sweep, a study or a population: runs at once; by default half as many as there are cores."""
    ray: Annotated[str | None, arg(metavar="ADDRESS", help_behavior_hint="")] = None
    """Of a sweep, or of a run with --backend ray: use this Ray cluster, auto or HOST:PORT."""
    steps: Count = None
    """Pause after so many environment steps; the goal stays. Of a complete run, or beyond the goal: train for so many more."""
    minutes: Minutes = None
    """Pause after so many minutes; the goal stays. Of a complete run: train for so many more."""
    assignments: Annotated[Assignments, UseAppendAction, arg(name="set", metavar="NAME=VALUE ...")] = ()
    """Hyperparameters to change from here on, as for rejeu train; those that change shapes cannot be changed."""
    device: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """As for rejeu train; by default cpu if the run was trained there on request, else auto."""
    restart_workers: Annotated[int, arg(metavar="N")] = 0
    """As for rejeu train; for this part of the run."""
    env_cpus: Annotated[float | None, arg(metavar="N", help_behavior_hint="")] = None
    """With --backend ray: CPUs for each environment, a fraction if it mostly waits; by default 1, or 0 without --ray."""
    no_report: Annotated[bool, FlagCreatePairsOff] = False
    """Write no report.html at the end."""
    no_video: Annotated[bool, FlagCreatePairsOff] = False
    """Record no video at the end."""
    json: Json = False
    """Print the result as one JSON document, and messages to standard error."""


@dataclass(frozen=True)
class Tune(EnvironmentOptions):
    """Searches hyperparameters with Optuna, and compares the best ones with the default on fresh seeds.

    Ctrl-C stops cleanly; rejeu resume continues. Example: rejeu tune Pendulum-v1 --algo SAC --trials 30
    """

    env: EnvironmentId
    """Id of an environment, as for rejeu train."""
    algo: Name = None
    """Algorithm; by default that of the preset."""
    trials: Annotated[int, arg(metavar="N")] = 30
    """How many trials; of a study that exists, how many in all."""
    steps: Count = None
    """Environment steps of a trial; by default the preset's, else 100000."""
    envs: Count = None
    """Environments stepped at once; by default the preset's, else 1."""
    backend: Name = None
    """auto, envpool, gymnasium, gymnasium-async or jax; by default the preset's, else auto."""
    preset: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """What trials start from and the winner is compared with; by default rejeu's preset, else the algorithm's defaults."""
    assignments: Annotated[Assignments, UseAppendAction, arg(name="set", metavar="NAME=VALUE ...")] = ()
    """Hyperparameters to set instead of searching them, as for rejeu train."""
    search: Annotated[Assignments, UseAppendAction, arg(metavar="NAME=LOW..HIGH ...")] = ()
    """Other ranges, or further hyperparameters: learning_rate=1e-4..1e-2 "batch_size=[64,128]" tau=log:0.001..0.1"""
    only: Annotated[Assignments, UseAppendAction, arg(metavar="NAME ...")] = ()
    """Search these hyperparameters and no others."""
    trial_seeds: Annotated[int, arg(metavar="K")] = 1
    """Seeds of each trial, trained at once, whose evaluations are averaged."""
    final_seeds: Annotated[int, arg(metavar="K")] = 5
    """Fresh seeds on which the winner is compared with the default, at least 3; 0 for no comparison."""
    pruner: Literal["median", "halving", "none"] = "median"
    """Stop trials that are below the median of the others, or by successive halving, or none."""
    measure: Literal["return", "success"] = "return"
    """Maximize the mean return of the last evaluation, or its success rate."""
    evaluate_every: Count = None
    """Environment steps between two evaluations; by default a tenth of --steps."""
    evaluate_episodes: Count = None
    """Episodes of each evaluation; by default the preset's, else 20."""
    checkpoint_minutes: Annotated[float, arg(metavar="M", help_behavior_hint="(default: 5)")] = 5.0
    """Minutes between two checkpoints of a training; 0 for none."""
    seed: Annotated[int, arg(metavar="N")] = 0
    """Determines what is sampled and the seeds of all trainings."""
    workers: Count = None
    """Trials at once; by default half as many as there are cores."""
    out: Folder = None
    """Study folder; an existing one is continued or joined. By default a new one under runs."""
    json: Json = False
    """Print the result as one JSON document, and messages to standard error."""


@dataclass(frozen=True)
class Pbt(EnvironmentOptions):
    """Trains a population: after each round the worst members copy the best, and their hyperparameters are perturbed.

    Ctrl-C stops cleanly; rejeu resume continues. Example: rejeu pbt Pendulum-v1 --algo SAC --members 8 --round-steps 5000
    """

    env: EnvironmentId
    """Id of an environment, as for rejeu train."""
    algo: Name = None
    """Algorithm; by default that of the preset."""
    members: Annotated[int, arg(metavar="K")] = 8
    """Agents that are trained."""
    rounds: Annotated[int, arg(metavar="N")] = 10
    """Rounds of training."""
    round_steps: Annotated[int, arg(metavar="N")] = 10_000
    """Environment steps of each member in a round."""
    envs: Count = None
    """Environments that each member steps at once; by default the preset's, else 1."""
    backend: Name = None
    """auto, envpool, gymnasium, gymnasium-async or jax; by default the preset's, else auto."""
    preset: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Hyperparameters that do not change; by default those of rejeu's preset, else the algorithm's defaults."""
    assignments: Annotated[Assignments, UseAppendAction, arg(name="set", metavar="NAME=VALUE ...")] = ()
    """Hyperparameters to set instead of changing them, as for rejeu train."""
    search: Annotated[Assignments, UseAppendAction, arg(metavar="NAME=LOW..HIGH ...")] = ()
    """Other ranges, or further hyperparameters, as for rejeu tune."""
    only: Annotated[Assignments, UseAppendAction, arg(metavar="NAME ...")] = ()
    """Change these hyperparameters and no others."""
    measure: Literal["return", "success"] = "return"
    """Compare members by the mean return of the evaluation at the end of a round, or by its success rate."""
    evaluate_episodes: Count = None
    """Episodes of each evaluation; by default the preset's, else 20."""
    checkpoint_minutes: Annotated[float, arg(metavar="M", help_behavior_hint="(default: 5)")] = 5.0
    """Minutes between two checkpoints within a round."""
    seed: Annotated[int, arg(metavar="N")] = 0
    """Determines all hyperparameters and the seeds of all members."""
    workers: Count = None
    """Members trained at once; by default half as many as there are cores."""
    out: Folder = None
    """Folder of the population, new or empty; by default a new one under runs."""
    json: Json = False
    """Print the result as one JSON document, and messages to standard error."""


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
    """auto, envpool, gymnasium, gymnasium-async or jax; gymnasium is the environment's own package."""
    device: Device = "auto"
    """As for rejeu train."""
    seed: Count = None
    """Of the environments; by default a random one."""
    success_threshold: Return = None
    """Return from which on an episode counts as a success; by default as in training."""
    which: Which = "best"
    """Of a folder: the model that evaluated best in training, or the last."""
    json: Json = False
    """Print the result as one JSON document, and messages to standard error."""


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
    json: Json = False
    """Print the result as one JSON document, and messages to standard error."""


@dataclass(frozen=True)
class Play(EnvironmentOptions):
    """Opens a window in which you play an environment with a, s, d, w or the arrows.

    Any keys may be held together. The window says what each does; r restarts, p pauses, q quits.
    """

    env: EnvironmentId
    """Id of an environment with Discrete or Box actions, as for rejeu train; or Car, Mountain or Lunar."""
    keys: Annotated[Assignments, UseAppendAction, arg(metavar="KEYS=ACTION ...")] = ()
    """Other keys: a=0 d=2 none=1 for Discrete actions, "w=[1,0]" "a+w=[1,-1]" for Box actions; none is nothing held."""
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
    json: Json = False
    """Print the result as one JSON document, and messages to standard error."""


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
    json: Json = False
    """Print the result as one JSON document, and messages to standard error."""


@dataclass(frozen=True)
class Check(EnvironmentOptions):
    """Checks an environment for a few seconds and prints what is wrong with it; exit status 1 after errors.

    An environment of your own: rejeu check my_env.py, or my_package.my_module:MyEnv-v0, where the module registers it.
    """

    env: EnvironmentId
    """Id of an environment, such as parking-v0; or my_env:MyEnv-v0 or my_env.py, which is imported."""
    all: Annotated[bool, FlagCreatePairsOff] = False
    """Of an installed package's environment, show the warnings too, which only its authors can act on."""
    json: Json = False
    """Print the result as one JSON document, and messages to standard error."""


@dataclass(frozen=True)
class List:
    """Lists the algorithms and the environments with tuned hyperparameters."""

    imports: Annotated[tuple[str, ...], UseAppendAction, arg(name="import", metavar="MODULE")] = ()
    """Import this module or Python file first: one that registers algorithms; repeat for several."""
    json: Json = False
    """Print the result as one JSON document, and messages to standard error."""


@dataclass(frozen=True)
class Course:
    """Writes the notebooks of the courses, exercises and solutions, to a folder. Existing files are never changed."""

    language: Annotated[Positional[Literal["en", "fr"]], arg(metavar="LANGUAGE")]
    """en or fr."""
    folder: Annotated[Positional[Path], arg(metavar="FOLDER")]
    """Where to write; it is created."""
    json: Json = False
    """Print the result as one JSON document, and messages to standard error."""


@dataclass(frozen=True)
class Report(RunOptions):
    """Writes a page about one or several runs: curves, evaluations, videos, episodes, configuration.

    The page is one file that needs no network. Example: rejeu report runs/NAME --open
    """

    runs: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN ...")]
    """Run folders, also of runs in progress."""
    out: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """File to write; by default report.html in the folder of a single run, else in the current folder."""
    open: Annotated[bool, FlagCreatePairsOff] = False
    """Open the page in the web browser."""
    live: Annotated[bool, FlagCreatePairsOff] = False
    """Serve the page to this computer and update it while the runs train, until Ctrl-C."""
    replay: Count = None
    """First let the trained agent play this many episodes, from the seeds 0, 1, 2 ...; the page lists them by return."""


@dataclass(frozen=True)
class Class(EnvironmentOptions):
    """Evaluates the models in a folder, such as those of a class, and writes a leaderboard with confidence intervals.

    Every model plays the same episodes. A file that is damaged or of another environment gets one line.
    """

    folder: Annotated[Positional[Path], arg(metavar="FOLDER")]
    """Folder with .safetensors files, also in folders in it. Their names are the names on the leaderboard."""
    env: Annotated[str | None, arg(metavar="ENV", help_behavior_hint="")] = None
    """Environment, as for rejeu train; by default the one that most models were trained on."""
    episodes: Annotated[int, arg(metavar="N")] = 50
    """Episodes of each model, up to 1000."""
    minutes: Annotated[float, arg(metavar="M")] = 1.0
    """Wall time of each model; one that needs more is not ranked."""
    seed: Annotated[int, arg(metavar="N")] = 0
    """Of the episodes, the same for all models."""
    out: Annotated[Path, arg(metavar="FILE")] = Path("leaderboard.html")
    """Page to write; a name that ends in .md or .json is written as Markdown or JSON."""
    json: Json = False
    """Print the result as one JSON document, and messages to standard error."""


@dataclass(frozen=True)
class Compare:
    """Compares groups of runs, such as several seeds of two algorithms: curves, final scores, 95 % intervals.

    Also reads monitor.csv of Stable-Baselines3 and TensorBoard files. Example: rejeu compare runs --by setting --out page.html
    """

    runs: Annotated[Positional[tuple[Path, ...]], arg(metavar="RUN ...", help_behavior_hint="")]
    """Run folders, or folders of run folders."""
    by: Annotated[
        Literal["algorithm", "setting", "env"] | None, arg(metavar="{algorithm,setting,env}", help_behavior_hint="")
    ] = None
    """What makes a group; by default the first of these in which the runs differ."""
    x: Literal["steps", "time"] = "steps"
    """Compare over environment steps or over training time."""
    score: Literal["training", "evaluation"] = "training"
    """Final score: mean return of the last tenth of training, or of the last evaluation."""
    statistic: Literal["iqm", "mean", "median"] = "iqm"
    """Statistic of the curves over the runs."""
    normalize: Annotated[Literal["range"] | None, arg(metavar="range", help_behavior_hint="")] = None
    """Scale the returns of each environment to its range of final scores, so that environments can be averaged."""
    reference: Annotated[Assignments, UseAppendAction, arg(metavar="ENV=LOW,HIGH ...")] = ()
    """Scale with these reference returns instead, which become 0 and 1; needed for every environment."""
    threshold: Return = None
    """Return that counts as learned; by default the mean final score of the weakest group."""
    out: Annotated[Path | None, arg(metavar="PATH", help_behavior_hint="")] = None
    """File to write (.md, .csv, .json, .png or .html), or a folder for all of them."""
    open: Annotated[bool, FlagCreatePairsOff] = False
    """Open the page in the web browser; it is written to compare.html unless --out says otherwise."""
    json: Annotated[bool, FlagCreatePairsOff] = False
    """Print the result as JSON."""


@dataclass(frozen=True)
class Runs:
    """Lists the runs in a folder and its subfolders with state, steps and best results."""

    folder: Annotated[Positional[Path], arg(metavar="FOLDER", help_behavior_hint="(default: runs)")] = Path("runs")
    """Folder that is searched."""
    json: Annotated[bool, FlagCreatePairsOff] = False
    """Print the result as JSON."""


@dataclass(frozen=True)
class Status:
    """Shows how far a run is, also while it trains; exit status 3 if it was interrupted, 4 if it crashed."""

    run: RunPath
    """Its folder."""
    json: Annotated[bool, FlagCreatePairsOff] = False
    """Print the result as JSON."""


COMMANDS: dict[str, Callable[..., Any]] = {
    "train": Train,
    "tune": Tune,
    "pbt": Pbt,
    "resume": Resume,
    "sweep": Sweep,
    "evaluate": Evaluate,
    "record": Record,
    "play": Play,
    "watch": Watch,
    "check": Check,
    "list": List,
    "compare": Compare,
    "runs": Runs,
    "status": Status,
    "course": Course,
    "report": Report,
    "class": Class,
}
"""The arguments of each command, by its name."""
MODULES = {"class": "leaderboard"}
"""The modules of commands whose name cannot be that of a module."""
