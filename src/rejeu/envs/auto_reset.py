"""Vector environments that reset themselves, with Stable-Baselines3's interface, for scripts that step them by hand.

Agents take a ``DummyVecEnv`` and step the environments in it themselves, without the automatic reset: what an episode
ended in is never hidden from learning.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import jax
import numpy as np
from gymnasium.vector.utils import concatenate, create_empty_array

from rejeu.envs import answers, conversions, faults
from rejeu.envs.base import VectorEnv
from rejeu.envs.gymnasium_vector import GymnasiumVector
from rejeu.envs.in_process import InProcess
from rejeu.envs.masks import MaskedVector
from rejeu.envs.vec_env import Indices, StepResult, VecEnv, VecEnvWrapper, is_wrapped, tile
from rejeu.errors import BadEnvironmentError
from rejeu.reporting.video import VideoFile, check_renders, rgb_frame


class DummyVecEnv(VecEnv):
    """Environments stepped one after the other in this process; an ended one is reset within the step that ended it.

    Observations are arrays with a leading axis ``num_envs``, nested as the observation space is; they, rewards
    ``float32 (num_envs,)``, dones ``bool (num_envs,)`` and the list of infos are new at every step.

    Args:
        env_fns: functions that each make a new environment.

    Raises:
        TypeError: if something else than functions is given.
        ValueError: if two functions return the same environment.

    >>> env = DummyVecEnv([lambda: gym.make("Pendulum-v1")] * 2)
    >>> env.reset().shape
    (2, 3)
    """

    def __init__(self, env_fns: Sequence[Callable[[], gym.Env]]) -> None:
        for function in env_fns:
            if isinstance(function, gym.Env) or not callable(function):
                raise TypeError(
                    f"env_fns must hold functions that make environments, got {type(function).__name__}; "
                    "try DummyVecEnv([lambda: gymnasium.make(id)])"
                )
        if not env_fns:
            raise ValueError("env_fns is empty; give one function for each environment")
        self.envs = [function() for function in env_fns]
        if len({id(env.unwrapped) for env in self.envs}) < len(self.envs):
            raise ValueError("two functions of env_fns returned the same environment; each must make a new one")
        super().__init__(len(self.envs), self.envs[0].observation_space, self.envs[0].action_space)
        self.metadata, self.render_mode = self.envs[0].metadata, self.envs[0].render_mode
        self.n_steps = 0
        """How often all were stepped."""
        self._actions: Any = None

    def reset(self) -> Any:
        """Resets every environment, with the seeds and options set before, and returns the observations."""
        parts = []
        for i, env in enumerate(self.envs):
            parts.append(self._begin(i, env, self._seeds[i], self._options[i]))
        self._reset_seeds()
        self._reset_options()
        return self._stack(parts)

    def step_async(self, actions: Any) -> None:
        """Notes the actions of the next :meth:`step_wait`."""
        if len(actions) != self.num_envs:
            raise ValueError(f"step got {len(actions)} actions for {self.num_envs} environments")
        self._actions = actions

    def step_wait(self) -> StepResult:
        """Takes the step of :meth:`step_async` and returns what :meth:`step` does."""
        self.n_steps += 1
        parts, infos = [], []
        rewards, dones = np.zeros(self.num_envs, np.float32), np.zeros(self.num_envs, bool)
        for i, env in enumerate(self.envs):
            answer = env.step(self._actions[i])
            if (fault := faults.step_fault(answer, env.observation_space)) is not None:
                raise BadEnvironmentError(faults.blamed(faults.id_of(env), i, self.n_steps, fault))
            obs, rewards[i], terminated, truncated, info = conversions.numbers_of(answer)
            obs = answers.kept(
                env.observation_space, obs
            )  # an environment may write its next observation into the same array
            info = {**info, "TimeLimit.truncated": truncated and not terminated}
            dones[i] = terminated or truncated
            if dones[i]:
                info["terminal_observation"] = obs
                obs = self._begin(i, env)
            parts.append(obs)
            infos.append(info)
        return self._stack(parts), rewards, dones, infos

    def _begin(self, i: int, env: gym.Env, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Resets one environment and returns a copy of its observation."""
        try:
            obs, self.reset_infos[i] = answers.reset(env, seed, options)
        except BadEnvironmentError as error:
            raise BadEnvironmentError(faults.blamed(faults.id_of(env), i, self.n_steps, str(error))) from error
        return answers.kept(env.observation_space, obs)

    def _stack(self, parts: list[Any]) -> Any:
        space = self.observation_space
        empty: Any = create_empty_array(space, self.num_envs)
        return concatenate(space, parts, empty)

    def close(self) -> None:
        """Closes every environment."""
        for env in self.envs:
            env.close()

    def get_images(self) -> list[np.ndarray]:
        """Returns the picture of each environment, ``uint8 (height, width, 3)``."""
        check_renders(self)
        return [rgb_frame(env) for env in self.envs]

    def has_attr(self, attr_name: str) -> bool:
        """Returns whether every environment, or a wrapper around it, has the attribute."""
        return all(env.has_wrapper_attr(attr_name) for env in self.envs)

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Returns an attribute of each environment, found through its wrappers."""
        return [env.get_wrapper_attr(attr_name) for env in self._chosen(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Sets an attribute of each environment.

        It is set where it exists, be that beneath wrappers. (Stable-Baselines3 sets it on the outermost wrapper, where
        the environment itself does not see it.)
        """
        for env in self._chosen(indices):
            env.set_wrapper_attr(attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Calls a method of each environment, found through its wrappers, and returns what each returned."""
        return [env.get_wrapper_attr(method_name)(*method_args, **method_kwargs) for env in self._chosen(indices)]

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: Indices = None) -> list[bool]:
        """Returns for each environment whether a wrapper of that class is around it."""
        return [is_wrapped(env, wrapper_class) for env in self._chosen(indices)]

    def _chosen(self, indices: Indices) -> list[gym.Env]:
        return [self.envs[i] for i in self._get_indices(indices)]


def around(envs: Sequence[gym.Env]) -> DummyVecEnv:
    """Returns a vector environment of environments that are there already."""
    remaining = iter(envs)
    return DummyVecEnv([lambda: next(remaining)] * len(envs))


def identities(env: VectorEnv | VecEnv) -> set[int]:
    """Identifies a vector and the environments behind it, so that two vectors around the same ones are recognized."""
    if isinstance(env, MaskedVector):
        return {id(env)} | identities(env.inner)
    if isinstance(env, AutoResetView):
        return {id(env)} | identities(env.vector)
    if isinstance(env, GymnasiumVector):
        return {id(env), id(env.env.unwrapped)}
    venv = env if isinstance(env, VecEnv) else env.venv
    vectors = (env, env if venv is None else venv.unwrapped)
    inside = [one.unwrapped for vector in vectors if isinstance(vector, InProcess | DummyVecEnv) for one in vector.envs]
    return {id(one) for one in (*vectors, *inside)}


class AutoResetView(VecEnv):
    """Environments that are no Python objects of their own, such as EnvPool's, with automatic resets, to step by hand."""

    def __init__(self, vector: VectorEnv) -> None:
        self.vector = vector
        super().__init__(vector.n_envs, vector.observation_space, vector.action_space)
        self._actions: Any = None

    def reset(self) -> Any:
        """Starts an episode in every environment and returns the observations ``(num_envs, ...)``."""
        seed = self._seeds[0]
        self._reset_seeds()
        return jax.tree.map(np.copy, self.vector.reset(seed))

    def step_async(self, actions: Any) -> None:
        """Notes the actions of the next :meth:`step_wait`."""
        self._actions = np.asarray(actions)

    def step_wait(self) -> StepResult:
        """Takes the step of :meth:`step_async` and returns what :meth:`step` does."""
        step = self.vector.step(self._actions)
        dones = step.terminated | step.truncated
        infos: list[dict[str, Any]] = []
        for i in range(self.num_envs):
            info = dict(step.info[i]) if isinstance(step.info, list) else {}
            info["TimeLimit.truncated"] = bool(step.truncated[i] and not step.terminated[i])
            success = self.vector.success(step, i)
            if not math.isnan(success):
                info["is_success"] = bool(success)
            if dones[i]:
                info["terminal_observation"] = jax.tree.map(lambda leaf, i=i: np.copy(leaf[i]), step.obs)
            infos.append(info)
        obs = self.vector.reset_done(dones) if dones.any() else step.obs
        return jax.tree.map(np.copy, obs), step.reward, dones, infos

    def close(self) -> None:
        """Releases the environments."""
        self.vector.close()

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Raises ``AttributeError``: there are no single environments to ask."""
        raise AttributeError(self._out_of_reach(attr_name))

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Raises ``AttributeError``, as :meth:`get_attr` does."""
        raise AttributeError(self._out_of_reach(attr_name))

    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Raises ``AttributeError``, as :meth:`get_attr` does."""
        raise AttributeError(self._out_of_reach(method_name))

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: Indices = None) -> list[bool]:
        """Returns False for each environment."""
        return [False for _ in self._get_indices(indices)]

    def _out_of_reach(self, name: str) -> str:
        return (
            f"{name!r}: the single environments of {self.vector.env_id} on the backend {self.vector.backend} are out of "
            "reach; give the agent gymnasium.make(id) or make_vec_env(id) instead of an id"
        )


class VecVideoRecorder(VecEnvWrapper):
    """Records what a vector environment looks like while it is stepped.

    A recording begins at a reset or step where the trigger says so, has the frame of that moment and one for each of
    the next ``video_length`` steps, and becomes ``{name_prefix}-step-{begin}-to-step-{begin + video_length}.mp4``, also
    if ``close`` or a further triggered ``reset`` ends it early. Several environments are shown side by side. Frames go
    to the file as they come.

    Args:
        venv: a vector environment whose environments were made with ``render_mode="rgb_array"``.
        video_folder: where the files go; made if missing.
        record_video_trigger: told the number of steps so far, says whether to begin a recording.
        video_length: steps in a recording.
        name_prefix: of the files' names.

    Raises:
        MissingExtra: if imageio-ffmpeg is not installed.
        ValueError: if the environments do not render to arrays.
    """

    def __init__(
        self,
        venv: VecEnv,
        video_folder: str | Path,
        record_video_trigger: Callable[[int], bool],
        video_length: int = 200,
        name_prefix: str = "rl-video",
    ) -> None:
        super().__init__(venv)
        check_renders(venv)
        self.video_folder = Path(video_folder).absolute()
        self.video_folder.mkdir(parents=True, exist_ok=True)
        self.record_video_trigger = record_video_trigger
        self.video_length = video_length
        self.name_prefix = name_prefix
        self.frames_per_sec = float(venv.metadata.get("render_fps") or 30)
        self.step_id = 0
        """Steps so far."""
        self.video_path: Path | None = None
        """Of the present or last recording."""
        self._video: VideoFile | None = None

    @property
    def recording(self) -> bool:
        """Whether a recording is under way."""
        return self._video is not None

    def reset(self) -> Any:
        """Resets the environments and returns the observations."""
        obs = self.venv.reset()
        if self.record_video_trigger(self.step_id):
            self._begin()
        return obs

    def step_wait(self) -> StepResult:
        """Takes the step noted by ``step_async`` and returns what :meth:`step` does."""
        result = self.venv.step_wait()
        self.step_id += 1
        if self._video is not None:
            self._capture(self._video)
        elif self.record_video_trigger(self.step_id):
            self._begin()
        return result

    def close(self) -> None:
        """Completes the recording that is under way and closes the environments."""
        self._end()
        self.venv.close()

    def _begin(self) -> None:
        self._end()
        name = f"{self.name_prefix}-step-{self.step_id}-to-step-{self.step_id + self.video_length}.mp4"
        self.video_path = self.video_folder / name
        self._video = VideoFile(self.video_path, self.frames_per_sec)
        self._capture(self._video)

    def _capture(self, video: VideoFile) -> None:
        try:
            video.write(tile([image for image in self.venv.get_images() if image is not None]))
        except BaseException:
            video.discard()
            self._video = None
            raise
        if video.n_frames > self.video_length:
            self._end()

    def _end(self) -> None:
        if self._video is not None:
            video, self._video = self._video, None
            video.close()
