"""The commands and their arguments.

What a command does is in the module of its name, or that in :data:`MODULES`, which is imported when it runs:
``run_NAME(arguments)`` returns the exit status, and the result for ``--json``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta

from rejeu.core.records import Duration, Positive, Seed
from rejeu.core.types import Settings
from rejeu.export import FORMATS
from rejeu.lab.runs.arguments import (
    Branch,
    Count,
    EnvCount,
    EpisodeCount,
    Folder,
    Json,
    Minutes,
    NoReport,
    NoVideo,
    Rate,
    Resume,
    RunOptions,
    RunPath,
    SeedOrNone,
    Several,
    Train,
)
from rejeu.lab.runs.config import EnvironmentOptions, Shown, Topic

WHICH = "Of a folder: the model that evaluated best in training, or the last."

PORT = 8080
"""Where the studio is looked for first."""
Which = Annotated[Literal["best", "last"], Shown("{best,last}", "which", WHICH)]
EnvironmentId = Annotated[str, Shown("ENV", is_positional=True)]
ModelPath = Annotated[
    Path, Shown("RUN", is_positional=True, help="Folder of a run, or a model file (.safetensors, .zip).")
]
Algorithm = Annotated[str | None, Shown("NAME", help="Algorithm; by default that of the preset.")]
Name = Annotated[str | None, Shown("NAME")]
Return = Annotated[float | None, Shown("RETURN")]
Imports = Annotated[tuple[str, ...], Shown("MODULE", "import")]
Assignments = tuple[str, ...]
PrintJson = Annotated[bool, Shown(help="Print the result as JSON."), Topic.OUTPUT]


@dataclass(frozen=True, kw_only=True)
class Clone(RunOptions):
    """Trains an agent to act as in recorded episodes (behavior cloning), and leaves a run folder as rejeu train does.

    With --expert a trained agent also says what to do where the clone comes itself (DAgger). rejeu resume RUN --steps N trains
    the clone in the environment. Example: rejeu clone played --algo PPO
    """

    dataset: Annotated[Path, Shown("DATASET", is_positional=True)]
    """Folder of a Minari dataset, such as rejeu play --record writes."""
    env: Annotated[str | None, Shown("ENV"), Topic.ENVIRONMENT] = None
    """Environment, as for rejeu train; by default the dataset's. One that is imported must be named."""
    algo: Name = None
    """Algorithm; by default the preset's, else one that fits the actions."""
    hyperparameters: Annotated[Settings, Shown("NAME=VALUE ...", "set")] = field(default_factory=dict)
    """Hyperparameters of the agent, as for rejeu train."""
    updates: Annotated[Positive, Shown("N")] = 2000
    """Gradient steps; with --expert, in each round."""
    learning_rate: Annotated[Annotated[float, Meta(gt=0)], Shown("RATE")] = 1e-3
    """Step size of these gradient steps."""
    critic_updates: Annotated[int, Meta(ge=0), Shown("N"), Topic.TRAINING] = 0
    """Then gradient steps of the critics alone on the dataset: before rejeu resume trains SAC, TD3 or a relative of them."""
    expert: Annotated[Path | None, Shown("RUN"), Topic.TRAINING] = None
    """Folder of a run, or a model file, of the agent that labels what the clone does."""
    by_hand: Annotated[bool, Topic.TRAINING] = False
    """Be the expert: open a window in which you take over from the clone while you hold a key."""
    fps: Annotated[Rate, Topic.TRAINING] = None
    rounds: Annotated[Positive, Shown("N"), Topic.TRAINING] = 5
    """With an expert: how often the clone acts and is trained again."""
    round_steps: Annotated[Positive, Shown("N"), Topic.TRAINING] = 1000
    """With an expert: environment steps of each round; the last episode is completed."""
    best_or_last: Annotated[Which, Topic.TRAINING] = "best"
    evaluate_episodes: EpisodeCount = None
    device: Annotated[str, Shown("NAME"), Topic.TRAINING] = "auto"
    """As for rejeu train."""
    seed: SeedOrNone = None
    """Seeds everything; by default a random one."""
    out: Folder = None
    """Run folder, as for rejeu train."""
    no_report: NoReport = False
    no_video: NoVideo = False
    json: Json = False


@dataclass(frozen=True)
class Sweep:
    """Trains many runs: the environments, algorithms, settings and seeds of a plan, on one machine, several, or a Ray cluster.

    Ctrl-C stops all runs cleanly; rejeu resume continues. Example: rejeu sweep plan.toml --workers 4
    """

    plan: Annotated[Path, Shown("FILE", is_positional=True)]
    """TOML file with the plan."""
    out: Folder = None
    """Folder of the sweep; one of the same plan is joined. By default a new one under runs."""
    workers: Several = None
    """Runs trained at once; by default half as many as there are cores, with --ray as many as the cluster has room for."""
    ray: Annotated[str | None, Shown("ADDRESS")] = None
    """Train on this Ray cluster: auto, or HOST:PORT."""
    imports: Imports = ()
    """Import this module or Python file first, in each run: one that registers algorithms or environments."""
    json: Json = False


@dataclass(frozen=True, kw_only=True)
class Tune(EnvironmentOptions):
    """Searches hyperparameters with Optuna, and compares the best ones with the default on fresh seeds.

    Ctrl-C stops cleanly; rejeu resume continues. Example: rejeu tune Pendulum-v1 --algo SAC --trials 30
    """

    env: EnvironmentId
    """Id of an environment, as for rejeu train."""
    algo: Algorithm = None
    envs: Annotated[EnvCount, Topic.ENVIRONMENT] = None
    """Environments that each agent steps at once; by default the preset's, else 1."""
    backend: Annotated[Name, Topic.ENVIRONMENT] = None
    """auto, envpool, gymnasium, gymnasium-async or jax; by default the preset's, else auto."""
    preset: Annotated[Path | None, Shown("FILE"), Topic.TRAINING] = None
    """Where the search starts, and the other hyperparameters; by default rejeu's preset, else the algorithm's defaults."""
    hyperparameters: Annotated[Settings, Shown("NAME=VALUE ...", "set")] = field(default_factory=dict)
    """Hyperparameters to set instead of searching them, as for rejeu train."""
    search: Annotated[Assignments, Shown("NAME=LOW..HIGH ...")] = ()
    """Other ranges, or further hyperparameters: learning_rate=1e-4..1e-2 "batch_size=[64,128]" tau=log:0.001..0.1"""
    only: Annotated[Assignments, Shown("NAME ...")] = ()
    """Search these hyperparameters and no others."""
    measure: Annotated[Literal["return", "success"], Shown("{return,success}"), Topic.EVALUATION] = "return"
    """Maximize the mean return of the last evaluation of a trial, or its success rate."""
    evaluate_episodes: EpisodeCount = None
    checkpoint_minutes: Annotated[float, Meta(ge=0), Shown("M"), Topic.OUTPUT] = 5.0
    """Minutes between two checkpoints of a training; 0 for none."""
    seed: Annotated[Seed, Shown("N")] = 0
    """Determines what is sampled and the seeds of all trainings."""
    workers: Annotated[Several, Topic.TRAINING] = None
    """Agents trained at once; by default half as many as there are cores."""
    trials: Annotated[int, Meta(ge=1, le=100_000), Shown("N")] = 30
    """How many trials; of a study that exists, how many in all."""
    steps: Count = None
    """Environment steps of a trial; by default the preset's, else 100000."""
    evaluate_every: Annotated[Count, Topic.EVALUATION] = None
    """Environment steps between two evaluations; by default a tenth of --steps."""
    trial_seeds: Annotated[int, Meta(ge=1, le=1000), Shown("K"), Topic.TRAINING] = 1
    """Seeds of each trial, trained at once, whose evaluations are averaged."""
    final_seeds: Annotated[int, Meta(ge=0, le=1000), Shown("K"), Topic.EVALUATION] = 5
    """Fresh seeds on which the winner is compared with the default, at least 5; 0 for no comparison."""
    pruner: Annotated[Literal["median", "halving", "none"], Shown("{median,halving,none}"), Topic.TRAINING] = "median"
    """Stop trials that are below the median of the others, or by successive halving, or none."""
    out: Folder = None
    """Study folder; an existing one is continued or joined. By default a new one under runs."""
    json: Json = False


@dataclass(frozen=True)
class Evaluate(RunOptions):
    """Evaluates the deterministic policy of a trained agent on whole episodes and prints the results."""

    run: ModelPath
    episodes: Count = None
    """How many; 100, or with --minutes as many as there is time for."""
    minutes: Minutes = None
    """Time, without compilation, after which no further episode begins; running episodes are finished."""
    backend: Annotated[str, Shown("NAME")] = "auto"
    """auto, envpool, gymnasium, gymnasium-async or jax; gymnasium is the environment's own package."""
    device: Annotated[str, Shown("NAME")] = "auto"
    """As for rejeu train."""
    seed: SeedOrNone = None
    """Of the environments; by default a random one."""
    success_threshold: Return = None
    """Return from which on an episode counts as a success; by default as in training."""
    best_or_last: Which = "best"
    json: Json = False


@dataclass(frozen=True)
class Export(RunOptions):
    """Writes the policy of a trained agent to a file that acts without rejeu: ONNX, C, StableHLO, NumPy or a web page.

    The file is compared with predict on 1,000 observations before it is kept. Example: rejeu export runs/NAME --to onnx
    """

    run: ModelPath
    to: Annotated[str | None, Shown(f"{{{','.join(FORMATS)}}}")] = None
    """Format; by default that of the suffix of --out, else onnx."""
    out: Annotated[Path | None, Shown("PATH")] = None
    """File to write, or an existing folder; by default policy.onnx, .c, .stablehlo, .npz or .html in the folder of the
    run, or next to the model under its name."""
    noise: bool = False
    """Sample from the policy, with the random numbers as inputs, instead of taking its mode."""
    batch: Count = None
    """Observations at once; by default any number. C and web pages take one."""
    frame_stack: Count = None
    """Frames of which each observation is a stack: the file then takes single frames. By default those of the agent's
    setting frame_stack."""
    best_or_last: Which = "best"
    json: Json = False


@dataclass(frozen=True)
class Record(RunOptions):
    """Records a video of a few episodes of a trained agent in the environment's own package."""

    run: ModelPath
    out: Annotated[Path | None, Shown("FILE")] = None
    """Where to write; by default video.mp4 in the folder, or next to the file under its name."""
    episodes: Annotated[Positive, Shown("N")] = 3
    """How many."""
    seed: SeedOrNone = None
    """Of the environment; by default a random one."""
    best_or_last: Which = "best"
    json: Json = False


@dataclass(frozen=True)
class Play(EnvironmentOptions):
    """Opens a window in which you play an environment with a, s, d, w or the arrows.

    Any keys may be held together. The window says what each does; r restarts, p pauses, q quits.
    """

    env: EnvironmentId
    """Id of an environment with Discrete or Box actions, as for rejeu train; or Car, Mountain or Lunar."""
    keys: Annotated[Assignments, Shown("KEYS=ACTION ...")] = ()
    """Other keys: a=0 d=2 none=1 for Discrete actions, "w=[1,0]" "a+w=[1,-1]" for Box actions; none is nothing held."""
    seed: SeedOrNone = None
    """Of the first episode; each further one has the next seed. By default a random one."""
    fps: Rate = None
    episodes: Count = None
    """Close after so many; by default when you do."""
    record: Folder = None
    """New or empty folder for a Minari dataset and a video of what you play."""
    against: Annotated[Path | None, Shown("RUN")] = None
    """Folder of a run, or a model file, whose agent plays the same episodes next to you."""
    best_or_last: Which = "best"
    json: Json = False


@dataclass(frozen=True)
class Watch(RunOptions):
    """Opens a window in which a trained agent plays, in the environment's own package.

    r restarts the episode, p pauses, q quits. Two agents play side by side, from the same starts, in the web browser.
    """

    runs: Annotated[tuple[Path, ...], Shown("RUN ...", is_positional=True)]
    """One or two folders of runs, or model files (.safetensors, .zip)."""
    episodes: Count = None
    """Close after so many; by default when you do."""
    seed: SeedOrNone = None
    """Of the first episode; each further one has the next seed. By default a random one."""
    best_or_last: Which = "best"
    fps: Rate = None
    json: Json = False


@dataclass(frozen=True)
class New:
    """Writes a project to a new folder: an environment with its test, a plan of runs, pyproject.toml and a README.

    Everything in it runs at once, and is to be replaced by your own. Example: rejeu new my-robot
    """

    folder: Annotated[Path, Shown("FOLDER", is_positional=True)]
    """New folder, whose name is that of the project."""
    json: Json = False


@dataclass(frozen=True)
class Check(EnvironmentOptions):
    """Checks an environment for a few seconds and prints what is wrong with it; exit status 1 after errors.

    An environment of your own: rejeu check my_env.py, or my_package.my_module:MyEnv-v0, where the module registers it.
    """

    env: EnvironmentId
    """Id of an environment, such as parking-v0; or my_env:MyEnv-v0 or my_env.py, which is imported."""
    all: bool = False
    """Of an installed package's environment, show the warnings too, which only its authors can act on."""
    json: Json = False


@dataclass(frozen=True)
class List:
    """Lists the algorithms and the environments with tuned hyperparameters."""

    imports: Imports = ()
    """Import this module or Python file first: one that registers algorithms; repeat for several."""
    json: Json = False


@dataclass(frozen=True)
class Course:
    """Writes the notebooks of the courses, exercises and solutions, to a folder, or grades notebooks.

    Existing files are never changed. rejeu course grade FILE ... says which checks each notebook passes; it executes the
    functions in them.
    """

    language: Annotated[Literal["en", "fr", "grade"], Shown("LANGUAGE", is_positional=True)]
    """en or fr; or grade."""
    paths: Annotated[tuple[Path, ...], Shown("FOLDER ...", is_positional=True)]
    """Where to write; it is created. Of grade: notebooks, .ipynb or .py."""
    json: Json = False


@dataclass(frozen=True)
class Report(RunOptions):
    """Writes a page about one or several runs: curves, evaluations, videos, episodes, configuration.

    The page is one file that needs no network. Example: rejeu report runs/NAME --open
    """

    runs: Annotated[tuple[Path, ...], Shown("RUN ...", is_positional=True)]
    """Run folders, also of runs in progress."""
    out: Annotated[Path | None, Shown("FILE")] = None
    """File to write; by default report.html in the folder of a single run, else in the current folder."""
    open: bool = False
    """Open the page in the web browser."""
    replay: Count = None
    """First let the trained agent play this many episodes, from the seeds 0, 1, 2 ...; the page lists them by return."""


@dataclass(frozen=True)
class Studio(RunOptions):
    """Serves a page to this computer on which runs are started, watched, played against and compared in the web browser.

    Runs that it starts go on when it ends. Example: rejeu studio runs
    """

    folder: Annotated[Path, Shown("FOLDER", is_positional=True)] = Path("runs")
    """Folder below which all runs are shown, and new ones begin."""
    port: Annotated[Annotated[int, Meta(ge=0, le=65535)], Shown("N")] = PORT
    """Port of this computer; if it is taken, the next free one. 0 for any."""
    no_browser: bool = False
    """Print the address, and do not open it in the web browser."""
    allow_host: Annotated[tuple[str, ...], Shown("NAME:PORT")] = ()
    """Answer under this name and port too, as the browser has them behind a tunnel; repeat for several."""


@dataclass(frozen=True, kw_only=True)
class Class(RunOptions):
    """Evaluates the models in a folder, such as those of a class, and prints a leaderboard with confidence intervals.

    Every model plays the same episodes. A file that is damaged or of another environment gets one line. The page Class of
    rejeu studio FOLDER shows the same live, each model to be watched.
    """

    folder: Annotated[Path, Shown("FOLDER", is_positional=True)]
    """Folder with .safetensors and .zip files and run folders, also in folders in it. The leaderboard has their names."""
    env: Annotated[str | None, Shown("ENV")] = None
    """Environment, as for rejeu train; by default the one that most models were trained on."""
    episodes: Annotated[Positive, Shown("N")] = 50
    """Episodes of each model, up to 1000."""
    minutes: Annotated[Duration, Shown("M")] = 1.0
    """Time of each model, without compilation; one that needs more is not ranked."""
    seed: Annotated[Seed, Shown("N")] = 0
    """Of the episodes, the same for all models."""
    success_threshold: Return = None
    """Return from which on an episode counts as a success; by default the environment's own. That of a file is not used."""
    language: Annotated[Literal["en", "fr"] | None, Shown("{en,fr}")] = None
    """Of the leaderboard; by default that of the environment variable REJEU_LANGUAGE, else English."""
    out: Annotated[Path | None, Shown("FILE")] = None
    """File to write, .md or .json."""
    json: Json = False


@dataclass(frozen=True)
class Compare:
    """Compares groups of runs, such as several seeds of two algorithms: curves, final scores, 95 % intervals.

    Also reads monitor.csv of Stable-Baselines3 and TensorBoard files. Example: rejeu compare runs --by setting --out page.html
    """

    runs: Annotated[tuple[Path, ...], Shown("RUN ...", is_positional=True)]
    """Run folders, or folders of run folders."""
    by: Annotated[Literal["algorithm", "setting", "env"] | None, Shown("{algorithm,setting,env}")] = None
    """Basis of the groups; by default the first of these in which the runs differ."""
    x: Annotated[Literal["steps", "time"], Shown("{steps,time}")] = "steps"
    """Compare over environment steps or over training time."""
    score: Annotated[Literal["training", "evaluation"], Shown("{training,evaluation}")] = "training"
    """Final score: mean return of the last tenth of training, or of the last evaluation."""
    statistic: Annotated[Literal["iqm", "mean", "median"], Shown("{iqm,mean,median}")] = "iqm"
    """Statistic of the curves over the runs."""
    normalize: Annotated[Literal["range"] | None, Shown("range")] = None
    """Scale the returns of each environment to its range of final scores, so that environments can be averaged."""
    reference: Annotated[Assignments, Shown("ENV=LOW,HIGH ...")] = ()
    """Scale with these reference returns instead, which become 0 and 1; needed for every environment."""
    threshold: Return = None
    """Return that counts as learned: the table then has the steps that it took."""
    out: Annotated[Path | None, Shown("PATH")] = None
    """File to write (.md, .csv, .json, .png or .html), or a folder for all of them."""
    open: bool = False
    """Open the page in the web browser; it is written to compare.html unless --out says otherwise."""
    json: PrintJson = False


@dataclass(frozen=True)
class Runs:
    """Lists the runs in a folder and its subfolders with state, steps and best results."""

    folder: Annotated[Path, Shown("FOLDER", is_positional=True)] = Path("runs")
    """Folder that is searched."""
    follow: bool = False
    """Show the table until Ctrl-C, and changes once a second."""
    json: PrintJson = False


@dataclass(frozen=True)
class Status:
    """Shows how far a run is, also while it trains; exit status 3 if it was interrupted or paused, 4 if it crashed."""

    run: RunPath
    json: PrintJson = False


@dataclass(frozen=True)
class Import(EnvironmentOptions):
    """Converts a model of Stable-Baselines3 to a model file of rejeu, without executing code from it.

    The agent acts as the original does. Example: rejeu import a2c/Pendulum-v1_1 --env Pendulum-v1
    """

    model: Annotated[Path, Shown("FILE", is_positional=True, help="The zip file, or a folder of RL Zoo.")]
    best_or_last: Which = "last"
    """In a folder, best_model.zip or the model at the end of training."""
    vecnormalize: Annotated[Path | None, Shown("FILE")] = None
    """File of the VecNormalize that the policy was trained behind; by default the one beside the zip file. "none" for none."""
    env: Annotated[str | None, Shown("ENV")] = None
    """Environment, as for rejeu train, which the model file then names, for rejeu evaluate and others."""
    hyperparameters: Annotated[Settings, Shown("NAME=VALUE ...", "set")] = field(default_factory=dict)
    """Hyperparameters that replace those of the file."""
    out: Annotated[Path | None, Shown("FILE")] = None
    """Model file to write; by default next to the zip file, under its name."""
    json: Json = False


@dataclass(frozen=True)
class Push:
    """Uploads a model with its curve, evaluation and video to a repository of the Hugging Face hub, with a model card.

    hf auth login, of the package huggingface-hub, signs in. Example: rejeu push runs/NAME USER/MODEL
    """

    run: ModelPath
    repo: Annotated[str, Shown("USER/MODEL", is_positional=True)]
    private: bool = False
    """Make a new repository private."""
    out: Annotated[Path | None, Shown("FOLDER")] = None
    """Write the files to this new folder instead, and upload nothing."""
    json: Json = False


@dataclass(frozen=True)
class Pull:
    """Downloads a model from the Hugging Face hub to a new folder and checks it. Nothing from it is executed."""

    repo: Annotated[str, Shown("USER/MODEL", is_positional=True)]
    out: Folder = None
    """New folder; by default MODEL."""
    json: Json = False


TASKS: dict[str, tuple[Callable[..., Any], ...]] = {
    "train": (List, New, Check, Train, Resume, Branch, Clone, Tune, Sweep),
    "look": (Studio, Evaluate, Watch, Record, Report, Runs, Status, Compare),
    "share": (Export, Import, Push, Pull),
    "teach": (Play, Course, Class),
}
"""The arguments of each command, by what people want to do, in the order of the help."""
COMMANDS = {command.__name__.lower(): command for commands in TASKS.values() for command in commands}
"""The arguments of each command, by its name."""
TRAINING = ("train", "resume", "branch", "clone")
"""Commands that are printed before JAX is imported, so that the wait begins with a line."""
MODULES = {
    **dict.fromkeys(("evaluate", "export", "import", "play", "pull", "push", "record", "watch"), "models"),
    **dict.fromkeys(("class", "course"), "courses"),
    **{"branch": "resume", "status": "runs"},
}
"""The modules of commands whose module has another name."""
