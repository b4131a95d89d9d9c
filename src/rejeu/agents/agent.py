"""The methods of every agent that users call, under the names of Stable-Baselines3."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import jax
import numpy as np

from rejeu.agents import policy, summary, training
from rejeu.agents.base import BaseAgent
from rejeu.callbacks.base import Callback
from rejeu.checkpoints import model_files, resume
from rejeu.checkpoints.run_files import CheckpointFolder, folder_of
from rejeu.checkpoints.run_folder import find_model
from rejeu.core import algorithm as core, checkpoint, devices, spaces
from rejeu.core.types import AnyArray, Observation, PyTree
from rejeu.core.validation import as_path, number, whole
from rejeu.envs.base import seed_of_run
from rejeu.envs.masks import split
from rejeu.logs.evaluation import Evaluation, evaluate
from rejeu.logs.formatting import counted
from rejeu.logs.logging import Logger, Sink

if TYPE_CHECKING:
    from rejeu.agents.exporting import Exported


class Agent(BaseAgent):
    """The base class of all agents. Abstract: use SAC, PPO or another algorithm."""

    q_values = policy.q_values

    def learn(
        self,
        total_timesteps: int | None = None,
        callback: Callback | Iterable[Callback] | None = None,
        log_interval: int = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
        *,
        episodes: int | None = None,
        minutes: float | None = None,
        sinks: Iterable[Sink] = (),
    ) -> Self:
        """Trains, and returns the agent.

        Args:
            total_timesteps: environment steps, over all environments, rounded up to whole turns or rollouts. None with
                ``episodes`` or ``minutes``.
            callback: one or several, called after every step as ``callback(agent, progress)``; ``False`` stops training.
                A :class:`rejeu.callbacks.TrainingCallback` is also called when training starts and ends, as are those
                of :mod:`rejeu.sb3.common.callbacks`.
            log_interval: episodes between two rows of statistics.
            tb_log_name: name of the folder of the logs, without its number; None: the algorithm's.
            reset_num_timesteps: count steps from 0 and restart schedules (learning rate, exploration, clip range, beta).
                With False both continue as in Stable-Baselines3: earlier steps count as done and as part of the total,
                so ``learn(300, reset_num_timesteps=False)`` after 100 steps moves schedules from 1/4 to the end.
                Weights and buffer are kept in either case.
            progress_bar: show a progress bar.
            episodes: stop after this number of episodes, over all environments.
            minutes: stop after so many, without compilation. Schedules follow the nearest limit; with
                ``reset_num_timesteps=False`` earlier episodes and training time count as earlier steps do.
            sinks: further outputs for the rows of statistics, such as ``rejeu.logs.logging.CsvFile(path)`` or
                ``rejeu.logs.trackers.WandB(project="car")``; they are not closed.

        Without any limit, an agent from :meth:`resume` completes the ``learn`` that was interrupted, with the limits and
        the ``log_interval`` of that call.

        Ctrl-C and SIGTERM end training after the current step; ``interrupted`` is then True.

        Raises:
            ValueError: without an environment or a limit.
            RuntimeError: if the agent is learning, in a callback or another thread.
        """
        call = training.start_call(self, total_timesteps, episodes, minutes, log_interval, reset_num_timesteps)
        with devices.chosen(self.device):
            training.train(self, call, callback, tb_log_name, progress_bar, sinks)
        return self

    remember_best = training.remember_best

    def restore_best(self) -> Self:
        """Restores the best weights so far: networks, targets and optimizers of one moment.

        Raises:
            ValueError: before ``best_window`` episodes have finished or one evaluation was made.
        """
        if self.best is None:
            raise ValueError(
                f"no best weights are known yet: they are kept after {counted(self.best_window, 'episode')} of training, "
                "and at every evaluation by rejeu.callbacks.Evaluate"
            )
        self.run.state = self.learner.copy(self.best.state)
        self.drop_rollout()
        return self

    def statistics(self) -> dict[str, float]:
        """Returns the numbers of one log row: means over the last episodes, losses, rates. Waits for the device."""
        return training.statistics_row(self)

    def predict(
        self,
        observation: Observation,
        state: PyTree = None,
        episode_start: AnyArray = None,
        deterministic: bool = False,
        action_masks: AnyArray = None,
    ) -> tuple[np.ndarray, PyTree]:
        """Returns actions in the environment's own range, and the next state of a recurrent policy (else ``state``).

        Args:
            observation: one observation of the environment's space, or a batch of them with a leading axis; the action
                has a leading axis if and only if the observation has.
            state: what the last call returned, for a recurrent policy; None at the start of episodes.
            episode_start: whether an episode starts with this observation, ``bool (batch,)``; the state of a recurrent
                policy is reset there. None for nowhere.
            deterministic: return the mode of the policy; False samples from it, which gives the same action if the policy
                is deterministic (DDPG, TD3). ``action_noise`` is used in training only.
            action_masks: which actions are allowed, ``bool (batch, n)`` or ``(n,)``, for agents that take masks; None
                allows all.

        Raises:
            ValueError: if observation, mask or ``state`` have the wrong structure or shape.
        """
        if self.takes_masks:
            observation, action_masks = split(observation, action_masks)
        batch, single = spaces.as_batch(observation, self.observation_space, self.obs_leaves)
        batch = self.with_masks(batch, action_masks)
        n = len(jax.tree.leaves(batch)[0])
        ended = np.zeros(n, bool) if episode_start is None else np.asarray(episode_start, bool).reshape(n)
        with devices.chosen(self.device):
            action, memory = policy.act(self, batch, deterministic, state, ended)
        scaled = spaces.scale_action(self.action_space, action)
        scaled = jax.tree.map(lambda array: array[0], scaled) if single else scaled
        return scaled, state if memory is None else memory

    def evaluate(
        self,
        episodes: int | None = None,
        env: Any = None,
        deterministic: bool = True,
        seed: int | None = None,
        success_threshold: float | None = None,
        *,
        minutes: float | None = None,
    ) -> Evaluation:
        """Plays whole episodes and returns their returns, lengths, successes and 95 % intervals.

        Args:
            episodes: number of episodes; None: 100, or with ``minutes`` as many as there is time for.
            env: the environments, as for the constructor. None: new ones like the training environments if these were
                made from an id, else the training environments themselves, whose running episodes are then abandoned.
            deterministic: use the mode of the policy; False samples from it, as :meth:`predict` does.
            seed: of the environments; None draws one for new environments and does not seed others.
            success_threshold: least return of a successful episode where the environment does not report success; None:
                that of the agent.
            minutes: without compilation, after which no further episode starts. Episodes that have started are completed and
                count, so that long ones are not left out, and every environment plays at least one. None for no limit.

        A callback may call it during ``learn``. If it uses the training environments, training continues in new
        episodes.

        Raises:
            ValueError: if there are no environments, or their spaces or a missing ``VecNormalize`` do not match.
        """
        threshold = self.success_threshold if success_threshold is None else success_threshold
        if episodes is None and minutes is None:
            episodes = policy.USUAL_EPISODES
        episodes = None if episodes is None else whole("episodes", episodes, least=1)
        seconds = None if minutes is None else 60 * number("minutes", minutes, above=0)
        with devices.chosen(self.device), policy.evaluation_env(self, env, episodes, seed) as (vector, again):
            return evaluate(policy.policy(self, deterministic), vector, episodes, threshold, again, seconds)

    def report(self, path: str | Path, evaluations: Iterable[tuple[int, Evaluation]] = ()) -> Path:
        """Writes a page about the training so far, one HTML file that needs no network, and returns its path.

        A run of ``rejeu train`` has more to show; see :func:`rejeu.write_report`.

        Args:
            path: of the page.
            evaluations: ``(step, Evaluation)`` pairs, such as ``Evaluate.results``.

        Raises:
            MissingExtra: if plotly or jinja2 is not installed.
        """
        import rejeu  # whose wings the library does not import

        return rejeu.write_report(self, path, evaluations)

    def save(self, path: str | Path) -> Path:
        """Writes the model to one safetensors file, without the replay buffer, and returns its path.

        ``.safetensors`` is added to a path without a suffix. The file contains the parameters, optimizers,
        hyperparameters, spaces and counters. An older file at that path is replaced only when the new one is complete.
        """
        return self.snapshot(path)()

    def snapshot(self, path: str | Path) -> Callable[[], Path]:
        """Returns a function that writes the model as it is now, as :meth:`save` does."""
        arrays, header = Agent.get_parameters(self), model_files.header(self)

        def write() -> Path:
            self.last_saved = checkpoint.write(path, "agent", arrays, header)
            return self.last_saved

        return write

    def export(
        self,
        path: str | Path,
        to: str | None = None,
        *,
        noise: bool = False,
        batch: int | None = None,
        frame_stack: int | None = None,
    ) -> Exported:
        """Writes the policy to a file that acts as :meth:`predict` does, outside of rejeu.

        It takes raw observations, one input for each array, and returns actions of the environment: normalization, scaling
        and clipping are inside. The state of a recurrent policy and action masks are inputs. Before the file is kept it is
        compared with ``predict(deterministic=True)`` on 1,000 observations, recorded in a new environment, or sampled from
        the observation space if none can be made. A card in JSON is written beside it.

        Args:
            path: of the file. An older one is replaced only when the new one is complete.
            to: ``"onnx"``, ``"c"``, ``"stablehlo"``, ``"npz"`` or ``"web"``; None goes by the suffix: ``.onnx``, ``.c`` (with
                a header beside it), ``.stablehlo``, ``.npz`` (for :func:`rejeu.load_policy`) or ``.html``. A page contains the
                environment too, which must be CartPole, Pendulum, MountainCar, MountainCarContinuous, Ball or parking.
            noise: sample from the policy, with the random numbers as further inputs; else take its mode.
            batch: observations at once; None for any number. C and pages take one, NumPy any number.
            frame_stack: frames of which each observation is a stack, as of ``FrameStackObservation`` or ``VecFrameStack``. The
                file takes single frames then, and the stack is a part of its state. None for the agent's ``frame_stack``.

        Raises:
            ValueError: if a part of the policy cannot be expressed in the format, or the file acts otherwise than
                ``predict``; nothing is written then.
            MissingExtra: if ``onnx`` is not installed.
            OSError: if the file cannot be written.
        """
        from rejeu.agents import exporting

        with devices.chosen(self.device):
            return exporting.export(self, path, to, noise, batch, frame_stack=frame_stack)

    @classmethod
    def load(cls, path: str | Path, env: Any = None, **changes: Any) -> Self:
        """Returns the agent of a model file. No code from the file is run.

        Args:
            path: as given to :meth:`save`, or a run folder, whose best model is loaded.
            env: environments to continue training in; None for an agent that only predicts and evaluates. It evaluates in
                new environments like those it was trained on, if these were made from a registered id.
            changes: constructor arguments and hyperparameters that replace the saved ones.

        Raises:
            FileNotFoundError: if there is no such file.
            CheckpointError: if the file is damaged, or its algorithm, spaces, schema or shapes do not match.
        """
        with checkpoint.opened(find_model(path), "agent") as file:
            agent = model_files.load(
                cls, file, lambda agent: None if env is None else agent.make_envs(env, seed=agent.seed), changes
            )
        agent.made_from_id = isinstance(env, str)
        return agent

    @classmethod
    def resume(cls, folder: str | Path, env: Any = None, **changes: Any) -> Self:
        """Returns the agent of the newest checkpoint of a run; ``learn()`` then completes the run.

        Parameters, replay buffer, running episodes, exploration, random numbers, counters, statistics and the state of
        callbacks are restored (give ``learn`` the same callbacks). If the environments can be saved (see
        :mod:`rejeu.envs.snapshot`) or can repeat their episodes (EnvPool), the run continues bit for bit as it would have
        without the interruption. Otherwise new episodes start, with a warning. See ``resumed``.

        Args:
            folder: as given to :class:`rejeu.callbacks.Checkpoint`, or one of the checkpoints in it.
            env: as for the constructor; None makes as many environments of the same id.
            changes: hyperparameters that replace the saved ones.

        Raises:
            FileNotFoundError: if there is no checkpoint.
            CheckpointError: if the checkpoints are damaged, or of another algorithm or environment.
        """
        return resume.resume(cls, as_path(folder), env, changes)

    def checkpoint_folder(self, folder: str | Path) -> CheckpointFolder:
        """Returns a folder for the checkpoints of its run, which :class:`rejeu.callbacks.Checkpoint` writes."""
        return folder_of(self, as_path(folder))

    def get_env(self) -> Any:
        """Returns the training environments with the interface of Stable-Baselines3's ``VecEnv``; None if there are none.

        That is the vector environment that was given, if it resets itself; a Gymnasium environment is returned in a
        ``DummyVecEnv``. Its running episodes are abandoned: the next ``learn`` starts new ones. Do not step it during
        ``learn``.
        """
        env = self.run.env
        if env is None:
            return None
        if not self.is_learning:
            self.abandon_episodes()
        if env.venv is None:
            import rejeu  # whose wings the library does not import

            env.venv = rejeu.to_vec_env(env)
        return env.venv

    def set_logger(self, logger: Logger) -> None:
        """Replaces the console and the outputs of ``log`` by those of a logger."""
        self.logger = logger

    def set_env(self, env: Any, force_reset: bool = True) -> None:
        """Replaces the environment by another with the same spaces; new episodes start there.

        If the number of environments changes, a replay buffer starts empty, and ``learning_starts`` steps are taken before
        the next gradient step, as after ``load``. Otherwise the buffer is kept.

        The best weights are kept, and later returns are compared with theirs: set ``best`` to None if returns in the new
        environment mean something else.

        Raises:
            ValueError: if the spaces differ.
            RuntimeError: during ``learn``.
        """
        if self.is_learning:
            raise RuntimeError(
                "set_env was called while the agent learns; stop training first (a callback that returns False), then "
                "call set_env and learn(..., reset_num_timesteps=False)"
            )
        vector = self.make_envs(env, 1, seed=seed_of_run(self.seed))
        self.check_spaces(vector, "the new environment")
        self.made_from_id = isinstance(env, str)
        run = self.run
        if run.env is None or run.env.n_envs != vector.n_envs:
            run.replay = self.make_buffer(vector)
            run.td_errors = []
            run.carry = self.learner.initial_carry(vector.n_envs)
            run.learn_from = self.first_learning_step(run.step)
        else:
            self.keep_buffer(vector)
        run.env = vector
        run.obs = run.action = None
        run.ended = np.ones(vector.n_envs, bool)

    def get_parameters(self) -> dict[str, np.ndarray]:
        """Returns a copy of the algorithm's state as arrays by name: networks, targets, optimizers, counters."""
        return {key: value.copy() for key, value in checkpoint.tree_to_arrays(self.state).items()}

    def set_parameters(
        self, load_path_or_dict: Mapping[str, np.ndarray] | str | Path, exact_match: bool = True
    ) -> None:
        """Sets parameters from :meth:`get_parameters` or from a model file.

        Args:
            load_path_or_dict: arrays by name, or a path.
            exact_match: require all parameters; False sets those that are given and keeps the others.

        Raises:
            CheckpointError: if a name, shape or dtype does not match; the agent is then unchanged.
        """
        source = load_path_or_dict
        if not isinstance(source, Mapping):
            path = source
            with checkpoint.opened(path, "agent") as file:
                shapes = self.learner.shapes
                defaults = {} if exact_match else dict(zip(core.names(shapes), jax.tree.leaves(shapes), strict=True))
                checkpoint.match(shapes, {**defaults, **file.specs}, path)
                source = file.read()
            checkpoint.require_finite(source, path)
        arrays = {key: np.asarray(value) for key, value in source.items()}
        if not exact_match:
            arrays = Agent.get_parameters(self) | arrays
        state = checkpoint.arrays_to_tree(self.learner.shapes, arrays, "set_parameters: the source")
        self.run.state = self.learner.pack(state)
        self.drop_rollout()

    def summary(self) -> str:
        """Returns a table of the networks, their layers and numbers of parameters; see :mod:`rejeu.agents.summary`."""
        return summary.describe(self.learner.shapes, self.obs_leaves)


class ClassOnly:
    """Makes ``load`` raise an error on an instance, where it would silently leave that instance as it was."""

    def __init__(self, method: Any) -> None:
        self.method = method
        self.__doc__ = method.__func__.__doc__

    def __get__(self, instance: Any, owner: type) -> Any:
        if instance is not None:
            raise TypeError(
                f"load is called on the class and returns a new agent: agent = {owner.__name__}.load(path); "
                "to change this one in place use agent.set_parameters(path)"
            )
        return self.method.__get__(None, owner)


Agent.load = ClassOnly(Agent.__dict__["load"])  # type: ignore[method-assign,assignment]
